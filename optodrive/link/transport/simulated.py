"""A board that runs as a process of its own on a pseudo-terminal, reached through a real serial port."""

import subprocess
import sys
import tempfile
import time
from pathlib import Path

from optodrive.core.errors import LinkError
from optodrive.link.transport.serial_port import SerialPort

START_TIMEOUT_S = 15.0
LINGER_S = 5.0
"""The board outlives the host by this long, so that its log shows what it did when the host was gone."""


class SimulatedBoard(SerialPort):
    """Starts the board process when opened, and again when it has ended; `log` is the board's own.

    display: a configuration's file or shipped name; with it the board brings a spot sensor, at `sensor_port`.
    """

    def __init__(self, port: str, baud: int, display: str | None = None) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="optodrive-board-")
        super().__init__(port or str(Path(self._folder.name) / "tty"), baud)
        self.log = Path(self._folder.name) / "board.jsonl"
        self.sensor_port = str(Path(self._folder.name) / "sensor")
        self._display = display
        self._process: subprocess.Popen[bytes] | None = None

    def open(self) -> None:
        """Start the board if it does not run, and open its port."""
        if self._process is None or self._process.poll() is not None:
            self._start()
        super().open()

    def release(self) -> None:
        """Close the port and end the board, which goes dark on its way out."""
        self.close()
        if self._process is not None:
            self._process.terminate()
            self._process.wait()
            self._process = None
        self._folder.cleanup()

    def _start(self) -> None:
        arguments = ["--pty", self.name, "--log", str(self.log), "--baud", str(self._baud)]
        if self._display is not None:
            arguments += ["--sensor", self.sensor_port, "--config", self._display]
        self._process = subprocess.Popen(
            [
                sys.executable,
                "-m",
                "optodrive.link.simulator.board_process",
                *arguments,
                "--exit-when-closed",
                str(LINGER_S),
            ],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            start_new_session=True,  # a Ctrl-C at the terminal is for the host; the board sees the link drop
        )
        deadline_s = time.monotonic() + START_TIMEOUT_S
        while not Path(self.name).exists():
            if self._process.poll() is not None:
                raise LinkError(f"the simulated board ended at once with status {self._process.returncode}")
            if time.monotonic() > deadline_s:
                raise LinkError(f"the simulated board made no port within {START_TIMEOUT_S:.0f} s")
            time.sleep(0.01)
