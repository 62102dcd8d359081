"""How a command was called, and the exit statuses by which it ends.

Besides 0 (done) and those of errors: 1 (failed or refused) and 2 (bad input).
"""

from typing import TYPE_CHECKING, Any, NamedTuple

import typer

if TYPE_CHECKING:
    from optodrive.planning.feasibility.report import FeasibilityReport


DOES_NOT_FIT = 3
"""The command was carried out, but the stimulus does not fit as requested: it is late, trimmed or reduced."""
SUMMARY = (
    "Exit status: 0 done, 1 failed or refused, 2 bad input, 3 done but does not fit as requested, 130 interrupted."
)


def exit_unless_fits(feasibility: "FeasibilityReport | None") -> None:
    """End the command with status 3 if its stimulus does not fit. None, of a plan without a report, ends nothing."""
    if feasibility is not None and not feasibility.fits:
        raise typer.Exit(DOES_NOT_FIT)


class Invocation(NamedTuple):
    """The command line of a command.

    stopped: result of the link process if STOP was sent before the command was imported
    """

    arguments: tuple[str, ...]
    stopped: dict[str, Any] | None
