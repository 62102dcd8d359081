"""Write docs/reference/licences.md: the licence of every package that optodrive or one of its extras requires."""

import re
import tomllib
from collections import defaultdict
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "reference" / "licences.md"
BEGIN, END = "<!-- scripts/licences -->", "<!-- end -->"
FAMILIES = {
    r"LGPL": "LGPL-3.0",
    r"GPL|General Public": "GPL-3.0",
    r"MPL|Mozilla": "MPL-2.0",
    r"Apache": "Apache-2.0",
    r"BSD|MIT-0|0BSD": "BSD",
    r"MIT": "MIT",
    r"PSF|Python Software": "PSF-2.0",
    r"ISC": "ISC",
    r"Zlib": "Zlib",
    r"CC0": "CC0",
}
"""Name of a licence by a pattern in what a package states; the first that matches counts."""
STATED = {"resvg-py": "MIT"}
"""Licences that only the file of the licence in the package states."""
PERMISSIVE = {"MIT", "BSD", "Apache-2.0", "PSF-2.0", "ISC", "Zlib", "CC0"}
USED_UNCHANGED = PERMISSIVE | {"MPL-2.0", "LGPL-3.0"}
"""Licences of packages that pip installs beside the program, which imports and does not change or contain them."""
FOR_DEVELOPERS = USED_UNCHANGED | {"GPL-3.0"}
"""Licences of programs that check optodrive: it neither imports nor contains them."""
GROUPS = {"dev": "development", "docs": "development"}
"""Name of an extra in the page, where it is not its own."""


def read_extras():
    """Return the direct requirements by extra; those of every installation are under `always`."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    return {"always": project["dependencies"], **project["optional-dependencies"]}


def normalise(name):
    """Return the name as package registries compare it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def name_licences(text):
    """Return the names of all licences in an expression; of alternatives, the first."""
    parts = (part.split(" OR ")[0] for part in text.split(" AND "))
    return {next((name for pattern, name in FAMILIES.items() if re.search(pattern, part)), part) for part in parts}


def read_licence(name):
    """Return what an installed package states of its licence, as names joined by `and`."""
    known = metadata.metadata(name)
    classifiers = [each for each in known.get_all("Classifier") or [] if each.startswith("License :: OSI Approved ::")]
    stated = (known["License-Expression"], *classifiers, (known["License"] or "").partition("\n")[0])
    text = next((each for each in stated if each), STATED.get(normalise(name), "unknown"))
    return " and ".join(sorted(name_licences(text)))


def follow(requirement, found):
    """Add a requirement, and all that it requires, to the found packages. Skip what another machine needs."""
    required = Requirement(requirement)
    name = normalise(required.name)
    extras = {"", *required.extras}
    if name == "optodrive" or (name, *sorted(extras)) in found:
        return
    if required.marker is not None and not required.marker.evaluate():
        return
    found[(name, *sorted(extras))] = read_licence(name)
    for each in metadata.requires(name) or []:
        marker = Requirement(each).marker
        if marker is None or any(marker.evaluate({"extra": extra}) for extra in extras):
            follow(each.partition(";")[0], found)


def list_licences():
    """Return (group, licence) by package. The group is the first that requires it."""
    rows = {}
    extras = read_extras()
    for extra in sorted(extras, key=lambda extra: (extra != "always", extra in GROUPS, extra)):
        found = {}
        for requirement in extras[extra]:
            follow(requirement, found)
        for (name, *_), licence in found.items():
            rows.setdefault(name, (GROUPS.get(extra, extra), licence))
    return rows


def find_incompatible(rows):
    """Return the packages whose licence does not permit what optodrive does with them."""
    return [
        name
        for name, (group, licence) in rows.items()
        if not set(licence.split(" and ")) <= (FOR_DEVELOPERS if group == "development" else USED_UNCHANGED)
    ]


def format_rows(rows):
    """Return the table of the page: one line per group and licence."""
    names = defaultdict(list)
    for name, place in rows.items():
        names[place].append(name)
    order = sorted(names, key=lambda place: (place[0] != "always", place[0] == "development", place))
    lines = [f"| {group} | {licence} | {', '.join(sorted(names[group, licence]))} |" for group, licence in order]
    return "\n".join(("| required by | licence | packages |", "|---|---|---|", *lines))


def read_rows(text):
    """Return (group, licence) by package of a page."""
    lines = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("| ")][1:]
    return {name: (group, licence) for group, licence, names in lines for name in names.split(", ")}


def main():
    """Write the page, or end with the packages whose licence does not permit it."""
    rows = list_licences()
    if wrong := find_incompatible(rows):
        raise SystemExit(f"scripts/licences: not compatible: {', '.join(wrong)}")
    before, _, rest = PAGE.read_text().partition(BEGIN)
    PAGE.write_text(f"{before}{BEGIN}\n\n{format_rows(rows)}\n\n{END}{rest.partition(END)[2]}")


if __name__ == "__main__":
    main()
