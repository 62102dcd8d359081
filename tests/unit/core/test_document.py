"""A result for readers as one page, whose text is escaped in every place."""

from dataclasses import dataclass
from html import escape

import numpy as np
import pytest

from optodrive.core.document import Document, Figure, Markup, Section, Table, to_json

HOSTILE = "<script>alert('1')</script>"
PLACES = {
    "title": lambda text: Document(text, "none", ["ok"], []),
    "verdict": lambda text: Document("a", text, ["ok"], []),
    "headline": lambda text: Document("a", "none", [text], []),
    "line": lambda text: Document("a", "none", ["ok", text], []),
    "section": lambda text: Document("a", "none", ["ok"], [Section(text, ())]),
    "paragraph": lambda text: Document("a", "none", ["ok"], [Section("b", [text])]),
    "header": lambda text: Document("a", "none", ["ok"], [Section("b", [Table("c", (text,), [])])]),
    "cell": lambda text: Document("a", "none", ["ok"], [Section("b", [Table("c", ("d",), [(text,)])])]),
    "label": lambda text: Document("a", "none", ["ok"], [Section("b", [Table(text, ("d",), [])])]),
    "caption": lambda text: Document("a", "none", ["ok"], [Section("b", [[Figure("<svg/>", text)]])]),
}


@pytest.mark.parametrize("place", PLACES)
def test_text_is_escaped_and_markup_is_not(place):
    html = PLACES[place](HOSTILE).to_html()
    assert HOSTILE not in html
    assert escape(HOSTILE) in html


@pytest.mark.parametrize("place", ["paragraph", "header", "cell"])
def test_markup_is_written_as_it_is(place):
    assert "<em>1</em>" in PLACES[place](Markup("<em>1</em>")).to_html()


@dataclass(frozen=True)
class Inner:
    value: float


@dataclass(frozen=True, eq=False)
class Outer:
    inner: tuple[Inner, ...]
    column: np.ndarray
    nothing: None = None


def test_json_has_the_fields_under_their_names_there_and_no_number_that_json_lacks():
    found = to_json(Outer((Inner(np.inf), Inner(1.5)), np.array([[1.0, np.nan]])), value="size")
    assert found == {"inner": [{"size": None}, {"size": 1.5}], "column": [[1.0, None]], "nothing": None}
