"""Transports by the name the configuration gives."""

from collections.abc import Callable

from optodrive.transport.base import Transport
from optodrive.transport.serial_port import SerialPort
from optodrive.transport.simulated import SimulatedBoard

TRANSPORTS: dict[str, Callable[[str, int], Transport]] = {"serial": SerialPort, "simulated": SimulatedBoard}


def make_transport(kind: str, port: str, baud: int) -> Transport:
    """A transport, not yet open."""
    return TRANSPORTS[kind](port, baud)
