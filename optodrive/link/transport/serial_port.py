"""A serial port, by pyserial."""

from contextlib import suppress
from pathlib import Path

import serial
from serial.tools import list_ports

from optodrive.core.errors import InputError, LinkError

WRITE_TIMEOUT_S = 0.5


class SerialPort:
    """A serial device opened exclusively, 8N1. key: where the configuration names it."""

    def __init__(self, port: str, baud: int, config_key: str = "board.port") -> None:
        self.name = port
        self._config_key = config_key
        self._baud = baud
        self._serial: serial.Serial | None = None

    def open(self) -> None:
        """Open the port; InputError where it does not exist or may not be opened, LinkError where it is in use."""
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
            raise LinkError(f"{self.name} cannot be opened: {error}; does another program hold it?") from None
        except OSError as error:
            raise LinkError(f"{self.name} cannot be opened: {error}") from None

    def _require_open(self) -> serial.Serial:
        if self._serial is None:
            raise LinkError(f"{self.name} is not open")
        return self._serial

    def read(self, timeout_s: float) -> bytes:
        """Bytes that have arrived; waits at most timeout_s for the first."""
        port = self._require_open()
        try:
            port.timeout = timeout_s
            first: bytes = port.read(1)
            return first + port.read(port.in_waiting) if first else b""
        except (OSError, TypeError) as error:  # pyserial raises TypeError when the port is closed under a read
            raise self._build_lost_error(error) from None

    def write(self, data: bytes) -> None:
        """Write all of data; LinkError where the device does not take it within half a second."""
        try:
            self._require_open().write(data)
        except OSError as error:
            raise self._build_lost_error(error) from None

    def _build_lost_error(self, error: Exception) -> LinkError:
        detail = "" if Path(self.name).exists() else f"; {self.name} is gone: unplugged, or its power is off"
        return LinkError(f"link to {self.name} lost: {error}{detail}")

    def close(self) -> None:
        """Close the port."""
        if self._serial is not None:
            port, self._serial = self._serial, None
            with suppress(OSError):  # an unplugged device cannot be closed any better
                port.close()

    def release(self) -> None:
        """Close the port; nothing else was started."""
        self.close()
