"""The first page about a recording as text, as JSON and as HTML."""

from typing import Any

from optodrive.core.document import Markup, Section, Table, to_json
from optodrive.core.quantity import list_names
from optodrive.core.types.measurements import DataFinding
from optodrive.lab.inspection.work import count

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
    numbers = {name: {"value": value, "unit": unit} for name, (value, unit) in item.numbers.items()}
    return {**to_json(item), "signal": item.signal or None, "numbers": numbers}


def build_section(findings: tuple[DataFinding, ...], failures: tuple[str, ...]) -> Section:
    """Return the page as a section of a report."""
    omitted = sum(item.action == "left out" for item in findings)
    summary = f"{count(omitted, 'finding')} left something out, which the verdict does not rest on."
    listed = sort_findings(findings)
    rows: list[tuple[str, str, str, str]] = [
        (item.kind, Markup(f"<span class='nowrap'>{item.action}</span>"), item.text, list_names(item.runs))
        for item in listed
    ]
    rows += [("could not be inspected", "", item, "") for item in failures]
    marked = [row for row, item in enumerate(listed) if item.action != "noted"]
    opening = f"What the samples show before any model is fitted. {summary if omitted else NOTHING}"
    return Section("The data", [opening, Table("The data", ("kind", "action", "finding", "runs"), rows, (), marked)])
