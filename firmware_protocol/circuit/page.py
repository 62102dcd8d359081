"""Write docs/reference/circuit.md and its drawings from the circuits: python firmware_protocol/circuit/page.py.

It needs ngspice for the faults.
"""

import sys
from itertools import groupby
from pathlib import Path

sys.path.append(str(Path(__file__).parent))

from circuit import CIRCUITS, Circuit, build_parts_list, build_pin_table, draw
from faults import OFF_MAX_V, Outcome, list_outcomes

DOCS = Path(__file__).parents[2] / "docs"
PAGE, PICTURES = DOCS / "reference" / "circuit.md", DOCS / "pictures"

TEXT = """# Circuits of a Pico

<!-- Written by firmware_protocol/circuit/page.py from circuit.py: do not edit. -->

The circuits that [the wiring](../how-to/wire-a-board.md) describes, [analog](#analog) and with
[XY2-100](#xy2-100), from one source, `firmware_protocol/circuit/circuit.py`. **Nobody has built them.** ngspice
simulates them with the models of `faults.py`, which are simple and pessimistic; SKiDL finds no fault of the
electrical rules. With it, `python firmware_protocol/circuit/netlist.py xy2-100 board.net` (or `analog`) writes the
netlist that KiCad imports.

In the tables of faults one wire is cut, or one supply is missing, while the gate is off: GP14 drives low, or nothing
drives it as in a reset; the worse of both stands there. The laser's input must stay below {limit} V, or the relay must
be open, or the board must see a fault, which opens the relay. A wire is named by the pin at its end. Prices are those
of 2024, about.

What the tables do not cover: two faults at once, a part that fails inside, and mirrors that do not move.

{sections}
"""

SECTION = """## {title}

![The parts, each pin with its net](../pictures/circuit-{name}.svg)

{difference}{pins}

{remark}

{parts}

{count} single faults, none of them leaves the laser on:

{faults}
"""

DIFFERENCE = """Rows of pins and parts that are those of {title} are left out here. The parts {missing} are not needed.

"""

TITLES = {"analog": "Analog", "xy2-100": "XY2-100"}
REMARKS = {
    "analog": """X− and Y− of the galvo drivers get GND. A driver for ILDA's ±10 V across the pair turns half of
its angle then: set its gain for ±5 V on one line, or state the half as `scanner.range_rad`. A cut wire of the
DAC (SYNC, CLOCK, DATA) or a missing supply of U2 or U3 leaves mirrors that do not follow, and nothing on this
board notices it.""",
    "xy2-100": """The pins of X2 are those of the connector with 25 pins that most heads have; compare them with
its manual. The head has its own supply. A cut STATUS pair or an unplugged head is FAULT HEAD. A cut line of
CLOCK, SYNC, X or Y leaves mirrors that do not follow; whether the head's status then says so is its maker's.""",
}


def _group(outcome: Outcome) -> tuple[str, str]:
    shown = "–" if outcome.notice == "relay open" else f"{outcome.ttl_v:.2f}"
    return outcome.notice or "the gate stays off", shown


def build_fault_table(outcomes: list[Outcome]) -> str:
    """Return the table of faults, those with one outcome in one row."""
    rows = ["| what follows | laser's input, V | faults |", "|---|---|---|"]
    ordered = sorted(outcomes, key=lambda outcome: (*_group(outcome), outcome.fault))
    for (follows, shown), group in groupby(ordered, key=_group):
        names = [outcome.fault.removeprefix("wire ").partition(" (")[0] for outcome in group]
        listed = ", ".join(names) if 2 * len(names) < len(outcomes) else "all others"
        rows.append(f"| {follows} | {shown} | {len(names)}: {listed} |")
    return "\n".join(rows)


def _build_section(circuit: Circuit) -> str:
    outcomes = [outcome for outcome in list_outcomes(circuit) if outcome.fault != "nothing"]
    exposed = [outcome.fault for outcome in outcomes if not outcome.is_dark]
    if exposed:
        raise RuntimeError(f"{circuit.name}: the laser may be on after: {', '.join(exposed)}")
    first = next(iter(CIRCUITS.values()))
    missing = [reference for reference in first.parts if reference not in circuit.parts]
    return SECTION.format(
        name=circuit.name,
        title=TITLES[circuit.name],
        difference="" if circuit is first else DIFFERENCE.format(title=TITLES[first.name], missing=", ".join(missing)),
        remark=REMARKS[circuit.name],
        pins=_leave_out(build_pin_table(circuit), "" if circuit is first else build_pin_table(first)),
        parts=_leave_out(build_parts_list(circuit), "" if circuit is first else build_parts_list(first)),
        faults=build_fault_table(outcomes),
        count=len(outcomes),
    )


def _leave_out(table: str, other: str) -> str:
    """Return a table without the rows that another one has too."""
    known = set(other.splitlines()[2:])
    return "\n".join(row for row in table.splitlines() if row not in known)


def build_page() -> str:
    """Return the page. Raise RuntimeError if a fault leaves the laser on."""
    sections = "\n".join(map(_build_section, CIRCUITS.values()))
    return TEXT.format(limit=OFF_MAX_V, sections=sections).rstrip("\n") + "\n"


def locate_drawing(circuit: Circuit) -> Path:
    """Return the file of a circuit's drawing."""
    return PICTURES / f"circuit-{circuit.name}.svg"


if __name__ == "__main__":
    PAGE.write_text(build_page())
    for each in CIRCUITS.values():
        locate_drawing(each).write_text(draw(each))
