"""Transport to a simulated board, a process on a pseudo-terminal."""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from optodrive.core.errors import LinkError, escape_unprintable
from optodrive.link.transport.base import PortSettings, TransportKind, guard_opening
from optodrive.link.transport.serial_port import SerialPort

START_TIMEOUT_S = 15.0
LINGER_S = 5.0
"""The board process runs on for this time after the host has closed the port, so its log shows how it reacted."""


class BoardProcess:
    """Process of a board in software, with a pseudo-terminal.

    module: that it runs, with arguments besides --pty LINK; link: to its terminal
    errors: file for what it says, None if nothing reads it
    """

    def __init__(self, module: str, arguments: list[str], link: Path, errors: Path | None = None) -> None:
        self._command = [sys.executable, "-m", module, "--pty", str(link), *arguments]
        self._link, self._errors = link, errors
        self._process: subprocess.Popen[bytes] | None = None

    def start(self, name: str) -> None:
        """Start the process if none is running, and wait for its port. Raise LinkError if it ends instead."""
        if self._process is not None and self._process.poll() is None:
            return
        with guard_opening(name):
            self._start(name)

    def _start(self, name: str) -> None:
        if self._link.is_symlink():  # of an earlier board, whose terminal another program may have by now
            self._link.unlink()
        with Path(self._errors or os.devnull).open("wb") as errors:
            self._process = subprocess.Popen(
                self._command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=None if self._errors is None else errors,
                start_new_session=True,  # Ctrl-C at the terminal reaches only the host
            )
        deadline_s = time.monotonic() + START_TIMEOUT_S
        while not self._link.exists():
            if self._process.poll() is not None:
                reason = f"exited at once with status {self._process.returncode}"
                raise LinkError(self.read_failure() or f"the board of {name} {reason}")
            if time.monotonic() > deadline_s:
                raise LinkError(f"the board of {name} created no port within {START_TIMEOUT_S:.0f} s")
            time.sleep(0.01)

    def read_failure(self) -> str:
        """Return the last line that the process said, if it has ended by itself, '' otherwise."""
        if self._process is None or self._errors is None or not self._process.poll():
            return ""
        lines = self._errors.read_text(errors="replace").strip().splitlines()
        return escape_unprintable(lines[-1]) if lines else ""

    def end(self) -> None:
        """Terminate the process, which turns the gate off before it exits."""
        if self._process is not None:
            self._process.terminate()
            self._process.wait()
            self._process = None


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
        arguments = ["--log", str(self.log), "--baud", str(settings.baud), "--limits", str(self._limits)]
        if display is not None:
            arguments += ["--sensor", self.sensor_port, "--config", display]
        if stage is not None:
            arguments += ["--stage", stage]
        arguments += ["--exit-when-closed", str(LINGER_S)]
        self._process = BoardProcess("optodrive.link.simulator.board_process", arguments, Path(self.name))

    def open(self) -> None:
        """Start the board process if necessary and open its port."""
        self._process.start(self.name)
        super().open()

    def release(self) -> None:
        """Close the port and terminate the board process, which turns the gate off before it exits."""
        super().release()
        self._process.end()
        self._folder.cleanup()


TRANSPORT = TransportKind("simulated", SimulatedBoard)
