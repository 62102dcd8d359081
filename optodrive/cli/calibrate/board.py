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
    from optodrive.lab.commissioning.measurement_loop import MeasurementProgress, MeasurementResult

ManualOption = Annotated[bool, typer.Option("--nudge", help="No sensor: a person moves the spot onto each mark.")]
TargetErrorOption = Annotated[float, typer.Option("--goal-um", help="Stop when the field is surely this good, rms.")]
SpotsMaxOption = Annotated[int, typer.Option("--spots-max", help="Stop after so many spots at the latest.")]
ReadingsOption = Annotated[int, typer.Option("--readings", help="Of each spot: the sensor looks so often.")]
SpotPowerOption = Annotated[
    float, typer.Option("--spot", metavar="POWER_MW", help="Power of the spot while it is lit.")
]
DEFAULT_FIELD_FILE = Path("field.toml")
SPOTS_MIN, SPOTS_LIMIT = 9, 1000
READINGS_LIMIT = 100


@dataclass(frozen=True)
class BoardCalibrationRequest:
    """What is asked of a calibration on the board."""

    manual: bool = False
    target_rms_um: float = 10.0
    spots_max: int = 25
    readings: int = 3
    spot_power_mw: float = 5.0

    def __post_init__(self) -> None:
        if not self.target_rms_um > 0.0:
            raise InputError("--goal-um", self.target_rms_um, "more than 0")
        if not SPOTS_MIN <= self.spots_max <= SPOTS_LIMIT:
            raise InputError("--spots-max", self.spots_max, f"{SPOTS_MIN} to {SPOTS_LIMIT}")
        if not 1 <= self.readings <= READINGS_LIMIT:
            raise InputError("--readings", self.readings, f"1 to {READINGS_LIMIT}")


@dataclass(frozen=True)
class CalibrationResult:
    """What came of it: the fit, the file its spots are kept in, and what there is to say beside the fit's own words."""

    fit: "FieldFit"
    spots: Path
    stats: dict[str, object]
    report_lines: tuple[str, ...]


def calibrate_on_board(config: str | None, out: Path, request: BoardCalibrationRequest) -> CalibrationResult:
    """Measure, and keep the spots beside `out` as a file that --spots takes."""
    from optodrive.lab.calibration.spots import write_spots

    measured = measure_on_board(config, out, request)
    path = out.with_suffix(".spots.csv")
    write_spots(path, measured.fit.spots)
    return CalibrationResult(
        measured.fit, path, build_stats(measured, request, path), format_stats(measured, request, path)
    )


def delete_session(out: Path) -> None:
    """All is written: the next calibration begins anew."""
    from optodrive.lab.commissioning.session_file import session_path_for

    session_path_for(out).unlink(missing_ok=True)


def measure_on_board(config: str | None, out: Path, request: BoardCalibrationRequest) -> "MeasurementResult":
    """Arm, measure, fit; the board ends dark and disarmed in any case.

    Every spot is kept in a session beside out, which goes when what came of it is written.
    """
    from optodrive.cli.board_access import open_board
    from optodrive.core.clock import MonotonicClock
    from optodrive.lab.calibration.field_prior import FieldPrior
    from optodrive.lab.commissioning.exclusive_board import check_spot_power
    from optodrive.lab.commissioning.measurement_loop import MeasurementLoop, fit_and_warm_up
    from optodrive.lab.commissioning.session_file import CalibrationSession
    from optodrive.lab.commissioning.spot_locator import ManualLocator, SensorLocator
    from optodrive.lab.commissioning.worker_process import WorkerProcess

    if not out.absolute().parent.is_dir():
        raise InputError("--out", str(out), "a file in a folder that exists")
    power_w, target_rms_m = request.spot_power_mw * 1e-3, um_to_m(request.target_rms_um)
    # The bench is left first: the board is told to abort before anything is waited for.
    with WorkerProcess() as worker, open_board(config) as (board, spot_reader):
        check_spot_power(board.config, power_w)
        session = CalibrationSession.load_or_create(out, board.config)
        if not request.manual and spot_reader is None:
            raise InputError("sensor.port", None, "a spot sensor in the configuration; without one, --nudge", "no_port")
        if session.rows:
            _print_status(
                f"optodrive: going on with {len(session.rows)} spots of {session.path}; delete it to begin anew"
            )
        worker.submit(fit_and_warm_up, session.spots, FieldPrior.from_config(board.config))
        worker.result()  # loaded before the board is held
        board.connect()
        if request.manual or spot_reader is None:
            locator: ManualLocator | SensorLocator = ManualLocator(board, power_w, _read_stdin_lines(), _print_status)
        else:
            spot_reader.open()
            locator = SensorLocator(board, spot_reader, power_w, request.readings)
        _print_status("optodrive: arming, the board's indicator is lit for two seconds first")
        board.arm()
        with _report_progress(request) as on_progress:
            measured = MeasurementLoop(
                board, locator, session, worker, MonotonicClock(), target_rms_m, request.spots_max
            ).run(on_progress)
        board.disarm()
    return measured


def build_stats(measured: "MeasurementResult", request: BoardCalibrationRequest, spots_file: Path) -> dict[str, object]:
    """What the loop itself has to say, for --json."""
    return {
        "looked": "nudge" if request.manual else "sensor",
        "readings": 1 if request.manual else request.readings,
        "predicted_rms_um": round(m_to_um(measured.predicted_error_m), 3),
        "sure_rms_um": round(m_to_um(measured.error_bound_m), 3),
        "goal_um": request.target_rms_um,
        "goal_reached": measured.target_reached,
        "spots_file": str(spots_file),
    }


def format_stats(measured: "MeasurementResult", request: BoardCalibrationRequest, spots_file: Path) -> tuple[str, ...]:
    """The same in words."""
    spots, upper_bound_um = len(measured.fit.spots), m_to_um(measured.error_bound_m)
    reached = "reached" if measured.target_reached else f"not reached with {spots} spots"
    return (
        f"predicted        {m_to_um(measured.predicted_error_m):.1f} µm rms over the display, nine times in ten at most "
        f"{upper_bound_um:.1f} µm",
        f"goal             {request.target_rms_um:g} µm: {reached}",
        f"spots kept       {spots_file}",
    )


def _print_status(message: str) -> None:
    print(message, file=sys.stderr, flush=True)


def _read_stdin_lines() -> "SimpleQueue[str | None]":
    """Lines of stdin as they come, None at its end; a thread waits for them, so that the lease is kept."""
    queue: SimpleQueue[str | None] = SimpleQueue()

    def read() -> None:
        for line in sys.stdin:
            queue.put(line)
        queue.put(None)

    threading.Thread(target=read, name="stdin", daemon=True).start()
    return queue


@contextmanager
def _report_progress(request: BoardCalibrationRequest) -> "Iterator[Callable[[MeasurementProgress], None]]":
    """A bar on stderr with the error so far; a line a spot where that is no terminal, or a person is asked there."""
    if request.manual or not sys.stderr.isatty():
        yield lambda progress: _print_status(
            f"spot {progress.spots} of at most {request.spots_max}: {_format_progress(progress, request)}"
        )
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("spots"), BarColumn(), TextColumn("{task.completed:.0f} of {task.total:.0f}"))
    status_columns = (TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, *status_columns, console=Console(stderr=True)) as bar:
        task = bar.add_task("", total=request.spots_max)
        yield lambda progress: bar.update(
            task, completed=progress.spots, description=_format_progress(progress, request)
        )


def _format_progress(progress: "MeasurementProgress", request: BoardCalibrationRequest) -> str:
    outliers = f", {progress.outliers} taken for false" if progress.outliers else ""
    return f"error {m_to_um(progress.error_bound_m):.1f} µm rms at most, goal {request.target_rms_um:g}{outliers}"
