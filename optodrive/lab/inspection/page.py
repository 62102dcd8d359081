"""The first page about a recording as text, as JSON and as HTML."""

from collections.abc import Iterator
from html import escape
from typing import Any

from optodrive.core.document import render_table
from optodrive.core.types.measurements import DataFinding
from optodrive.lab.inspection.work import count, list_names

ACTIONS = {"refused": 0, "left out": 1, "noted": 2}
NOTHING = "Nothing is left out."


def build_lines(findings: tuple[DataFinding, ...], failures: tuple[str, ...]) -> list[str]:
    """Return the page as lines, refused and omitted data first."""
    lines = [f"{item.action}: {item.text}" for item in sort_findings(findings)]
    lines += [f"could not be inspected: {item}" for item in failures]
    return lines if any(item.action != "noted" for item in findings) else [NOTHING, *lines]


def sort_findings(findings: tuple[DataFinding, ...]) -> list[DataFinding]:
    """Return findings in the order in which they matter."""
    return sorted(findings, key=lambda item: ACTIONS[item.action])


def build_finding(item: DataFinding) -> dict[str, Any]:
    """Return a finding as JSON values."""
    return {
        "runs": list(item.runs),
        "signal": item.signal or None,
        "kind": item.kind,
        "action": item.action,
        "samples": item.samples,
        "numbers": {name: {"value": value, "unit": unit} for name, (value, unit) in item.numbers.items()},
        "text": item.text,
    }


def build_section(findings: tuple[DataFinding, ...], failures: tuple[str, ...]) -> Iterator[str]:
    """Return the page as a section of a report."""
    omitted = sum(item.action == "left out" for item in findings)
    yield "<h2>The data</h2>"
    yield "<p>What the samples show before any model is fitted. "
    yield (
        f"{count(omitted, 'finding')} left something out, which the verdict does not rest on.</p>"
        if omitted
        else f"{NOTHING}</p>"
    )
    rows = [
        (
            escape(item.kind),
            f"<span class='nowrap'>{item.action}</span>",
            escape(item.text),
            escape(list_names(item.runs)),
        )
        for item in sort_findings(findings)
    ]
    rows += [("could not be inspected", "", escape(item), "") for item in failures]
    marked = frozenset(row for row, item in enumerate(sort_findings(findings)) if item.action != "noted")
    yield render_table(("kind", "action", "finding", "runs"), rows, label="The data", marked_rows=marked)
