"""Write docs/reference/circuit.md and its drawing from the circuit: python firmware_protocol/circuit/page.py.

It needs ngspice for the faults.
"""

import sys
from itertools import groupby
from pathlib import Path

sys.path.append(str(Path(__file__).parent))

from circuit import build_parts_list, build_pin_table, draw
from faults import OFF_MAX_V, Outcome, list_outcomes

DOCS = Path(__file__).parents[2] / "docs"
PAGE, DRAWING = DOCS / "reference" / "circuit.md", DOCS / "pictures" / "circuit.svg"

TEXT = """# Circuit of a Pico

<!-- Written by firmware_protocol/circuit/page.py from circuit.py: do not edit. -->

The circuit that [the wiring](../how-to/wire-a-board.md) describes, from one source,
`firmware_protocol/circuit/circuit.py`. **Nobody has built it.** ngspice simulates it with the models of `faults.py`,
which are simple and pessimistic; SKiDL finds no fault of the electrical rules and writes KiCad's netlist from the
same source (`tests/firmware/test_circuit.py`).

![The parts, each pin with its net](../pictures/circuit.svg)

## Pins of the Pico

{pins}

X− and Y− of the galvo drivers get GND. A driver for ILDA's ±10 V across the pair turns half of its angle then: set
its gain for ±5 V on one line, or state the half as `scanner.range_rad`.

## Parts

Prices are those of 2024, about.

{parts}

## Every single fault

One wire is cut, or one supply is missing, while the gate is off: GP14 drives low, or nothing drives it as in a reset;
the worse of both stands here. The laser's input must stay below {limit} V, or the relay must be open, or the board
must see a fault, which opens the relay. {count} faults, none of them leaves the laser on. A wire is named by the pin
at its end.

{faults}

What this table does not cover: two faults at once, a part that fails inside, and mirrors that do not move. A cut wire
of the DAC (SYNC, CLOCK, DATA) or a missing supply of U2 or U3 leaves mirrors that do not follow, and nothing on this
board notices it.
"""


def _group(outcome: Outcome) -> tuple[str, str]:
    shown = "–" if outcome.notice == "relay open" else f"{outcome.ttl_v:.2f}"
    return outcome.notice or "the gate stays off", shown


def build_fault_table(outcomes: list[Outcome]) -> str:
    """Return the table of faults, those with one outcome in one row."""
    rows = ["| what follows | laser's input, V | faults |", "|---|---|---|"]
    ordered = sorted(outcomes, key=lambda outcome: (*_group(outcome), outcome.fault))
    for (follows, shown), group in groupby(ordered, key=_group):
        names = [outcome.fault.removeprefix("wire ").partition(" (")[0] for outcome in group]
        rows.append(f"| {follows} | {shown} | {len(names)}: {', '.join(names)} |")
    return "\n".join(rows)


def build_page() -> str:
    """Return the page. Raise RuntimeError if a fault leaves the laser on."""
    outcomes = [outcome for outcome in list_outcomes() if outcome.fault != "nothing"]
    exposed = [outcome.fault for outcome in outcomes if not outcome.is_dark]
    if exposed:
        raise RuntimeError(f"the laser may be on after: {', '.join(exposed)}")
    return TEXT.format(
        pins=build_pin_table(),
        parts=build_parts_list(),
        faults=build_fault_table(outcomes),
        limit=OFF_MAX_V,
        count=len(outcomes),
    )


if __name__ == "__main__":
    PAGE.write_text(build_page())
    DRAWING.write_text(draw())
