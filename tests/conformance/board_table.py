"""The table of docs/reference/board-conformance.md, counted from the suite. Run as a script, it prints the table."""

from collections import Counter

from all_scenarios import SCENARIOS
from process_board import PROCESS_KINDS, has_subject
from scenario import GUARDS
from test_conform_mutants import MUTANTS
from test_conformance_pty import IN_EVERY_RUN

ENFORCED = {
    "B1": "gate off unless running",
    "B2": "gate off when the queue is empty",
    "B3": "lease: gate off when the host is silent",
    "B4": "gate-on time, of a point and of a cell",
    "B5": "power, of a point and over any second",
    "B6": "energy of a cell",
    "B7": "gate off until the mirrors have settled",
    "B8": "the field",
    "B9": "interlock, key, emergency stop",
    "B10": "limits only tighten",
    "B11": "fresh arming",
    "B12": "each point once, in order",
    "B13": "invalid frames change only counters",
    "B14": "self-monitoring of tick and gate",
    "B15": "watchdog whose reset turns the gate off",
    "B16": "scan head that is not ready",
    "B17": "light only while the measured mirrors follow",
}


def scenarios_of(guard):
    """Return the names of a guard's scenarios with the number of cases.

    †: some of them are in every run on a pty
    """
    counts = Counter(case.name.partition("-")[0] for case in SCENARIOS if case.subject == guard)
    played = {name.partition("-")[0] for name in IN_EVERY_RUN}
    return ", ".join(
        f"`{name}`" + (f" ×{count}" if count > 1 else "") + "†" * (name in played) for name, count in counts.items()
    )


def row(guard):
    """Return a row of the table."""
    boards = [
        *(kind.name for kind in PROCESS_KINDS if has_subject(kind.name, guard)),
        *(chip for chip in ("qemu", "pico", "pico-xy2") if has_subject(chip, guard)),
    ]
    broken = Counter(mutant.board for mutant in MUTANTS if mutant.guard == guard)
    killed = ", ".join(f"{board.replace('c', 'C')} {count}" for board, count in broken.items())
    return f"| {guard} | {ENFORCED[guard]} | {scenarios_of(guard)} | {', '.join(boards)} | {killed} |"


def table():
    """Return the table as Markdown."""
    head = ["| | enforced | scenarios | on | mutants killed |", "|---|---|---|---|---|"]
    return "\n".join([*head, *map(row, GUARDS)]) + "\n"


if __name__ == "__main__":
    print(table(), end="")
