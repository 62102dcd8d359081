"""`optodrive validate --diagnose`: the paper's facts as a recording, and what Text S1 gets wrong in them."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from optodrive.cli.options import announce_compilation, print_json

if TYPE_CHECKING:
    from optodrive.lab.validation.study import Answer

LITERAL = "paper_s1_literal"
TABLE_WIDTH = 110
"""Narrower terminals wrap lines rather than lose digits."""


def diagnose(json: bool = False) -> None:
    """Print the story, or one JSON object."""
    from optodrive.lab.validation.narrative import answer
    from optodrive.lab.validation.study import study
    from optodrive.physics.paper_facts import paper_facts
    from optodrive.physics.parameters import load_parameters

    announce_compilation()
    with _ticking() as tick:
        found = study(paper_facts(), load_parameters(LITERAL), tick)
    if json:
        print_json(answer(found))
    else:
        _print_story(found)


def _print_story(found: "Answer") -> None:
    from rich.console import Console
    from rich.table import Table

    from optodrive.lab.validation.narrative import HEADINGS, after_table, assumptions, before_table, rows

    console = Console(width=max(Console().width, TABLE_WIDTH))

    def say(lines: list[str]) -> None:
        for line in lines:
            console.print(line, highlight=False, markup=False)

    say(before_table(found))
    table = Table(title="Predicted without having been seen: causes chosen and fitted anew, model over measured")
    for heading in HEADINGS:
        table.add_column(heading, justify="right" if heading == "off by" else "left")
    for row in rows(found):
        table.add_row(*row)
    say([""])
    console.print(table)
    say([*after_table(found), "", *assumptions(found)])


@contextmanager
def _ticking() -> Iterator[Callable[[str], None]]:
    """What is being done, on stderr where that is a terminal."""
    from rich.console import Console

    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda what: None
        return
    with console.status("reading the facts") as status:
        yield lambda what: status.update(what)
