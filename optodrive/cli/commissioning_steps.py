"""Output of a command that works on the board step by step: a line per step, or one JSON document at the end."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING

from optodrive.cli.output import print_json
from optodrive.core.errors import OptodriveError

if TYPE_CHECKING:
    from optodrive.lab.commissioning.homing import HomingResult


@contextmanager
def report_steps(
    name: str, json: bool, fields: Mapping[str, object] | None = None
) -> Iterator[Callable[["HomingResult"], None]]:
    """Yield a function that reports a step. The document states under `name` whether all went well, and `fields`."""
    results: list[HomingResult] = []

    def report_step(step: "HomingResult") -> None:
        results.append(step)
        if not json:
            print(f"{step.step:<11} {step.message}", flush=True)

    failure = "interrupted"
    try:
        yield report_step
        failure = ""
    except OptodriveError as error:
        failure = str(error)
        raise
    finally:
        if json:
            steps = [{"step": step.step, "ok": True, "message": step.message, **step.details} for step in results]
            print_json({name: not failure, **(fields or {}), "steps": steps, "failure": failure or None})
