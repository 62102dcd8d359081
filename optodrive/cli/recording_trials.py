"""`optodrive recording trials`: the trials of a session as a table."""

from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from optodrive.cli.options import JsonOption
from optodrive.cli.output import print_json

if TYPE_CHECKING:
    from optodrive.lab.recording.trials import Trial

SessionArgument = Annotated[Path, typer.Argument(metavar="FILE", help="Output of `serve --record-session`.")]


def trials(
    session: SessionArgument,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="trials.csv", help="Write the table as CSV, a column per label.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """List the trials of a session: labels, requested and executed onset on three clocks, and outcome."""
    from optodrive.core.files import check_output, write_text
    from optodrive.lab.recording.trials import format_csv, read_trials

    check_output("--out", out, ".csv")
    found = read_trials(session)
    if out is not None:
        write_text(out, format_csv(found))
    if json:
        print_json(
            {"session": str(session), "trials": describe_trials(found), "written": None if out is None else str(out)}
        )
        return
    print_trials(found)
    if out is not None:
        print(f"written          {out}")


def describe_trials(found: list["Trial"]) -> list[dict[str, Any]]:
    """Return the trials as JSON values."""
    return [asdict(trial) for trial in found]


def print_trials(found: list["Trial"]) -> None:
    """Print a table with the executed onset in Unix time, and how much later it was than requested."""
    from optodrive.cli.output import print_table

    headings = ("plan", "name", "run", "status", "executed", "delay", "pulses", "labels", "error")
    print_table(headings, [_format_trial(trial) for trial in found], frozenset({"delay", "pulses"}))


def _format_trial(trial: "Trial") -> list[str]:
    from optodrive.core.quantity import format_quantity

    executed_s, unix_s = trial.executed["board_s"], trial.executed["unix_s"]
    requested_s = trial.requested["board_s"]
    at = "" if unix_s is None else f"{datetime.fromtimestamp(unix_s, UTC):%Y-%m-%d %H:%M:%S.%f}Z"
    delay = "" if executed_s is None or requested_s is None else format_quantity(executed_s - requested_s, "s")
    pulses = f"{trial.executed_pulses} of {trial.planned_pulses}"
    labels = ", ".join(f"{key}={value}" for key, value in trial.labels.items())
    return [trial.plan, trial.name, trial.run, trial.status, at, delay, pulses, labels, trial.error]
