"""A reader finds every page within two links of the documentation's index."""

import re

from pages import ROOT

DOCS = ROOT / "docs"
LINK = re.compile(r"\]\(([^)#:]+\.md)")


def follow(pages):
    """Return the pages that the given ones link."""
    return {(page.parent / link).resolve() for page in pages for link in LINK.findall(page.read_text(encoding="utf-8"))}


def test_every_page_is_two_links_from_the_index():
    near = follow([DOCS / "index.md"])
    near |= follow(page for page in near if page.is_relative_to(DOCS))
    pages = {page for page in DOCS.rglob("*.md") if page.parent.name != "decisions"} - {DOCS / "index.md"}
    assert sorted(str(page.relative_to(DOCS)) for page in pages - near) == []
