"""Self-contained HTML pages for reports, in light and dark colours."""

from collections.abc import Iterable
from html import escape

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


def render_page(
    title: str,
    verdict: str,
    narrative: list[str],
    body: Iterable[str],
    provenance: Provenance | None = None,
    opening: Iterable[str] = (),
) -> str:
    """Return an HTML page. The first line of the narrative is its heading, body is HTML that follows the narrative.

    opening: HTML between the heading and the other lines
    """
    lines = [line for line in narrative if line]
    parts = [
        "<!doctype html><html lang='en'><head><meta charset='utf-8'>",
        "<meta name='viewport' content='width=device-width, initial-scale=1'>",
        f"<title>{escape(title)}: {escape(verdict)}</title><style>{STYLE}</style></head><body><main>",
        f"<h1>{escape(lines[0])}</h1><p class='note'>{escape(title)}</p>",
        *opening,
        *(f"<p{_class_attribute(line)}>{escape(line.strip())}</p>" for line in lines[1:]),
        *body,
        *([] if provenance is None else ["<h2>Provenance</h2>", _render_provenance(provenance)]),
        "</main></body></html>",
    ]
    return "\n".join(parts)


def render_table(
    header: Iterable[str],
    rows: Iterable[Iterable[str]],
    numeric_columns: frozenset[int] = frozenset(),
    label: str = "table",
    marked_rows: frozenset[int] = frozenset(),
) -> str:
    """Return an HTML table that scrolls sideways on a narrow screen.

    header, rows: cells as HTML; numeric_columns: aligned to the right; label: accessible name; marked_rows: in bold
    """

    def attribute(column: int) -> str:
        return " class='n'" if column in numeric_columns else ""

    header_cells = "".join(f"<th scope='col'{attribute(at)}>{name}</th>" for at, name in enumerate(header))
    lines = (
        ("<tr class='chosen'>" if number in marked_rows else "<tr>")
        + "".join(f"<td{attribute(at)}>{cell}</td>" for at, cell in enumerate(row))
        + "</tr>"
        for number, row in enumerate(rows)
    )
    return (
        f"<div class='scroll' role='region' aria-label='{escape(label)}' tabindex='0'>"
        f"<table><thead><tr>{header_cells}</tr></thead><tbody>{''.join(lines)}</tbody></table></div>"
    )


def _render_provenance(provenance: Provenance) -> str:
    rows = ((escape(name), f"<code>{escape(text)}</code>") for name, text in provenance.to_rows())
    return render_table(("entry", "value"), rows, label="Provenance")


def _class_attribute(line: str) -> str:
    """Return the class attribute of a narrative line. List items and continuation lines have less spacing."""
    return " class='item'" if line.startswith(("- ", "  ")) else ""
