"""Self-contained HTML pages for reports."""

from collections.abc import Iterable
from html import escape

STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 62rem; margin: 2rem auto; padding: 0 1rem; color: #1c1c1c; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.15rem; margin-top: 2rem; }
table { border-collapse: collapse; } td, th { padding: .2rem .8rem .2rem 0; text-align: left; vertical-align: top; }
p { margin: .7rem 0 .2rem; } p.item { margin: 0 0 0 1.2rem; }
th { border-bottom: 1px solid #999; } td.n { text-align: right; font-variant-numeric: tabular-nums; }
.grid { display: grid; grid-template-columns: repeat(auto-fill, minmax(19rem, 1fr)); gap: 1rem; }
figure { margin: 0; } figcaption { font-size: .85rem; color: #444; }
svg { width: 100%; height: auto; background: #fafafa; border: 1px solid #ddd; }
.nominal { stroke: #c2571a; fill: none; } .extended, .residual { stroke: #1a6fc2; fill: none; } .bar { fill: #1a6fc2; }
.other { fill: #b5b5b5; } text { font: 11px system-ui, sans-serif; fill: #333; }
"""


def render_page(title: str, verdict: str, narrative: list[str], body: Iterable[str]) -> str:
    """Return an HTML page; the first line of the narrative is its heading, body is HTML that follows the narrative."""
    lines = [line for line in narrative if line]
    parts = [
        "<!doctype html><html lang='en'><head><meta charset='utf-8'>",
        f"<title>{escape(title)}: {escape(verdict)}</title><style>{STYLE}</style></head><body>",
        f"<h1>{escape(lines[0])}</h1><p>{escape(title)}</p>",
        *(f"<p{_class_attribute(line)}>{escape(line.strip())}</p>" for line in lines[1:]),
        *body,
        "</body></html>",
    ]
    return "\n".join(parts)


def render_table(
    header: Iterable[str], rows: Iterable[Iterable[str]], numeric_columns: frozenset[int] = frozenset()
) -> str:
    """Return an HTML table; cells are HTML, numeric_columns are aligned to the right."""
    header_cells = "".join(f"<th>{name}</th>" for name in header)
    cells = (
        "".join(
            f"<td class='n'>{cell}</td>" if at in numeric_columns else f"<td>{cell}</td>" for at, cell in enumerate(row)
        )
        for row in rows
    )
    return f"<table><tr>{header_cells}</tr>{''.join(f'<tr>{row}</tr>' for row in cells)}</table>"


def _class_attribute(line: str) -> str:
    """Return the class attribute of a narrative line; list items and continuation lines have less spacing."""
    return " class='item'" if line.startswith(("- ", "  ")) else ""
