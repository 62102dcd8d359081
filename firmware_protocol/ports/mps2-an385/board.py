"""The board's core on an emulated Cortex-M3, run as any board process: the same options, the same log.

python firmware_protocol/ports/mps2-an385/board.py [--image FILE] --pty LINK [--log FILE] [--limits FILE] …

Needs qemu-system-arm, the image (make) and the package optodrive, whose process around a board it uses. QEMU's own pty
would not tell the guest that a host has closed it, so bytes go through sockets and this process has the pty.
"""

import atexit
import ctypes
import os
import select
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from optodrive.link.protocol import messages as m
from optodrive.link.protocol.states import IDLE_STATES
from optodrive.link.simulator.board_limits import BoardSettings
from optodrive.link.simulator.board_process import main

IMAGE = Path(__file__).parent / "build" / "board.elf"
INPUT_BITS = {"interlock": 1, "key": 2, "estop": 4}
SAFE_INPUTS = 3
FIRMWARE = 0x0001_0000
LOOK_US = 1_000
"""The sockets are looked at so often."""
PATIENCE_S = 5.0
START_S = 40.0
"""An emulator that is read from a disk for the first time, beside others, may take so long to open its sockets."""
FAILURES = {"stop_loop": b"H", "late_tick": b"T", "stick_gate": b"S"}
KINDS = ("gate", "state", "fault", "pulse", "rx_error")


PR_SET_PDEATHSIG = 1


def _end_with_me() -> None:
    """No emulator outlives its bench, however that ends (prctl(2))."""
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)


class QemuCore:
    """The core in the emulator: bytes and inputs in, bytes and what its witness writes out."""

    def __init__(self, image: Path, settings: BoardSettings, sink: Callable[[dict[str, Any]], None]) -> None:
        self._sink = sink
        self._ahead_us: int | None = None
        self._lit = False
        self._turned: deque[tuple[str, bool]] = deque()
        self._inputs = SAFE_INPUTS
        self._began_s = time.monotonic()
        self._lines = b""
        self._states = 0
        self._folder = tempfile.TemporaryDirectory(prefix="board-")
        self._complaints = Path(self._folder.name) / "complaints"  # that it waits for us is one: shown where it ends
        ports = [Path(self._folder.name) / f"uart{k}" for k in range(3)]
        options = [
            item
            for k, port in enumerate(ports)
            for item in ("-chardev", f"socket,id=c{k},path={port},server=on,wait=on", "-serial", f"chardev:c{k}")
        ]
        command = ["qemu-system-arm", "-M", "mps2-an385", "-kernel", str(image), "-display", "none", "-monitor", "none"]
        with self._complaints.open("wb") as complaints:
            self._emulator = subprocess.Popen(
                [*command, "-nodefaults", "-nic", "none", *options],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=complaints,
                start_new_session=True,
                preexec_fn=_end_with_me,
            )
        atexit.register(self.close)
        self._host, self._witness, self._bench = (self._connected(port) for port in ports)
        self._settings = settings
        self._until(lambda: self._states > 0)

    def _connected(self, port: Path) -> socket.socket:
        give_up_s = time.monotonic() + START_S
        while True:
            link = socket.socket(socket.AF_UNIX)
            try:
                link.connect(str(port))
            except OSError:
                link.close()
                if time.monotonic() > give_up_s or self._emulator.poll() is not None:
                    sys.stderr.write(self._complaints.read_text())
                    raise
                time.sleep(0.005)
                continue
            link.setblocking(False)
            return link

    def _packed(self, settings: BoardSettings) -> bytes:
        seed = int.from_bytes(os.urandom(4), "little")
        head = struct.pack("<II12sHHBB", seed, FIRMWARE, bytes.fromhex(settings.uid), settings.cell_codes,
                           settings.queue_points, settings.key_edge, self._inputs)  # fmt: skip
        return head + settings.limits.encode_body()

    def _until(self, condition: Callable[[], bool]) -> None:
        """Look at the witness until something is so."""
        give_up_s = time.monotonic() + PATIENCE_S
        while not condition() and time.monotonic() < give_up_s and self._emulator.poll() is None:
            select.select([self._witness], [], [], 0.01)
            self._look()

    # --- what the process around it asks ------------------------------------------------------------------------

    def advance(self, now_us: int) -> None:
        """The emulator keeps its own time; only what it wrote meanwhile is taken."""
        self._look()

    def receive(self, data: bytes, now_us: int) -> None:
        """Bytes from the host."""
        while data:
            select.select([], [self._host], [], PATIENCE_S)
            data = data[self._host.send(data) :]

    def bytes_to_send(self) -> bytes:
        """Bytes for the host."""
        return self._read(self._host)

    def on_link_lost(self, now_us: int) -> None:
        """Tell the bench, and wait until the board is dark."""
        before = self._states
        self._bench.sendall(b"L")
        self._until(lambda: self._states > before or self._dark)

    @property
    def _dark(self) -> bool:
        return self._state in IDLE_STATES

    def set_input(self, name: str, value: bool, now_us: int) -> None:
        """What an input reads from now on."""
        self._inputs = self._inputs | INPUT_BITS[name] if value else self._inputs & ~INPUT_BITS[name]
        self._turned.append((name, value))
        self._bench.sendall(bytes([ord("I"), self._inputs]))

    def reset(self, now_us: int) -> None:
        """A reset of the core."""
        self._bench.sendall(b"R")

    def next_event_us(self) -> int | None:
        """Soon: nobody tells when the emulator has written something."""
        return self._now_us() + LOOK_US

    def fail(self, order: bytes) -> None:
        """Something in the board itself fails: H, T or S, as main.c says."""
        self._bench.sendall(order)

    def close(self) -> None:
        """End the emulator."""
        self._emulator.kill()
        self._emulator.wait(timeout=PATIENCE_S)
        self._folder.cleanup()

    def _now_us(self) -> int:
        return int((time.monotonic() - self._began_s) * 1e6)

    # --- the witness --------------------------------------------------------------------------------------------

    def _read(self, link: socket.socket) -> bytes:
        try:
            return link.recv(65_536)
        except BlockingIOError:
            return b""

    def _look(self) -> None:
        *whole, self._lines = (self._lines + self._read(self._witness)).split(b"\n")
        for line in whole:
            if not line.endswith(b"."):  # a reset cut it short
                continue
            kind, *numbers = line[:-1].decode("ascii").split()
            values = [int(number) for number in numbers]
            if kind == "C":
                self._configure()
                continue
            if self._ahead_us is None:  # the emulator's clock begins later than this process
                self._ahead_us = self._now_us() - values[0]
            event = {"T": self._event, "G": self._pin, "I": self._input, "P": self._permit}[kind](*values)
            if event["event"] == "gate":
                self._lit = event["on"]
            self._sink(event | {"t_us": values[0] + self._ahead_us})

    def _configure(self) -> None:
        """The chip begins, at power-up or after its watchdog's reset: its clock is new, its pins are dark."""
        if self._lit:
            self._sink({"t_us": self._now_us(), "event": "gate", "on": False, "reason": "reset"})
        self._lit, self._ahead_us = False, None
        self._turned.clear()
        self._bench.sendall(self._packed(self._settings))

    def _event(self, *values: int) -> dict[str, Any]:
        at_us, kind, on, is_point, state, before, reason, fault, x, y, duty, index, on_us, off_us = values
        event: dict[str, Any] = {"t_us": at_us, "event": KINDS[kind]}
        if event["event"] == "gate":
            point = f"point {index}" if on else f"point {index} done"
            return event | {"on": bool(on), "reason": point if is_point else m.EVENT_REASONS[reason]}
        if event["event"] == "state":
            self._states += 1
            self._state = m.STATES[state]
            return event | {"state": m.STATES[state], "before": m.STATES[before], "reason": m.EVENT_REASONS[reason]}
        if event["event"] == "fault":
            return event | {"fault": m.FAULTS[fault]}
        if event["event"] == "pulse":
            ahead_us = self._ahead_us or 0
            times = {"on_us": on_us + ahead_us, "off_us": off_us + ahead_us}
            return event | {"index": index, "x": x, "y": y, "duty": duty, **times}
        return event | {"bad_frames": index}

    def _pin(self, at_us: int, on: int, duty: int) -> dict[str, Any]:
        """When the pin itself changed."""
        return {"t_us": at_us, "event": "pin", "on": bool(on)}

    def _permit(self, at_us: int, until_us: int) -> dict[str, Any]:
        """When a LEASE was taken, and until when the board may emit by it."""
        return {"t_us": at_us, "event": "lease", "until_us": until_us + (self._ahead_us or 0)}

    def _input(self, at_us: int, bits: int) -> dict[str, Any]:
        """When the core could first see that an input had changed."""
        name, value = self._turned.popleft()
        return {"t_us": at_us, "event": "input", "input": name, "value": value}


if __name__ == "__main__":
    arguments = sys.argv[1:]
    image = IMAGE
    if "--image" in arguments:
        at = arguments.index("--image")
        image = Path(arguments[at + 1])
        del arguments[at : at + 2]
    actions = {name: partial(QemuCore.fail, order=order) for name, order in FAILURES.items()}
    sys.exit(main(arguments, partial(QemuCore, image), actions))
