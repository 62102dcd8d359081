"""Documents of sentences, tables and figures, and their renderers.

Theory of operation

A result is told once. Its sentences are lines of text, which the terminal prints as they are: the first is the
headline, "- " begins an item, and two spaces continue one. A `Document` adds to them sections of paragraphs, tables
and figures, which only a page shows, and renders all of it as one HTML file without scripts, in light and dark
colours. Text is escaped where it is rendered, so a document holds plain text; `Markup` is the exception. The same
result as JSON is `to_json` of its dataclasses.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from html import escape
from math import isfinite
from typing import Any

import numpy as np

from optodrive.core.provenance import Provenance

STYLE = """
:root { color-scheme: light dark; --page: #fff; --panel: #fafafa; --ink: #1c1c1c; --muted: #565656; --edge: #d4d4d4;
 --grid: #e6e6e6; --nominal: #b2480f; --extended: #1460aa; --other: #9c9c9c; --noise: #dfe7f1; }
@media (prefers-color-scheme: dark) {
 :root { --page: #14161a; --panel: #1b1e23; --ink: #e9e9e9; --muted: #adb2b8; --edge: #3a4048; --grid: #2b3037;
 --nominal: #f29a5c; --extended: #74b4f5; --other: #747b84; --noise: #2a3442; } }
body { font: 16px/1.5 system-ui, sans-serif; margin: 0; color: var(--ink); background: var(--page); }
main { max-width: 64rem; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.5rem; line-height: 1.25; overflow-wrap: anywhere; }
h2 { font-size: 1.2rem; margin: 2.2rem 0 .6rem; } h3 { font-size: 1rem; margin: 1.2rem 0 .4rem; }
.scroll { overflow-x: auto; } .scroll:focus-visible { outline: 2px solid var(--extended); }
table { border-collapse: collapse; font-size: .93rem; }
td, th { padding: .2rem .9rem .2rem 0; text-align: left; vertical-align: top; }
th { border-bottom: 1px solid var(--edge); white-space: nowrap; }
.nowrap { white-space: nowrap; }
td.n, th.n { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
tr.chosen td { font-weight: 600; }
p { margin: .7rem 0 .2rem; overflow-wrap: anywhere; } p.item { margin: 0 0 0 1.2rem; } .note { color: var(--muted); }
.key { border-bottom: 3px solid; padding-bottom: 1px; }
.key.nominal { color: var(--nominal); border-bottom-style: dashed; }
.key.extended { color: var(--extended); } .key.measured { color: var(--muted); border-bottom-style: dotted; }
pre { overflow-x: auto; }
.grid { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(100%, 25rem), 1fr)); gap: 1.4rem 1rem;
 margin-top: .8rem; }
figure { margin: 0; } figcaption { font-size: .88rem; margin-top: .3rem; color: var(--muted); overflow-wrap: anywhere; }
svg { display: block; width: 100%; height: auto; background: var(--panel); border: 1px solid var(--edge); }
svg.bars, svg.mark { background: none; border: 0; }
svg text { font: 12px system-ui, sans-serif; fill: var(--muted); } svg .on-colour { fill: #111; }
svg .grid-line { stroke: var(--grid); } svg .axis { stroke: var(--muted); } svg .noise { fill: var(--noise); }
svg .threshold { stroke: var(--ink); stroke-dasharray: 4 3; }
svg .nominal { stroke: var(--nominal); stroke-dasharray: 6 3; fill: none; stroke-width: 1.6; }
svg .extended, svg .residual { stroke: var(--extended); fill: none; stroke-width: 1.4; }
svg .measured { fill: var(--muted); } svg .bar { fill: var(--extended); } svg .other { fill: var(--other); }
"""


NUMERIC, MARKED = " class='n'", " class='chosen'"
"""Attributes of a cell and of a row."""


class Markup(str):
    """HTML that is written as it is. Any other text of a document is escaped."""

    __slots__ = ()


@dataclass(frozen=True, eq=False)
class Table:
    """A table that scrolls sideways on a narrow screen.

    label: accessible name; numeric_columns: aligned to the right; marked_rows: in bold
    """

    label: str
    header: Sequence[str]
    rows: Iterable[Sequence[str]]
    numeric_columns: Collection[int] = ()
    marked_rows: Collection[int] = ()

    def to_html(self) -> str:
        """Return the table as HTML."""
        rows = (
            f"<tr{MARKED if number in self.marked_rows else ''}>{self._render_cells('td', 'td', row)}</tr>"
            for number, row in enumerate(self.rows)
        )
        header = self._render_cells("th scope='col'", "th", self.header)
        return (
            f"<div class='scroll' role='region' aria-label='{escape(self.label)}' tabindex='0'>"
            f"<table><thead><tr>{header}</tr></thead><tbody>{''.join(rows)}</tbody></table></div>"
        )

    def _render_cells(self, start: str, end: str, row: Sequence[str]) -> str:
        return "".join(
            f"<{start}{NUMERIC if at in self.numeric_columns else ''}>{_escape(cell)}</{end}>"
            for at, cell in enumerate(row)
        )


@dataclass(frozen=True)
class Figure:
    """One or more drawings above each other, as SVG, with a caption."""

    drawings: str
    caption: str


Part = str | Table | Sequence[Figure]
"""A paragraph, a table, figures side by side, or `Markup` as a block."""


@dataclass(frozen=True, eq=False)
class Section:
    """Heading of a level, and the parts below it."""

    title: str
    parts: Iterable[Part]
    level: int = 2


@dataclass(frozen=True, eq=False)
class Document:
    """A result for readers.

    title: what it is about; verdict: one word; lines: of text, the headline first; opening: sections between the
    headline and the other lines; sections: after these
    """

    title: str
    verdict: str
    lines: Sequence[str]
    sections: Iterable[Section | Markup]
    provenance: Provenance | None = None
    opening: Iterable[Section | Markup] = ()

    def to_html(self) -> str:
        """Return the document as an HTML page."""
        headline, *lines = [line for line in self.lines if line]
        sections = [*self.sections]
        if self.provenance is not None:
            rows = [(name, Markup(f"<code>{escape(text)}</code>")) for name, text in self.provenance.to_rows()]
            sections.append(Section("Provenance", [Table("Provenance", ("entry", "value"), rows)]))
        return "\n".join(
            [
                "<!doctype html><html lang='en'><head><meta charset='utf-8'>",
                "<meta name='viewport' content='width=device-width, initial-scale=1'>",
                f"<title>{escape(self.title)}: {escape(self.verdict)}</title><style>{STYLE}</style></head><body><main>",
                f"<h1>{escape(headline)}</h1><p class='note'>{escape(self.title)}</p>",
                *_render_sections(self.opening),
                # Items and their continuations are closer to each other than paragraphs.
                *(f"<p{_item_class(line)}>{escape(line.strip())}</p>" for line in lines),
                *_render_sections(sections),
                "</main></body></html>",
            ]
        )


def _item_class(line: str) -> str:
    return " class='item'" if line.startswith(("- ", "  ")) else ""


def _render_sections(sections: Iterable[Section | Markup]) -> Iterator[str]:
    for section in sections:
        if isinstance(section, Markup):
            yield section
            continue
        yield f"<h{section.level}>{escape(section.title)}</h{section.level}>"
        for part in section.parts:
            if isinstance(part, str):
                yield part if isinstance(part, Markup) else f"<p>{escape(part)}</p>"
            elif isinstance(part, Table):
                yield part.to_html()
            else:
                yield "<div class='grid'>"
                yield from (
                    f"<figure>{figure.drawings}<figcaption>{escape(figure.caption)}</figcaption></figure>"
                    for figure in part
                )
                yield "</div>"


def _escape(text: str) -> str:
    return text if isinstance(text, Markup) else escape(text)


def to_json(value: Any, /, **names: str) -> Any:
    """Return a result as JSON values: dataclasses as objects, arrays as lists, and numbers that are not finite as null.

    names: in JSON, of fields of a dataclass that have another one there
    """
    if is_dataclass(value) and not isinstance(value, type):
        return {names.get(item.name, item.name): to_json(getattr(value, item.name), **names) for item in fields(value)}
    if isinstance(value, Mapping):
        return {key: to_json(item, **names) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, tuple | list):
        return [to_json(item, **names) for item in value]
    return None if isinstance(value, float) and not isfinite(value) else value
