"""Transports by their name in the configuration."""

from collections.abc import Callable
from functools import partial

from optodrive.core.errors import InputError
from optodrive.device.config import BoardSection
from optodrive.link.transport.base import Transport
from optodrive.link.transport.serial_port import SerialPort
from optodrive.link.transport.simulated import SimulatedBoard
from optodrive.link.transport.usb_bulk import UsbBulk

TRANSPORTS: dict[str, Callable[[BoardSection], Transport]] = {
    "serial": lambda board: SerialPort(board.port, board.baud),
    "simulated": lambda board: SimulatedBoard(board.port, board.baud),
    "usb": UsbBulk.from_config,
}


def find_transport_factory(board: BoardSection) -> Callable[[], Transport]:
    """Return a factory for the configured transport, which it does not open.

    Raise InputError for a Helios, which does not use the board's protocol.
    """
    if board.transport not in TRANSPORTS:
        raise InputError(
            "board.transport",
            board.transport,
            f"one of {', '.join(TRANSPORTS)}: the daemon cannot use a Helios, see `optodrive helios play`",
        )
    return partial(TRANSPORTS[board.transport], board)


def build_bench_transport(board: BoardSection, display: str) -> tuple[Transport, str]:
    """Return an unopened transport and the port of its simulated spot sensor, '' without one.

    display: file or shipped name of the configuration
    """
    if board.transport == "simulated":
        simulated = SimulatedBoard(board.port, board.baud, display)
        return simulated, simulated.sensor_port
    return find_transport_factory(board)(), ""
