"""Rows of a table of measured quantities, with aims, beside the lateness of the computer."""

import os
import platform
from dataclasses import dataclass, field

from measuring import compute_percentile
from rich.console import Console
from rich.table import Table


@dataclass
class Row:
    """A measured quantity, in ms unless stated otherwise.

    aim: largest value that is aimed at; reference: of the ratio, with its values
    """

    quantity: str
    aim: float | None
    values: list[float]
    unit: str = "ms"
    reference: str = ""
    reference_values: list[float] = field(default_factory=list)
    note: str = ""

    def report(self):
        """Return the row as JSON values. Times without a unit in their name are in the row's unit."""
        p50, p99, largest = (_compute_percentile(self.values, share) for share in (0.5, 0.99, 1.0))
        reference = _compute_percentile(self.reference_values, 0.5)
        return {
            "quantity": self.quantity,
            "unit": self.unit,
            "aim": self.aim,
            "n": len(self.values),
            "median": p50,
            "p99": p99,
            "max": largest,
            "misses_aim": self.aim is not None and (p99 is None or p99 > self.aim),
            "reference": self.reference or None,
            "reference_median": reference,
            "ratio": p50 / reference if p50 is not None and reference else None,
            "note": self.note,
        }


def to_ms(values_s):
    return [1e3 * value_s for value_s in values_s]


def report_lateness(late_s):
    """Return how late the computer woke a sleeping process, as JSON values."""
    late_ms = to_ms(late_s)
    return {"late_p99_ms": _compute_percentile(late_ms, 0.99), "late_max_ms": _compute_percentile(late_ms, 1.0)}


def _compute_percentile(values, share):
    return compute_percentile(values, share) if values else None


def format_number(value):
    return "" if value is None else f"{value:,.0f}" if value >= 100 else f"{value:.1f}"


def print_table(rows):
    table = Table(title="What depends on the computer; ! misses its aim")
    for column in ("quantity", "unit", "aim ≤", "", "n", "median", "p99", "max", "late p99, max, ms", "ratio", "of"):
        table.add_column(column, justify="left" if column in ("quantity", "unit", "of") else "right")
    for row in rows:
        late = f"{format_number(row['late_p99_ms'])}, {format_number(row['late_max_ms'])}"
        numbers = [format_number(row[key]) for key in ("median", "p99", "max")]
        quantity = row["quantity"] + (f" ({row['note']})" if row["note"] else "")
        mark = "!" if row["misses_aim"] else ""
        cells = (quantity, row["unit"], format_number(row["aim"]), mark, str(row["n"]), *numbers, late)
        table.add_row(*cells, format_number(row["ratio"]), row["reference"] or "")
    Console(width=190).print(table)
    load = ", ".join(f"{value:.1f}" for value in os.getloadavg())
    print(f"{platform.machine()}, {os.cpu_count()} cores, load averages {load}, including these processes")
