"""Interface of all transports, to real and simulated boards alike."""

from collections.abc import Callable
from typing import NamedTuple, Protocol

from optodrive.link.transport.port_settings import PortSettings


class Transport(Protocol):
    """Byte stream to a board. All methods raise LinkError when the link fails."""

    name: str

    def open(self) -> None:
        """Open the link exclusively. Raise InputError if the configured device does not exist."""

    def read(self, timeout_s: float) -> bytes:
        """Return the bytes that have arrived. Wait at most timeout_s for the first."""

    def write(self, data: bytes) -> None:
        """Hand all of data to the operating system."""

    def fileno(self) -> int | None:
        """Return a descriptor that is readable when bytes have arrived, None if there is none or it is closed."""

    def close(self) -> None:
        """Close the link. It may be opened again. Do nothing if it is closed."""

    def release(self) -> None:
        """Close permanently and stop everything that open() has started."""


class TransportKind(NamedTuple):
    """Kind of transport.

    name: its value of `board.transport`; create: from an address, without opening it
    """

    name: str
    create: Callable[[PortSettings], Transport]
