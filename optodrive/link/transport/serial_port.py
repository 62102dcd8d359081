"""Transport over a serial port, with pyserial."""

import errno
import os
import termios
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import serial
from serial.tools import list_ports

from optodrive.core.errors import InputError, LinkError
from optodrive.link.transport.base import TransportKind, guard_opening, guard_port
from optodrive.link.transport.port_state import describe_replug

WRITE_TIMEOUT_S = 0.5
WRITE_RETRY_S = 0.001
SETTING_NAMES = ("input flags", "output flags", "character format", "line mode or echo", "bit rate", "bit rate")
"""What the fields of termios set, in their order."""
PIPES = ("pipe_abort_read_r", "pipe_abort_read_w", "pipe_abort_write_r", "pipe_abort_write_w")


class SerialPort:
    """Serial device, opened exclusively, 8N1. config_key: configuration key of the port, for errors."""

    def __init__(self, port: str, baud: int, config_key: str = "board.port") -> None:
        self.name = port
        self._config_key = config_key
        self._baud = baud
        self._serial: serial.Serial | None = None
        self._settings: list[Any] = []
        self._node: os.stat_result | None = None
        self._unsent = b""
        self._full_since_s: float | None = None

    def open(self) -> None:
        """Open the port.

        Raise InputError if it does not exist or access is denied, LinkError if it is in use.
        """
        with guard_opening(self.name, self._config_key):
            if not Path(self.name).exists():
                present = ", ".join(port.device for port in list_ports.comports()) or "none found"
                raise InputError(self._config_key, self.name, f"a serial port that exists ({present})", "no_port")
            # Exclusive: a second program at the port would take a part of the board's answers.
            self._serial = serial.Serial(
                self.name, self._baud, timeout=0, write_timeout=WRITE_TIMEOUT_S, exclusive=True
            )
            try:
                self._settings = termios.tcgetattr(self._serial.fileno())
                self._node = os.fstat(self._serial.fileno())
            except Exception:
                self.close()
                raise

    def _require_open(self) -> serial.Serial:
        if self._serial is None:
            raise LinkError(f"{self.name} is not open")
        return self._serial

    def read(self, timeout_s: float) -> bytes:
        """Return the bytes that have arrived. Wait at most timeout_s for the first."""
        port = self._require_open()
        with guard_port(self.name):
            if port.timeout != timeout_s:  # setting it costs system calls
                port.timeout = timeout_s
            first: bytes = port.read(1)
            return first + port.read(port.in_waiting) if first else b""

    def write(self, data: bytes) -> None:
        """Hand data to the operating system, now as far as it has room, and the rest at the next calls.

        Raise LinkError if it has no room for all for half a second. A caller that serves several ports never waits
        here: one that accepts nothing would cost the others their leases. pyserial would poll the device after each
        write, which waits for a worker of the kernel.
        """
        port = self._require_open()
        self._unsent += data
        with guard_port(self.name):
            try:
                while self._unsent:
                    self._unsent = self._unsent[os.write(port.fileno(), self._unsent) :]
                self._full_since_s = None
            except BlockingIOError:
                now_s = time.monotonic()
                if self._full_since_s is None:
                    self._full_since_s = now_s
                if now_s - self._full_since_s > WRITE_TIMEOUT_S:
                    raise TimeoutError(errno.ETIMEDOUT, "no room in its buffer") from None

    def fileno(self) -> int | None:
        """Return the descriptor of the open port."""
        with guard_port(self.name):
            return None if self._serial is None else int(self._serial.fileno())

    def describe_fault(self) -> str:
        """Return that the port is missing or replaced, has settings of another program, or accepts nothing."""
        if self._serial is None or self._node is None:
            return ""
        with suppress(Exception):  # of a port that has failed
            try:
                node = Path(self.name).stat()
            except FileNotFoundError:
                return f"{self.name} is missing: unplugged, or its power is off"
            # The name is there again, but it is another device: this descriptor belongs to the one that was unplugged.
            if (node.st_dev, node.st_ino) != (self._node.st_dev, self._node.st_ino):
                return describe_replug(self.name)
            changed = self._describe_changed_settings(termios.tcgetattr(self._serial.fileno()))
            if changed or self._full_since_s is None:
                return changed
            return f"{self.name} accepts no bytes: check whether the device hangs, its plug and its supply"
        return ""

    def _describe_changed_settings(self, settings: list[Any]) -> str:
        names = [name for name, was, now in zip(SETTING_NAMES, self._settings, settings, strict=False) if was != now]
        if self._settings[-1] != settings[-1]:
            names.append("control characters")
        if not names:
            return ""
        return (
            f"another program changed the settings of {self.name} while it was open ({', '.join(dict.fromkeys(names))})"
            ": run no stty and no terminal program on the board's port"
        )

    def close(self) -> None:
        """Close the port and drop unsent data."""
        self._unsent, self._full_since_s = b"", None
        if self._serial is not None:
            port, self._serial = self._serial, None
            with suppress(Exception):  # closing an unplugged device fails
                port.close()
            if port.is_open:
                _abandon(port)

    def release(self) -> None:
        """Send unsent data for up to half a second and close the port."""
        with suppress(LinkError):
            while self._unsent:
                time.sleep(WRITE_RETRY_S)
                self.write(b"")
        self.close()


def _abandon(port: serial.Serial) -> None:
    """Close the rest of a port whose close has failed.

    The kernel has released its descriptor all the same. pyserial would close that number again when the object is
    collected, and it may belong to another file by then.
    """
    port.fd = None
    for name in PIPES:
        with suppress(Exception):
            os.close(getattr(port, name))
    port.is_open = False


TRANSPORT = TransportKind("serial", lambda port: SerialPort(port.port, port.baud))
