"""Transport to a simulated board, a process on a pseudo-terminal."""

import subprocess
import sys
import tempfile
import time
from pathlib import Path

from optodrive.core.errors import LinkError
from optodrive.link.transport.base import PortSettings, TransportKind, guard_opening
from optodrive.link.transport.serial_port import SerialPort

START_TIMEOUT_S = 15.0
LINGER_S = 5.0
"""The board process runs on for this time after the host has closed the port, so its log shows how it reacted."""


class SimulatedBoard(SerialPort):
    """Serial port of a board process that open() starts if none is running.

    settings: its address and its own settings
    display: file or shipped name of the configuration; with it the process also simulates a spot sensor
    stage: whose scanner moves the spot, None for the only one
    log: path of the board's log
    sensor_port: port of the spot sensor
    """

    def __init__(self, settings: PortSettings, display: str | None = None, stage: str | None = None) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="optodrive-board-")
        super().__init__(settings.port or str(Path(self._folder.name) / "tty"), settings.baud)
        self._limits = Path(self._folder.name) / "limits.toml"
        self._limits.write_text("".join(f"{name} = {value!r}\n" for name, value in settings.own_settings.items()))
        self.log = Path(self._folder.name) / "board.jsonl"
        self.sensor_port = str(Path(self._folder.name) / "sensor")
        self._display, self._stage = display, stage
        self._process: subprocess.Popen[bytes] | None = None

    def open(self) -> None:
        """Start the board process if necessary and open its port."""
        if self._process is None or self._process.poll() is not None:
            with guard_opening(self.name):
                self._start()
        super().open()

    def release(self) -> None:
        """Close the port and terminate the board process, which turns the gate off before it exits."""
        super().release()
        if self._process is not None:
            self._process.terminate()
            self._process.wait()
            self._process = None
        self._folder.cleanup()

    def _start(self) -> None:
        if Path(self.name).is_symlink():  # of an earlier board, whose terminal another program may have by now
            Path(self.name).unlink()
        arguments = ["--pty", self.name, "--log", str(self.log), "--baud", str(self._baud)]
        arguments += ["--limits", str(self._limits)]
        if self._display is not None:
            arguments += ["--sensor", self.sensor_port, "--config", self._display]
        if self._stage is not None:
            arguments += ["--stage", self._stage]
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
            start_new_session=True,  # Ctrl-C at the terminal reaches only the host
        )
        deadline_s = time.monotonic() + START_TIMEOUT_S
        while not Path(self.name).exists():
            if self._process.poll() is not None:
                raise LinkError(f"the simulated board exited at once with status {self._process.returncode}")
            if time.monotonic() > deadline_s:
                raise LinkError(f"the simulated board created no port within {START_TIMEOUT_S:.0f} s")
            time.sleep(0.01)


TRANSPORT = TransportKind("simulated", SimulatedBoard)
