"""The two ways of a screen reader's bytes: a serial port that is a pseudo-terminal, and a socket on this computer."""

import os
import socket
import termios
import time
from contextlib import suppress
from pathlib import Path
from typing import Protocol

from optodrive.client.brlapi import CellPage
from optodrive.core.errors import InputError
from optodrive.link.simulator.pseudo_terminal import check_link_path, open_pty, remove_link

READ_BYTES = 4096
MISSING_READER_S = 0.05
"""Wait for a reader of a serial port, whose absence ends each wait for its bytes at once."""
HOST, FIRST_PORT, LAST_NUMBER = "127.0.0.1", 4101, 65_535 - 4101
"""Address of BrlAPI's server 0 by TCP; server N has the N-th port after it."""


class ReaderChannel(Protocol):
    """A port or a server that a screen reader opens."""

    def list_descriptors(self) -> list[int]:
        """Return the descriptors to wait for."""

    def receive(self) -> bytes | None:
        """Return the bytes that have arrived. None: a reader is gone, or there is none."""

    def send(self, data: bytes) -> None:
        """Send bytes to the reader. One that does not read loses the rest."""

    def close(self) -> None:
        """Close it, and remove its name."""


class SerialChannel:
    """A serial port that is a pseudo-terminal.

    This process closes the reader's end: a hang-up therefore means that no reader has the port open.
    """

    def __init__(self, link: Path) -> None:
        """Create the port. link: its name. Raises InputError if it cannot be created."""
        check_link_path("PORT", link)
        self._link, self._terminal = link, open_pty(link)
        self._name = link.readlink()
        self._attributes = termios.tcgetattr(self._terminal)

    def list_descriptors(self) -> list[int]:
        """See ReaderChannel."""
        return [self._terminal]

    def receive(self) -> bytes | None:
        """See ReaderChannel. The port's settings are restored for the next reader.

        The C library refuses settings of which a pseudo-terminal takes none: those of a reader before it, with parity.
        """
        try:
            return os.read(self._terminal, READ_BYTES)
        except BlockingIOError:
            return b""
        except OSError:  # hang-up
            termios.tcsetattr(self._terminal, termios.TCSANOW, self._attributes)
            time.sleep(MISSING_READER_S)
            return None

    def send(self, data: bytes) -> None:
        """See ReaderChannel."""
        with suppress(BlockingIOError):
            os.write(self._terminal, data)

    def close(self) -> None:
        """See ReaderChannel."""
        remove_link(self._link, self._name)
        os.close(self._terminal)


class SocketChannel:
    """A server of BrlAPI for one client: the next one takes the place of one that has not proved its right."""

    def __init__(self, number: int, page: CellPage) -> None:
        """Open the server of this number. Raises InputError if its port is taken.

        page: answers the clients
        """
        self._page = page
        self._client: socket.socket | None = None
        try:
            self._server = socket.create_server((HOST, FIRST_PORT + number))
        except OSError:
            raise InputError("PORT", number, "the number of a server whose port is free") from None
        self._server.setblocking(False)

    def list_descriptors(self) -> list[int]:
        """See ReaderChannel."""
        return [each.fileno() for each in (self._server, self._client) if each]

    def receive(self) -> bytes | None:
        """See ReaderChannel."""
        with suppress(BlockingIOError):
            client, _ = self._server.accept()
            if self._client and self._page.has_reader:
                client.close()
                return b""
            self._leave()
            client.setblocking(False)
            self._client = client
            self.send(self._page.greeting)
            return None
        if self._client is None:
            return None
        try:
            data = self._client.recv(READ_BYTES)
        except BlockingIOError:
            return b""
        except OSError:
            data = b""
        if not data:
            self._leave()
        return data or None

    def send(self, data: bytes) -> None:
        """See ReaderChannel."""
        if self._client:
            with suppress(OSError):  # it does not read, or is gone
                self._client.sendall(data)

    def close(self) -> None:
        """See ReaderChannel."""
        self._leave()
        self._server.close()

    def _leave(self) -> None:
        if self._client:
            self._client.close()
        self._client = None


def parse_number(text: str) -> int:
    """Return the number of a server of BrlAPI. Raise InputError for other text."""
    if not text.isdecimal() or int(text) > LAST_NUMBER:
        raise InputError("PORT", text, f"the number of a server of BrlAPI, 0 to {LAST_NUMBER}")
    return int(text)


def read_key(path: Path) -> bytes:
    """Return the key of a file. Raise InputError if there is none."""
    try:
        key = path.read_bytes()
    except OSError as error:
        raise InputError("--key-file", str(path), f"a file that can be read: {error.strerror}") from None
    if not key:
        raise InputError("--key-file", str(path), "a file that is not empty")
    return key
