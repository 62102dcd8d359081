"""`optodrive diagnose --live`: measure on the board, diagnose, and choose the next experiment, until one is certain."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from optodrive.cli.commissioning import confirm_emission, open_board
from optodrive.core.errors import MISSING, InputError

if TYPE_CHECKING:
    from rich.console import RenderableType

    from optodrive.core.types.discrepancy import Discrepancy
    from optodrive.core.types.measurements import Measurement
    from optodrive.device.config import Config
    from optodrive.lab.live_diagnosis import CampaignResult, CampaignStep

RECORDING = "recording.h5"
DEFAULT_OUT = Path("live-diagnosis")
BUDGET_MIN_S, DEFAULT_BUDGET_S, BUDGET_MAX_S = 60.0, 900.0, 86_400.0
SHOWN_MAX = 6
"""Explanations in the progress view."""
SHOWN_STEPS_MAX = 8


class LiveRequest(NamedTuple):
    """Options of a live diagnosis."""

    out: Path
    budget_s: float
    yes: bool
    seed: int
    config: str | None

    def check(self) -> None:
        """Raise InputError for an option out of range, or a folder with a diagnosis."""
        from optodrive.core.files import check_output

        check_output("--out", self.out, folder=True, may_exist=True)
        if (self.out / "diagnosis.json").exists():
            raise InputError("--out", str(self.out), "a folder without diagnosis.json: this campaign is complete")
        if not BUDGET_MIN_S <= self.budget_s <= BUDGET_MAX_S:
            raise InputError("--budget-s", self.budget_s, f"{BUDGET_MIN_S:g} to {BUDGET_MAX_S:g} s")


def study_runs(measurement: "Measurement", config: "Config", seed: int) -> "Discrepancy":
    """Diagnose all runs of a campaign. Nothing is held out of so few."""
    from optodrive.lab.diagnosis.diagnose import diagnose
    from optodrive.lab.diagnosis.nominal_fit import build_prior

    prior, _ = build_prior(measurement, config)
    return diagnose(measurement, seed, prior, hold_out=False)


def measure_live(request: LiveRequest, quiet: bool) -> "CampaignResult":
    """Run a campaign on the configured board, in the folder's recording. quiet: without a line per diagnosis.

    The board ends disarmed in every case. Raises InputError for a board without a sensor that records pixels, and
    LinkError, BoardFaultError or RefusedError where a measurement fails.
    """
    from functools import partial

    from optodrive.core.clock import MonotonicClock
    from optodrive.core.files import create_folder
    from optodrive.core.worker_process import WorkerProcess
    from optodrive.lab.live_diagnosis import BoardBench, CampaignRecording, find_pixels, run_campaign

    confirm_emission(request.yes, "this arms the board and pulses one pixel and its neighbour at up to full power")
    create_folder(request.out)
    clock = MonotonicClock()
    # The board closes first on exit: it receives ABORT before the worker process is joined.
    with WorkerProcess() as worker, open_board(request.config, calibrated_field=True) as (board, sensor_reader):
        recording = CampaignRecording(request.out / RECORDING, board.config.name)
        if sensor_reader is None:
            raise InputError("sensor.port", MISSING, "a sensor that records signals of a pixel", "no_port")
        if recording.runs:
            print(f"optodrive: going on with {len(recording.runs)} runs of {recording.path}", file=sys.stderr)
        board.connect()
        sensor_reader.open(records_pixels=True)
        with show_campaign(quiet) as (on_step, on_run):
            return run_campaign(
                BoardBench(board, sensor_reader, worker, clock),
                board.display,
                find_pixels(board.config),
                recording,
                partial(study_runs, seed=request.seed),
                request.budget_s,
                on_step,
                on_run,
            )


@contextmanager
def show_campaign(quiet: bool) -> "Iterator[tuple[Callable[[CampaignStep], None], Callable[[str], None]]]":
    """Show the probabilities over time on stderr where it is a terminal, else print a line per diagnosis."""
    steps: list[CampaignStep] = []
    if not sys.stderr.isatty():

        def print_step(step: "CampaignStep") -> None:
            if not quiet:
                print(format_step(step), flush=True)

        yield print_step, lambda name: None
        return
    from rich.console import Console
    from rich.live import Live

    with Live(console=Console(stderr=True), transient=True) as live:

        def show(doing: str) -> None:
            live.update(_build_table(steps, doing), refresh=True)

        def add(step: "CampaignStep") -> None:
            steps.append(step)
            show("choosing the next experiment")

        show("planning")
        yield add, lambda name: show(f"measuring {name}" if name else "diagnosing")


def format_step(step: "CampaignStep") -> str:
    """Return the line of one diagnosis: time, runs, verdict and the most probable explanations."""
    ranked = [f"{name} {probability:.0%}" for name, probability in list(step.probabilities.items())[:3]]
    return f"{step.lab_s:6.0f} s, {step.runs:3d} runs  {step.verdict:<12} {', '.join(ranked)}"


def _build_table(steps: "list[CampaignStep]", doing: str) -> "RenderableType":
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    if not steps:
        return Text(doing)
    shown = steps[-SHOWN_STEPS_MAX:]
    table = Table(box=None, header_style="bold", title_justify="left")
    table.add_column("explanation", no_wrap=True)
    for step in shown:
        table.add_column(f"{step.lab_s:.0f} s", justify="right")
    for name in list(steps[-1].probabilities)[:SHOWN_MAX]:
        table.add_row(name, *(f"{step.probabilities.get(name, 0.0):.1%}" for step in shown))
    return Group(table, Text(doing))


def describe_end(result: "CampaignResult") -> str:
    """Return the line that states how long a campaign was and why it ended."""
    reason = {
        "certain": "one explanation is certain",
        "no_proposal": "no experiment of the grid would tell more",
        "budget": "the time is used",
    }[result.ended]
    last = result.steps[-1]
    return f"Measured {last.runs} runs; {last.lab_s:.0f} s in the laboratory. The campaign ended: {reason}."


def describe_campaign(result: "CampaignResult") -> dict[str, Any]:
    """Return the steps of a campaign and its end as JSON."""
    return {"ended": result.ended, "steps": [asdict(step) for step in result.steps]}
