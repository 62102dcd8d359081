"""Base class of the drivers of laser DACs, which stop their DAC on every path out."""

from abc import ABC, abstractmethod
from contextlib import suppress
from hashlib import sha256
from ipaddress import AddressValueError, IPv6Address
from types import TracebackType
from typing import Any, ClassVar, Self

from optodrive.core.clock import Clock
from optodrive.core.errors import InputError, LinkError
from optodrive.device.config_sections import BoardSection
from optodrive.link.dac.formats.base import Chunk
from optodrive.link.dac.formats.registry import find_format

UID_DIGITS = 24


def build_uid(identity: str) -> str:
    """Return the uid of a board that stands for a DAC's identity."""
    return sha256(identity.encode()).hexdigest()[:UID_DIGITS]


class LaserDac(ABC):
    """One laser DAC.

    open() and close(), and leaving the context for any reason, stop it and switch its light off.
    name, firmware: what it says of itself, known after open()
    identity: what tells it from all others of its kind and nobody can change, None if it does not say, after open();
    of an Ether Dream after find_identity()
    """

    transport: ClassVar[str]

    def __init__(self, board: BoardSection, clock: Clock) -> None:
        self.board = board
        self.format = find_format(self.transport)(board.points_per_s)
        self.name = self.format.label
        self.firmware = ""
        self.identity: str | None = None
        self._clock = clock
        self._link: Any = None
        """The open connection, of the kind that the driver uses."""

    def __enter__(self) -> Self:
        """Open the DAC."""
        self.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the DAC. An error of closing does not replace an error of the block."""
        if error is None:
            self.close()
        else:
            with suppress(LinkError):
                self.close()

    @abstractmethod
    def open(self) -> None:
        """Connect to the DAC, identify and stop it.

        Raise InputError if it is not the configured one, LinkError if the link fails.
        """

    def find_identity(self) -> str | None:
        """Return the identity of the open DAC. Wait for it where it comes by itself."""
        return self.identity

    def find_uid(self) -> str | None:
        """Return the identity of the open DAC as a board's uid, 24 hexadecimal digits, None if it does not say."""
        identity = self.find_identity()
        return build_uid(identity) if identity else None

    def close(self) -> None:
        """Stop and release the DAC. Raise LinkError if it may not have received the stop. Do nothing if closed."""
        if self._link is None:
            return
        try:
            self.stop()
        finally:
            self._release()

    def _release(self) -> None:
        """Close the connection, if there is one."""
        link, self._link = self._link, None
        if link is not None:
            with suppress(OSError):
                link.close()

    @abstractmethod
    def stop(self) -> None:
        """Stop playback, switch the light off and wait until the DAC accepts points again.

        Raise LinkError if it may not have received a command.
        """

    def start(self) -> None:
        """Permit emission. Raise InputError unless the configuration declares an external interlock."""
        self.require_interlock()
        self._start()

    @abstractmethod
    def _start(self) -> None:
        """Permit emission."""

    @abstractmethod
    def is_ready(self) -> bool:
        """Return whether the DAC accepts another chunk. A missing or unexpected answer counts as not ready."""

    def send(self, chunk: Chunk) -> None:
        """Send one chunk. The DAC must be ready.

        Raise InputError unless the configuration declares an external interlock, LocalProtocolError for a chunk that
        could leave the laser on, and LinkError if the DAC does not accept the whole chunk.
        """
        self.require_interlock()
        self._send(self.format.check(chunk.data))

    @abstractmethod
    def _send(self, chunk: Chunk) -> None:
        """Send one chunk that is safe."""

    def require_interlock(self) -> None:
        """Raise InputError unless the configuration declares an external interlock."""
        if self.board.transport != self.transport or not self.board.interlock_watched:
            raise InputError(
                "board.interlock_watched",
                self.board.interlock_watched,
                f'true, with transport "{self.transport}": it has no interlock, so an external one must cut the laser',
            )


def parse_address(text: str, default_port: int) -> tuple[str, int]:
    """Return host and port of `host`, `host:port`, or an IPv4 address written as IPv6. Raise InputError if it is none.

    These devices speak IPv4 only.
    """
    if text.startswith("["):
        host, _, port = text[1:].partition("]")
        port = port.removeprefix(":")
    elif text.count(":") > 1:
        host, port = text, ""
    else:
        host, _, port = text.partition(":")
    if ":" in host:
        try:
            host = str(IPv6Address(host).ipv4_mapped or "")
        except AddressValueError:
            host = ""
    if not host or (port and not (port.isascii() and port.isdigit() and 0 < int(port) < 65_536)):
        raise InputError("board.port", text, 'the DAC\'s IPv4 address, for example "192.168.1.20"')
    return host, int(port) if port else default_port
