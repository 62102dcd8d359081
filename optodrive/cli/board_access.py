"""Exclusive access to the configured board and its spot sensor, for `home` and the calibrations on the board."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, NamedTuple

import typer

from optodrive.cli.output import announce_compilation
from optodrive.cli.signals import defer_interruption, end_as_interrupted
from optodrive.core.errors import MISSING, InputError, LinkError

if TYPE_CHECKING:
    from optodrive.lab.commissioning.exclusive_board import ExclusiveBoard
    from optodrive.lab.commissioning.sensor import SensorReader

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
