"""Boards in real time: a process on a pseudo-terminal, its log, and the serial port of a host."""

import json
import signal
from typing import NamedTuple

import serial
from board_log import BoardLog

from firmware_ports import build_board
from forked_process import SIMULATED, start_process
from optodrive.core.clock import MonotonicClock

READ_WAIT_S = 0.005
NOT_ITS_OWN = {
    "python": ("B14", "B15", "B16"),
    "independent": ("B16",),
    "qemu": ("B16", "B17"),
    **dict.fromkeys(("pico", "pico-usb"), ("B16",)),
}
"""Guards that a kind of board lacks: the simulated one has no tick, readback or watchdog, and most no scan head."""


def has_subject(name, subject):
    """Return whether a kind of board is tested for a guard or another subject."""
    return subject not in NOT_ITS_OWN.get(name, ())


class ProcessKind(NamedTuple):
    """A board implementation that runs as a process.

    command: of its process; port: firmware port to build instead
    """

    name: str
    command: tuple[str, ...] = ()
    port: str = ""

    def ready(self, folder, mutant=0):
        """Return this kind with its port built in a folder. mutant: number of the disabled guard."""
        return self._replace(command=build_board(folder, mutant, self.port)) if self.port else self

    def make_clock(self):
        """Return the clock of a bench."""
        return MonotonicClock()

    def start(self, folder, clock, number, steps, limits):
        """Start a board."""
        own = folder / f"board{number}"
        own.mkdir()
        return BoardProcess(self, own, limits, steps)


PROCESS_KINDS = [
    ProcessKind("python", SIMULATED),
    ProcessKind("host", port="host"),
]
"""All board implementations that run as a process."""


class BoardProcess(BoardLog):
    """A running board process.

    limits: keys of its limits file
    steps: of its script, carried out by `next_step`
    """

    def __init__(self, kind, folder, limits, steps=()):
        self.port, self.clock = folder / "tty", MonotonicClock()
        self._log = folder / "log"
        self._events, self._read = [], 0
        arguments = ["--pty", self.port, "--log", self._log]
        script = "".join('[[step]]\nfrom = "signal"\n' + toml(step) for step in steps)
        for option, text in (("--limits", toml(limits)), ("--script", script)):
            if text:
                path = folder / option.strip("-")
                path.write_text(text)
                arguments += [option, path]
        self.process = start_process([*kind.command, *arguments])
        try:
            self.wait(lambda: self.port.exists() or self.process.poll() is not None, "the board's port")
            assert self.process.poll() is None, f"the board ended by itself: {self.process.returncode}"
        except BaseException:
            self.process.kill()
            self.process.wait()
            raise

    def events(self):
        """Return all log entries so far."""
        if self._log.exists():
            with self._log.open("rb") as log:
                log.seek(self._read)
                whole = log.read().rpartition(b"\n")[0]
            if whole:
                self._read += len(whole) + 1
                self._events += map(json.loads, whole.splitlines())
        return list(self._events)

    def next_step(self):
        """Carry out the next step of the script. The log shows when."""
        self.process.send_signal(signal.SIGUSR1)

    def open(self):
        """Return the host's end of the port."""
        return SerialLine(self.port)

    def end(self):
        """Stop the process."""
        self.process.terminate()
        self.process.wait(timeout=self.patience_s)


class SerialLine:
    """The host's end of a real serial port."""

    def __init__(self, port):
        self._port = serial.Serial(str(port), 1_000_000, timeout=READ_WAIT_S, exclusive=True)

    def write(self, data):
        """Send bytes."""
        self._port.write(data)

    def read(self):
        """Return the bytes that have arrived. Wait for READ_WAIT_S if there are none."""
        return self._port.read(max(1, self._port.in_waiting))

    def close(self):
        """Close the port."""
        self._port.close()


def toml(table):
    """Format keys with numbers, booleans or strings as TOML."""
    return "".join(f"{name} = {json.dumps(value)}\n" for name, value in table.items())
