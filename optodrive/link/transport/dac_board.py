"""Transport to the board of a laser DAC, a process on a pseudo-terminal."""

import json
import tempfile
from dataclasses import asdict
from pathlib import Path

from optodrive.link.transport.base import PortSettings, TransportKind
from optodrive.link.transport.serial_port import SerialPort
from optodrive.link.transport.simulated import BoardProcess

DAC_TRANSPORTS = ("ether_dream", "helios", "idn")


class DacBoard:
    """Serial port of a board process that open() starts if none is running.

    settings: address of the DAC, and the own settings of its board
    """

    def __init__(self, settings: PortSettings) -> None:
        self.name = " ".join(filter(None, (settings.transport, settings.port)))
        self._folder = tempfile.TemporaryDirectory(prefix="optodrive-dac-")
        folder = Path(self._folder.name)
        self._errors = folder / "errors"
        settings_file = folder / "settings.json"
        settings_file.write_text(json.dumps(asdict(settings)))
        self._port = SerialPort(str(folder / "tty"), settings.baud)
        self._process = BoardProcess(
            "optodrive.link.simulator.dac_process",
            ["--settings", str(settings_file)],
            folder / "tty",
            self._errors,
        )

    def open(self) -> None:
        """Start the board process if necessary and open its port. Raise LinkError if there is no DAC."""
        self._process.start(self.name)
        self._port.open()

    def read(self, timeout_s: float) -> bytes:
        """Return the bytes that have arrived. Wait at most timeout_s for the first."""
        return self._port.read(timeout_s)

    def write(self, data: bytes) -> None:
        """Hand data to the operating system, now as far as it has room, and the rest at the next calls."""
        self._port.write(data)

    def fileno(self) -> int | None:
        """Return the descriptor of the open port."""
        return self._port.fileno()

    def describe_fault(self) -> str:
        """Return the last line of a board process that has failed, or an empty text."""
        return self._process.read_failure()

    def close(self) -> None:
        """Close the port. The board stops the DAC."""
        self._port.close()

    def release(self) -> None:
        """Close the port and end the board process, which stops the DAC before it exits."""
        self._port.release()
        self._process.end()
        self._folder.cleanup()


TRANSPORTS = tuple(TransportKind(name, DacBoard) for name in DAC_TRANSPORTS)
