"""`optodrive calibrate` without a file of spots: on the board, by the sensor or by a person's eye."""

import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING, Annotated

import typer

from optodrive.core.errors import InputError
from optodrive.core.units import m_to_um, um_to_m

if TYPE_CHECKING:
    from optodrive.lab.calibration.field_fit import FieldFit
    from optodrive.lab.commissioning.measurement_loop import Measured, Progress

NudgeOption = Annotated[bool, typer.Option("--nudge", help="No sensor: a person moves the spot onto each mark.")]
GoalOption = Annotated[float, typer.Option("--goal-um", help="Stop when the field is surely this good, rms.")]
SpotsMaxOption = Annotated[int, typer.Option("--spots-max", help="Stop after so many spots at the latest.")]
ReadingsOption = Annotated[int, typer.Option("--readings", help="Of each spot: the sensor looks so often.")]
SpotPowerOption = Annotated[
    float, typer.Option("--spot", metavar="POWER_MW", help="Power of the spot while it is lit.")
]
FIELD = Path("field.toml")
SPOTS_LEAST, SPOTS_MOST = 9, 1000
READINGS_MOST = 100


@dataclass(frozen=True)
class OnBoard:
    """What is asked of a calibration on the board."""

    nudge: bool = False
    goal_um: float = 10.0
    spots_max: int = 25
    readings: int = 3
    spot_mw: float = 5.0

    def __post_init__(self) -> None:
        if not self.goal_um > 0.0:
            raise InputError("--goal-um", self.goal_um, "more than 0")
        if not SPOTS_LEAST <= self.spots_max <= SPOTS_MOST:
            raise InputError("--spots-max", self.spots_max, f"{SPOTS_LEAST} to {SPOTS_MOST}")
        if not 1 <= self.readings <= READINGS_MOST:
            raise InputError("--readings", self.readings, f"1 to {READINGS_MOST}")


@dataclass(frozen=True)
class Told:
    """What came of it: the fit, the file its spots are kept in, and what there is to say beside the fit's own words."""

    fit: "FieldFit"
    spots: Path
    figures: dict[str, object]
    lines: tuple[str, ...]


def calibrated_on_board(config: str | None, out: Path, asked: OnBoard) -> Told:
    """Measure, and keep the spots beside `out` as a file that --spots takes."""
    from optodrive.lab.calibration.spots import write_spots

    measured = measure_on_board(config, out, asked)
    path = out.with_suffix(".spots.csv")
    write_spots(path, measured.fit.spots)
    return Told(measured.fit, path, figures(measured, asked, path), lines(measured, asked, path))


def session_over(out: Path) -> None:
    """All is written: the next calibration begins anew."""
    from optodrive.lab.commissioning.session_file import session_path

    session_path(out).unlink(missing_ok=True)


def measure_on_board(config: str | None, out: Path, asked: OnBoard) -> "Measured":
    """Arm, measure, fit; the board ends dark and disarmed in any case.

    Every spot is kept in a session beside out, which goes when what came of it is written.
    """
    from optodrive.cli.board_access import bench
    from optodrive.core.clock import MonotonicClock
    from optodrive.lab.calibration.field_prior import Prior
    from optodrive.lab.commissioning.exclusive_board import check_power
    from optodrive.lab.commissioning.measurement_loop import Measuring, fitted
    from optodrive.lab.commissioning.session_file import SessionFile
    from optodrive.lab.commissioning.spot_locator import NudgeLook, SensorLook
    from optodrive.lab.commissioning.worker_process import Aside

    if not out.absolute().parent.is_dir():
        raise InputError("--out", str(out), "a file in a folder that exists")
    power_w, goal_m = asked.spot_mw * 1e-3, um_to_m(asked.goal_um)
    # The bench is left first: the board is told to abort before anything is waited for.
    with Aside() as aside, bench(config) as (held, eyes):
        check_power(held.config, power_w)
        session = SessionFile.beside(out, held.config)
        if not asked.nudge and eyes is None:
            raise InputError("sensor.port", None, "a spot sensor in the configuration; without one, --nudge", "no_port")
        if session.rows:
            _say(f"optodrive: going on with {len(session.rows)} spots of {session.path}; delete it to begin anew")
        aside.begin(fitted, session.spots, Prior.of(held.config))
        aside.result()  # loaded before the board is held
        held.connect()
        if asked.nudge or eyes is None:
            look: NudgeLook | SensorLook = NudgeLook(held, power_w, _typed(), _say)
        else:
            eyes.open()
            look = SensorLook(held, eyes, power_w, asked.readings)
        _say("optodrive: arming, the board's indicator is lit for two seconds first")
        held.arm()
        with _shown(asked) as tell:
            measured = Measuring(held, look, session, aside, MonotonicClock(), goal_m, asked.spots_max).run(tell)
        held.disarm()
    return measured


def figures(measured: "Measured", asked: OnBoard, spots_file: Path) -> dict[str, object]:
    """What the loop itself has to say, for --json."""
    return {
        "looked": "nudge" if asked.nudge else "sensor",
        "readings": 1 if asked.nudge else asked.readings,
        "predicted_rms_um": round(m_to_um(measured.predicted_m), 3),
        "sure_rms_um": round(m_to_um(measured.sure_m), 3),
        "goal_um": asked.goal_um,
        "goal_reached": measured.goal_reached,
        "spots_file": str(spots_file),
    }


def lines(measured: "Measured", asked: OnBoard, spots_file: Path) -> tuple[str, ...]:
    """The same in words."""
    spots, sure_um = len(measured.fit.spots), m_to_um(measured.sure_m)
    reached = "reached" if measured.goal_reached else f"not reached with {spots} spots"
    return (
        f"predicted        {m_to_um(measured.predicted_m):.1f} µm rms over the display, nine times in ten at most "
        f"{sure_um:.1f} µm",
        f"goal             {asked.goal_um:g} µm: {reached}",
        f"spots kept       {spots_file}",
    )


def _say(words: str) -> None:
    print(words, file=sys.stderr, flush=True)


def _typed() -> "SimpleQueue[str | None]":
    """Lines of stdin as they come, None at its end; a thread waits for them, so that the lease is kept."""
    typed: SimpleQueue[str | None] = SimpleQueue()

    def read() -> None:
        for line in sys.stdin:
            typed.put(line)
        typed.put(None)

    threading.Thread(target=read, name="stdin", daemon=True).start()
    return typed


@contextmanager
def _shown(asked: OnBoard) -> "Iterator[Callable[[Progress], None]]":
    """A bar on stderr with the error so far; a line a spot where that is no terminal, or a person is asked there."""
    if asked.nudge or not sys.stderr.isatty():
        yield lambda progress: _say(f"spot {progress.spots} of at most {asked.spots_max}: {_words(progress, asked)}")
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("spots"), BarColumn(), TextColumn("{task.completed:.0f} of {task.total:.0f}"))
    told = (TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, *told, console=Console(stderr=True)) as shown:
        task = shown.add_task("", total=asked.spots_max)
        yield lambda progress: shown.update(task, completed=progress.spots, description=_words(progress, asked))


def _words(progress: "Progress", asked: OnBoard) -> str:
    outliers = f", {progress.outliers} taken for false" if progress.outliers else ""
    return f"error {m_to_um(progress.sure_m):.1f} µm rms at most, goal {asked.goal_um:g}{outliers}"
