"""Hook of `mkdocs build` that adds the protocol pages from outside docs/ and all decisions, and looks up named code."""

import posixpath
import re
from pathlib import Path

from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File
from named_code import find_missing

ROOT = Path(__file__).resolve().parent.parent
PROTOCOL_FOLDER = "firmware_protocol"
PROTOCOL_PAGES = ("PROTOCOL.md", "SENSOR.md")
PAGES_OUTSIDE = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "SECURITY.md")
DECISION_WORDS_MAX = 150
"""Words of a decision, its title and date apart."""
CHANGELOG_LINES_MAX = 60
"""Lines of the changelog: release notes, and no list of mends."""


def on_config(config):
    """Add every decision to the navigation. Bound the changelog, and look up the code that pages outside docs/ name."""
    for name in PAGES_OUTSIDE:
        if missing := find_missing((ROOT / name).read_text(encoding="utf-8")):
            raise PluginError(f"{name} names code that does not exist: {', '.join(missing)}")
    lines = len((ROOT / "CHANGELOG.md").read_text(encoding="utf-8").splitlines())
    # A merge by union brings back what one side has removed.
    if lines > CHANGELOG_LINES_MAX:
        advice = "take that of main, and add only what a user notices"
        raise PluginError(f"CHANGELOG.md has {lines} lines, expected at most {CHANGELOG_LINES_MAX}: {advice}")
    decisions = sorted(
        path.relative_to(config.docs_dir).as_posix() for path in Path(config.docs_dir).glob("decisions/*")
    )
    config.nav.append({"Decisions": decisions})
    return config


def on_files(files, config):
    """Add the pages from outside docs/."""
    for name in PROTOCOL_PAGES:
        files.append(
            File.generated(
                config, f"reference/{name}", content=(ROOT / PROTOCOL_FOLDER / name).read_text(encoding="utf-8")
            )
        )
    return files


def count_words(markdown):
    """Count the words of a decision without its title and date."""
    lines = markdown.splitlines()
    return sum(len(line.split()) for line in lines if not line.startswith(("# ", "Date: ")))


def on_page_markdown(markdown, page, config, files):
    """Look up named code and bound decisions. Adapt links: to the protocol pages, and from them as plain text."""
    if page.file.src_uri.startswith("decisions/") and (words := count_words(markdown)) > DECISION_WORDS_MAX:
        raise PluginError(f"{page.file.src_uri} has {words} words: a decision has {DECISION_WORDS_MAX} at most")
    if missing := find_missing(markdown):
        raise PluginError(f"{page.file.src_uri} names code that does not exist: {', '.join(missing)}")
    if page.file.src_uri.removeprefix("reference/") in PROTOCOL_PAGES:
        return re.sub(r"\[([^\]]+)\]\((?!#|https?:)[^)]+\)", r"\1", markdown)
    folder = posixpath.relpath("reference", posixpath.dirname(page.file.src_uri) or ".")
    return re.sub(
        rf"\]\((?:\.\./)+{PROTOCOL_FOLDER}/({'|'.join(map(re.escape, PROTOCOL_PAGES))})(#[^)]*)?\)",
        rf"]({folder}/\1\2)",
        markdown,
    )
