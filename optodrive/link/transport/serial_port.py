"""Transport over a serial port, with pyserial."""

import os
import time
from contextlib import suppress
from pathlib import Path

import serial
from serial.tools import list_ports

from optodrive.core.errors import InputError, LinkError
from optodrive.link.transport.base import TransportKind

WRITE_TIMEOUT_S = 0.5
WRITE_RETRY_S = 0.001


class SerialPort:
    """Serial device, opened exclusively, 8N1. config_key: configuration key of the port, for errors."""

    def __init__(self, port: str, baud: int, config_key: str = "board.port") -> None:
        self.name = port
        self._config_key = config_key
        self._baud = baud
        self._serial: serial.Serial | None = None

    def open(self) -> None:
        """Open the port.

        Raise InputError if it does not exist or access is denied, LinkError if it is in use.
        """
        if not Path(self.name).exists():
            present = ", ".join(port.device for port in list_ports.comports()) or "none found"
            raise InputError(self._config_key, self.name, f"a serial port that exists ({present})", "no_port")
        try:
            self._serial = serial.Serial(
                self.name, self._baud, timeout=0, write_timeout=WRITE_TIMEOUT_S, exclusive=True
            )
        except serial.SerialException as error:
            if error.errno == 13:
                raise InputError(
                    self._config_key, self.name, "permission to open it (group dialout?)", "no_port"
                ) from None
            raise LinkError(f"{self.name} cannot be opened: {error}; is it in use by another program?") from None
        except OSError as error:
            raise LinkError(f"{self.name} cannot be opened: {error}") from None

    def _require_open(self) -> serial.Serial:
        if self._serial is None:
            raise LinkError(f"{self.name} is not open")
        return self._serial

    def read(self, timeout_s: float) -> bytes:
        """Return the bytes that have arrived. Wait at most timeout_s for the first."""
        port = self._require_open()
        try:
            if port.timeout != timeout_s:  # setting it costs system calls
                port.timeout = timeout_s
            first: bytes = port.read(1)
            return first + port.read(port.in_waiting) if first else b""
        except (OSError, TypeError) as error:  # pyserial raises TypeError when the port is closed under a read
            raise self._build_lost_error(error) from None

    def write(self, data: bytes) -> None:
        """Write all of data. Raise LinkError if the device does not accept it within half a second.

        pyserial would poll the device after each write, which waits for a worker of the kernel.
        """
        port, rest, deadline_s = self._require_open(), memoryview(data), None
        while rest:
            try:
                rest = rest[os.write(port.fileno(), rest) :]
            except BlockingIOError as error:
                deadline_s = deadline_s or time.monotonic() + WRITE_TIMEOUT_S
                if time.monotonic() > deadline_s:
                    raise self._build_lost_error(error) from None
                time.sleep(WRITE_RETRY_S)
            except OSError as error:
                raise self._build_lost_error(error) from None

    def _build_lost_error(self, error: Exception) -> LinkError:
        detail = "" if Path(self.name).exists() else f"; {self.name} is missing: unplugged, or its power is off"
        return LinkError(f"link to {self.name} lost: {error}{detail}")

    def fileno(self) -> int | None:
        """Return the descriptor of the open port."""
        return None if self._serial is None else int(self._serial.fileno())

    def close(self) -> None:
        """Close the port."""
        if self._serial is not None:
            port, self._serial = self._serial, None
            with suppress(OSError):  # closing an unplugged device fails
                port.close()

    def release(self) -> None:
        """Close the port."""
        self.close()


TRANSPORT = TransportKind("serial", lambda port: SerialPort(port.port, port.baud))
