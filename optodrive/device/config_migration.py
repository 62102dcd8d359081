"""Migration of older configurations."""

import re
from pathlib import Path
from typing import Any, NamedTuple

from optodrive.core.errors import MISSING, InputError
from optodrive.core.toml_model import Section, parse_toml, read_field_docstrings, read_toml
from optodrive.device.config import FORMAT, VERSION, Config
from optodrive.device.config_file import RENAMED_KEYS, build_config

REMOVED_KEYS = {
    "scanner.settle_s": "settling times follow from bandwidth_hz, damping, delay_s and slew_rad_per_s",
    "limits.absorbed_power_margin": "state it as absorbed_power in [limits.uncertainty]",
}
"""Keys of versions 1 and 2 without a successor of the same meaning, with what replaced them."""
HEADER = re.compile(r"\s*\[+\s*([\w.]+)\s*\]+\s*(#.*)?$")
VERSION_LINE = re.compile(r"(\s*version\s*=\s*)\d+")


class Migration(NamedTuple):
    """A migrated configuration.

    version: that of the old one; text: in the present version, '' if there are changes to make by hand
    renamed: keys that were renamed; by_hand: lines to change first
    """

    version: int
    text: str
    renamed: tuple[str, ...]
    by_hand: tuple[str, ...]


def migrate_config(path: Path) -> Migration:
    """Migrate a configuration file to the present version. Raises InputError for one that stays invalid."""
    table = read_toml(path)
    if table.get("format") != FORMAT:
        raise InputError(f"{path}: format", table.get("format", MISSING), f"'{FORMAT}'")
    version = table.get("version", MISSING)
    if type(version) is not int or not 1 <= version <= VERSION:
        raise InputError(f"{path}: version", version, f"1 to {VERSION}")
    text = path.read_text(encoding="utf-8")
    if version == VERSION:
        build_config(path, table)
        return Migration(version, text, (), ())
    renamed = _rename_keys(table)
    table["version"] = VERSION
    text, changes = _rename_in_text(text), _list_changes(table)
    if changes or parse_toml(text.encode(), str(path)) != table:
        return Migration(version, "", (), (f"version = {VERSION}", *(f"rename {each}" for each in renamed), *changes))
    build_config(path, table)
    return Migration(version, text, renamed, ())


def _list_sections(table: dict[str, Any], name: str) -> list[dict[str, Any]]:
    """Return a section and those of the stages by that name, as far as they are tables."""
    stages = table.get("stages")
    holders = [table, *(stages if isinstance(stages, list) else ())]
    sections = [holder.get(name) for holder in holders if isinstance(holder, dict)]
    return [section for section in sections if isinstance(section, dict)]


def _rename_keys(table: dict[str, Any]) -> tuple[str, ...]:
    """Rename keys in the table. Return those that it had, with their new names."""
    renamed = []
    for place, new in RENAMED_KEYS.items():
        name, old = place.split(".")
        for section in _list_sections(table, name):
            if old in section:
                section[new] = section.pop(old)
                renamed.append(f"{place} to {new}")
    return tuple(dict.fromkeys(renamed))


def _list_changes(table: dict[str, Any]) -> tuple[str, ...]:
    """Return the lines to remove, and those to add, from a table whose keys are renamed."""
    changes = []
    for place, reason in REMOVED_KEYS.items():
        name, old = place.split(".")
        if any(old in section for section in _list_sections(table, name)):
            changes.append(f"[{name}] remove {old}: {reason}")
    for name, item in Config.model_fields.items():
        kind = item.annotation
        if not (isinstance(kind, type) and issubclass(kind, Section)):
            continue
        section = table.get(name, {})
        if isinstance(section, dict):
            changes += [
                f"[{name}] add {key}: {read_field_docstrings(kind)[key]}"
                for key, inner in kind.model_fields.items()
                if inner.is_required() and key not in section
            ]
    return tuple(changes)


def _rename_in_text(text: str) -> str:
    """Return the text with renamed keys and the present version. Comments and order stay."""
    names = {tuple(place.split(".")): new for place, new in RENAMED_KEYS.items()}
    section, lines = "", []
    for line in text.splitlines(keepends=True):
        if header := HEADER.match(line):
            section = header[1].removeprefix("stages.")
        if not section:
            line = VERSION_LINE.sub(rf"\g<1>{VERSION}", line, count=1)
        for (name, old), new in names.items():
            if section == name:
                line = re.sub(rf"^(\s*){old}(\s*=)", rf"\g<1>{new}\g<2>", line)
        lines.append(line)
    return "".join(lines)
