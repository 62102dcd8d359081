"""`optodrive calibrate board`: measure spots on the board with a sensor or by eye, and fit a field to them."""

import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING, Annotated

import typer

from optodrive.cli.calibrate.field import (
    FieldCalibration,
    ReportOption,
    check_calibration_outputs,
    write_calibration,
)
from optodrive.cli.commissioning import confirm_emission
from optodrive.cli.options import ConfigOption, JsonOption, StageOption
from optodrive.core.errors import MISSING, InputError
from optodrive.core.quantity import m_to_um, um_to_m

if TYPE_CHECKING:
    from optodrive.lab.commissioning.measurement_loop import MeasurementProgress
if TYPE_CHECKING:
    from optodrive.lab.commissioning.measurement_loop import MeasurementResult


def print_status(message: str) -> None:
    """Print a line on stderr without buffering."""
    print(message, file=sys.stderr, flush=True)


@contextmanager
def show_measurement_progress(
    spots_max: int, target_rms_um: float, manual: bool
) -> "Iterator[Callable[[MeasurementProgress], None]]":
    """Show a bar with the error bound, or one line per spot where stderr is no terminal or prompts a person."""
    if manual or not sys.stderr.isatty():
        yield lambda progress: print_status(
            f"spot {progress.spots} of max {spots_max}: {_format_progress(progress, target_rms_um)}"
        )
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("spots"), BarColumn(), TextColumn("{task.completed:.0f} of {task.total:.0f}"))
    status_columns = (TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, *status_columns, console=Console(stderr=True)) as bar:
        task = bar.add_task("", total=spots_max)
        yield lambda progress: bar.update(
            task, completed=progress.spots, description=_format_progress(progress, target_rms_um)
        )


def _format_progress(progress: "MeasurementProgress", target_rms_um: float) -> str:
    outliers = f", {progress.outliers} outliers" if progress.outliers else ""
    return f"error bound {m_to_um(progress.error_bound_m):.1f} µm rms, target {target_rms_um:g} µm{outliers}"


DEFAULT_FIELD_FILE = Path("field.toml")
SPOTS_MIN, SPOTS_LIMIT = 9, 1000
READINGS_LIMIT = 100


@dataclass(frozen=True)
class BoardCalibrationRequest:
    """Validated options of a calibration on the board."""

    manual: bool
    target_rms_um: float
    spots_max: int
    readings: int
    spot_power_mw: float

    def __post_init__(self) -> None:
        if not self.target_rms_um > 0.0:
            raise InputError("--target-rms-um", self.target_rms_um, "more than 0")
        if not SPOTS_MIN <= self.spots_max <= SPOTS_LIMIT:
            raise InputError("--spots-max", self.spots_max, f"{SPOTS_MIN} to {SPOTS_LIMIT}")
        if not 1 <= self.readings <= READINGS_LIMIT:
            raise InputError("--readings", self.readings, f"1 to {READINGS_LIMIT}")


def board(
    out: Annotated[
        Path, typer.Option("--out", metavar="field.toml", help="Write the calibrated field.")
    ] = DEFAULT_FIELD_FILE,
    report: ReportOption = None,
    manual: Annotated[
        bool, typer.Option("--manual", help="Without a sensor: move the spot onto each mark by eye.")
    ] = False,
    target_rms_um: Annotated[
        float, typer.Option("--target-rms-um", help="Stop when the 90 % bound of the field's rms error is below this.")
    ] = 10.0,
    spots_max: Annotated[int, typer.Option("--spots-max", help="Maximum number of spots.")] = 25,
    readings: Annotated[int, typer.Option("--readings", help="Sensor readings per spot.")] = 3,
    spot_power_mw: Annotated[
        float, typer.Option("--spot-power-mw", metavar="POWER_MW", help="Power of the spot.")
    ] = 5.0,
    yes: Annotated[bool, typer.Option("--yes", help="Arm and emit without asking.")] = False,
    config: ConfigOption = None,
    stage: StageOption = None,
    json: JsonOption = False,
) -> None:
    """Measure spots on the board with a sensor or by eye, and fit the field to them."""
    from optodrive.core.files import check_output

    check_calibration_outputs(out, report)
    check_output("--out", spots_path_for(out))
    request = BoardCalibrationRequest(manual, target_rms_um, spots_max, readings, spot_power_mw)
    places = f"up to {spots_max} places with a spot of {spot_power_mw:g} mW"
    confirm_emission(yes, f"this arms the board, lights {places}, and writes {out}")
    write_calibration(calibrate_on_board(config, stage, out, request), out, report, json)
    delete_session(out)


def calibrate_on_board(
    config: str | None, stage: str | None, out: Path, request: BoardCalibrationRequest
) -> FieldCalibration:
    """Measure spots, fit a field, and write the spots beside `out` as input of `calibrate field`."""
    from optodrive.lab.calibration.spots import write_spots

    measured = measure_on_board(config, stage, out, request)
    path = spots_path_for(out)
    write_spots(path, measured.fit.spots, measured.fit.prior.display)
    return FieldCalibration(
        measured.fit, path, build_board_stats(measured, request, path), format_board_stats(measured, request, path)
    )


def spots_path_for(out: Path) -> Path:
    """Return the path of an output file's spots."""
    return out.with_suffix(".spots.csv")


def delete_session(out: Path) -> None:
    """Delete the session of an output file, so that the next calibration starts without spots."""
    from optodrive.lab.commissioning.measurement_loop import session_path_for

    session_path_for(out).unlink(missing_ok=True)


def measure_on_board(
    config: str | None, stage: str | None, out: Path, request: BoardCalibrationRequest
) -> "MeasurementResult":
    """Arm the board, measure spots and fit them. The board ends with the gate off and disarmed in every case.

    The session file beside `out` receives every spot before the next one. Raises InputError for options that cannot
    be used, and LinkError, BoardFaultError or RefusedError where the measurement fails.
    """
    from optodrive.cli.commissioning import open_board
    from optodrive.core.clock import MonotonicClock
    from optodrive.core.worker_process import WorkerProcess
    from optodrive.lab.calibration.spots import FieldPrior
    from optodrive.lab.commissioning.exclusive_board import check_spot_power
    from optodrive.lab.commissioning.measurement_loop import CalibrationSession, MeasurementLoop, fit_and_warm_up
    from optodrive.lab.commissioning.spot_locator import ManualLocator, SensorLocator

    power_w, target_rms_m = request.spot_power_mw * 1e-3, um_to_m(request.target_rms_um)
    # The board closes first on exit: it receives ABORT before the worker process is joined.
    with WorkerProcess() as worker, open_board(config, stage=stage) as (exclusive_board, sensor_reader):
        check_spot_power(exclusive_board.config, power_w)
        session = CalibrationSession.load_or_create(out, exclusive_board.config)
        if not request.manual and sensor_reader is None:
            raise InputError(
                "sensor.port", MISSING, "a spot sensor in the configuration; without one, --manual", "no_port"
            )
        if session.rows:
            print_status(
                f"optodrive: resuming with {len(session.rows)} spots of {session.path}; delete it to start again"
            )
        worker.submit(fit_and_warm_up, session.spots, FieldPrior.from_config(exclusive_board.config))
        worker.result()  # compiles and loads the fit before the lease is running
        exclusive_board.connect()
        if request.manual or sensor_reader is None:
            locator: ManualLocator | SensorLocator = ManualLocator(
                exclusive_board, power_w, _read_stdin_lines(), print_status
            )
        else:
            sensor_reader.open()
            locator = SensorLocator(exclusive_board, sensor_reader, power_w, request.readings)
        print_status("optodrive: arming, the board's indicator is on for two seconds first")
        exclusive_board.arm()
        with show_measurement_progress(request.spots_max, request.target_rms_um, request.manual) as on_progress:
            measured = MeasurementLoop(
                exclusive_board, locator, session, worker, MonotonicClock(), target_rms_m, request.spots_max
            ).run(on_progress)
        exclusive_board.disarm()
    return measured


def build_board_stats(
    measured: "MeasurementResult", request: BoardCalibrationRequest, spots_file: Path
) -> dict[str, object]:
    """Build the statistics that the measurement adds to those of the fit, for --json."""
    return {
        "method": "manual" if request.manual else "sensor",
        "readings": 1 if request.manual else request.readings,
        "predicted_rms_um": round(m_to_um(measured.predicted_error_m), 3),
        "predicted_rms_p90_um": round(m_to_um(measured.error_bound_m), 3),
        "target_rms_um": request.target_rms_um,
        "target_reached": measured.target_reached,
        "spots_file": str(spots_file),
    }


def format_board_stats(
    measured: "MeasurementResult", request: BoardCalibrationRequest, spots_file: Path
) -> tuple[str, ...]:
    """Format the statistics of the measurement as text lines."""
    reached = "reached" if measured.target_reached else f"not reached with {len(measured.fit.spots)} spots"
    return (
        f"predicted        {m_to_um(measured.predicted_error_m):.1f} µm rms over the display, "
        f"90 % bound {m_to_um(measured.error_bound_m):.1f} µm",
        f"target           {request.target_rms_um:g} µm: {reached}",
        f"spots written    {spots_file}",
    )


def _read_stdin_lines() -> "SimpleQueue[str | None]":
    """Queue the lines of stdin, then None. A thread blocks on stdin, so that the lease is renewed meanwhile."""
    lines: SimpleQueue[str | None] = SimpleQueue()

    def read() -> None:
        for line in sys.stdin:
            lines.put(line)
        lines.put(None)

    threading.Thread(target=read, name="stdin", daemon=True).start()
    return lines
