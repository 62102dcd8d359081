"""Commands that work on the board step by step: `optodrive home` and `optodrive first-light`.

`home` centres the mirrors and checks the board's inputs and outputs before any light is emitted; `first-light` emits
single weak pulses at the centre of the display, for the first time with the laser. Their output is a line per step, or
one JSON document at the end.
"""

import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

from optodrive.cli.options import ConfigOption, JsonOption, StageOption
from optodrive.cli.output import announce_compilation, print_json
from optodrive.cli.signals import defer_interruption, end_as_interrupted
from optodrive.core.errors import MISSING, InputError, LinkError, OptodriveError
from optodrive.core.quantity import format_quantity

if TYPE_CHECKING:
    from optodrive.lab.commissioning.exclusive_board import ExclusiveBoard
    from optodrive.lab.commissioning.sensor import SensorReader
if TYPE_CHECKING:
    from optodrive.lab.commissioning.homing import HomingResult


SENSOR_BAUD = 115_200


def confirm_emission(confirmed: bool, action: str) -> None:
    """Ask on the terminal whether the laser may emit. Do nothing if that is confirmed already.

    action: what the command is about to do. Raises InputError without a terminal to ask on, typer.Abort for a no.
    """
    if confirmed:
        return
    if not sys.stdin.isatty():
        raise InputError("--yes", MISSING, f"--yes, because without a terminal nobody can confirm: {action}")
    typer.confirm(f"optodrive: {action}. Continue?", abort=True, err=True)


class BoardAccess(NamedTuple):
    """A board that is not yet connected, and the reader of its spot sensor, None without a sensor."""

    board: "ExclusiveBoard"
    sensor_reader: "SensorReader | None"


def _report_heat(text: str) -> None:
    print(f"optodrive: {text}; until then it waits before light that would be too much", file=sys.stderr)


@contextmanager
def open_board(config: str | None, calibrated_field: bool = False, stage: str | None = None) -> Iterator[BoardAccess]:
    """Open the configured board and sensor. On exit, send ABORT and close both.

    stage: name of the stage whose board it is, None for the only one
    calibrated_field: aim by the field of the configuration; by default by the nominal one, for an invalid field.toml
    must not prevent a new calibration.
    SIGTERM and SIGHUP end the block like Ctrl-C. Raises InputError for a configuration that cannot be used, and
    LinkError where a port cannot be opened.
    """
    from optodrive.core.clock import MonotonicClock
    from optodrive.device.config_file import DEFAULT_CONFIG, load_config
    from optodrive.lab.commissioning.exclusive_board import ExclusiveBoard
    from optodrive.lab.commissioning.sensor import SensorReader, SpotSensorClient
    from optodrive.link.board_setup import build_port_settings
    from optodrive.link.transport.registry import build_bench_transport
    from optodrive.link.transport.serial_port import SerialPort
    from optodrive.planning.display_model import DisplayModel

    loaded = load_config(config)
    is_part, loaded = len(loaded.stages) > 1, loaded.select_stage(stage)
    if not calibrated_field:
        loaded = loaded.model_copy(update={"scanner": loaded.scanner.model_copy(update={"field": None})})
    announce_compilation()
    clock = MonotonicClock()
    transport, sensor_port = build_bench_transport(build_port_settings(loaded), config or DEFAULT_CONFIG, stage)
    display = DisplayModel.from_config(loaded)
    with (
        end_as_interrupted(),
        loaded.name_file(),
        defer_interruption() as defer,
        ExclusiveBoard(display, transport, clock, is_part, _report_heat) as exclusive_board,
    ):
        sensor_reader = None
        if loaded.sensor is not None or sensor_port:
            port, baud = (loaded.sensor.port, loaded.sensor.baud) if loaded.sensor else (sensor_port, SENSOR_BAUD)
            sensor_reader = SensorReader(
                exclusive_board, SpotSensorClient(SerialPort(port, baud, "sensor.port")), clock
            )
        try:
            yield BoardAccess(exclusive_board, sensor_reader)
        except LinkError as error:
            if "cannot be opened" in str(error):
                raise LinkError(f"{error} A running `optodrive serve` holds the port: stop it first") from None
            raise
        finally:
            defer()  # no signal may interrupt the ABORT
            if sensor_reader is not None:
                sensor_reader.close()


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


def home(
    config: ConfigOption = None,
    stage: StageOption = None,
    spot_power_mw: Annotated[
        float, typer.Option("--spot-power-mw", metavar="POWER_MW", min=0.0, help="Power of the spot; 0: gate off.")
    ] = 0.0,
    acknowledge: Annotated[
        bool,
        typer.Option("--acknowledge", help="Acknowledge a fault that the board still shows; its cause must be gone."),
    ] = False,
    json: JsonOption = False,
) -> None:
    """Centre the mirrors. Check travel, position outputs, interlock, key, emergency stop and indicator."""
    from optodrive.cli.commissioning import open_board
    from optodrive.lab.commissioning.exclusive_board import check_spot_power
    from optodrive.lab.commissioning.homing import Homing

    with report_steps("home", json) as report_step, open_board(config, stage=stage) as (board, sensor_reader):
        if spot_power_mw:
            check_spot_power(board.config, spot_power_mw * 1e-3)
        Homing(board, sensor_reader, spot_power_mw * 1e-3, acknowledge).run(report_step)


def first_light(
    power_mw: Annotated[
        float | None,
        typer.Option("--power-mw", metavar="POWER_MW", help="Incident power of a pulse; default: 1 % of the laser's."),
    ] = None,
    pulses: Annotated[int, typer.Option("--pulses", help="Number of pulses of 20 ms, one per second.")] = 1,
    acknowledge: Annotated[
        bool,
        typer.Option("--acknowledge", help="Acknowledge a fault that the board still shows; its cause must be gone."),
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Arm and emit without asking.")] = False,
    config: ConfigOption = None,
    stage: StageOption = None,
    json: JsonOption = False,
) -> None:
    """Check the board, centre the mirrors and emit single weak pulses there. The board ends disarmed in every case."""
    from optodrive.cli.commissioning import open_board
    from optodrive.device.config_file import load_config
    from optodrive.lab.commissioning.exclusive_board import build_spot, check_spot_power
    from optodrive.lab.commissioning.homing import PULSES_MAX, default_power_w, emit_first_light

    loaded = load_config(config).select_stage(stage)
    power_w = default_power_w(loaded) if power_mw is None else power_mw * 1e-3
    check_spot_power(loaded, power_w, "--power-mw")
    if not 1 <= pulses <= PULSES_MAX:
        raise InputError("--pulses", pulses, f"1 to {PULSES_MAX}")
    spot = build_spot(loaded, power_w)
    share = f"{spot.power_w / loaded.laser.max_power_w:.2%} of full power"
    light = f"{format_quantity(spot.power_w, 'W')} ({share}) for {format_quantity(spot.width_s, 's')}"
    confirm_emission(
        yes,
        f"this arms the board and emits {pulses} pulse{'s' if pulses > 1 else ''} of {light} at the centre of the "
        "display. The enclosure is closed, the beam ends on the display or in a beam dump, and goggles are on",
    )
    with (
        report_steps("first_light", json, spot._asdict()) as report_step,
        open_board(config, stage=stage) as (board, _),
    ):
        emit_first_light(board, power_w, pulses, acknowledge, report_step)
