"""What `home` and `calibrate` hold: the configured board, its sensor, and signals that end both as Ctrl-C does."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, NamedTuple

from optodrive.cli.options import announce_compilation
from optodrive.errors import LinkError

if TYPE_CHECKING:
    from optodrive.commissioning.held import HeldBoard
    from optodrive.commissioning.seeing import Eyes

SENSOR_BAUD = 115_200


class Bench(NamedTuple):
    """A board, not yet connected, and what sees the spot, None without a sensor."""

    held: "HeldBoard"
    eyes: "Eyes | None"


@contextmanager
def bench(config: str | None) -> Iterator[Bench]:
    """The configured board and sensor; told to abort and closed whatever happens within."""
    from optodrive.board.spot_sensor import SpotSensor
    from optodrive.clock import MonotonicClock
    from optodrive.commissioning.held import HeldBoard
    from optodrive.commissioning.seeing import Eyes
    from optodrive.config import DEFAULT_CONFIG, load_config
    from optodrive.pipeline import Display
    from optodrive.transport.registry import make_bench
    from optodrive.transport.serial_port import SerialPort

    loaded = load_config(config)
    # Aimed by nominal numbers: a field that is no good any more must not keep anyone from measuring a new one.
    loaded = loaded.model_copy(update={"scanner": loaded.scanner.model_copy(update={"field": None})})
    announce_compilation()
    board, clock = loaded.board, MonotonicClock()
    transport, sensor_port = make_bench(board, config or DEFAULT_CONFIG)
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.default_int_handler)
    with HeldBoard(Display.of(loaded), transport, clock) as held:
        eyes = None
        if loaded.sensor is not None or sensor_port:
            port, baud = (loaded.sensor.port, loaded.sensor.baud) if loaded.sensor else (sensor_port, SENSOR_BAUD)
            eyes = Eyes(held, SpotSensor(SerialPort(port, baud, "sensor.port")), clock)
        try:
            yield Bench(held, eyes)
        except LinkError as error:
            if "cannot be opened" in str(error):
                raise LinkError(f"{error} `optodrive serve` does as long as it runs: end it first") from None
            raise
        finally:
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
                signal.signal(number, signal.SIG_IGN)  # on the way out nothing comes between board and ABORT
            if eyes is not None:
                eyes.close()
