"""What `home` and `calibrate` hold: the configured board, its sensor, and signals that end both as Ctrl-C does."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, NamedTuple

from optodrive.cli.options import announce_compilation
from optodrive.core.errors import LinkError

if TYPE_CHECKING:
    from optodrive.lab.commissioning.exclusive_board import ExclusiveBoard
    from optodrive.lab.commissioning.spot_reader import SpotReader

SENSOR_BAUD = 115_200


class BoardAccess(NamedTuple):
    """A board, not yet connected, and what sees the spot, None without a sensor."""

    board: "ExclusiveBoard"
    spot_reader: "SpotReader | None"


@contextmanager
def open_board(config: str | None) -> Iterator[BoardAccess]:
    """The configured board and sensor; told to abort and closed whatever happens within."""
    from optodrive.core.clock import MonotonicClock
    from optodrive.device.config import DEFAULT_CONFIG, load_config
    from optodrive.lab.commissioning.exclusive_board import ExclusiveBoard
    from optodrive.lab.commissioning.spot_reader import SpotReader
    from optodrive.lab.commissioning.spot_sensor_client import SpotSensorClient
    from optodrive.link.transport.registry import build_bench_transport
    from optodrive.link.transport.serial_port import SerialPort
    from optodrive.planning.display_model import DisplayModel

    loaded = load_config(config)
    # Aimed by nominal numbers: a field that is no good any more must not keep anyone from measuring a new one.
    loaded = loaded.model_copy(update={"scanner": loaded.scanner.model_copy(update={"field": None})})
    announce_compilation()
    board, clock = loaded.board, MonotonicClock()
    transport, sensor_port = build_bench_transport(board, config or DEFAULT_CONFIG)
    for signal_number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(signal_number, signal.default_int_handler)
    with ExclusiveBoard(DisplayModel.from_config(loaded), transport, clock) as exclusive_board:
        spot_reader = None
        if loaded.sensor is not None or sensor_port:
            port, baud = (loaded.sensor.port, loaded.sensor.baud) if loaded.sensor else (sensor_port, SENSOR_BAUD)
            spot_reader = SpotReader(exclusive_board, SpotSensorClient(SerialPort(port, baud, "sensor.port")), clock)
        try:
            yield BoardAccess(exclusive_board, spot_reader)
        except LinkError as error:
            if "cannot be opened" in str(error):
                raise LinkError(f"{error} `optodrive serve` does as long as it runs: end it first") from None
            raise
        finally:
            for signal_number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
                signal.signal(signal_number, signal.SIG_IGN)  # on the way out nothing comes between board and ABORT
            if spot_reader is not None:
                spot_reader.close()
