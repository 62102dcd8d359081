"""The board's core on an emulated Cortex-M3, as a board process with the usual options and log.

python firmware_protocol/ports/mps2-an385/board.py [--image FILE] --pty LINK [--log FILE] [--limits FILE] …

Requires qemu-system-arm, the image (make) and the package optodrive, whose board process it uses. QEMU's own pty does
not report to the guest that a host has closed it; the bytes therefore pass through sockets, and this process owns the
pty.
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
from contextlib import suppress
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
POLL_US = 1_000
"""Polling period of the sockets."""
TIMEOUT_S = 5.0
START_TIMEOUT_S = 40.0
"""Time limit for the emulator to open its sockets, if several start from disk at once."""
READ_MAX = 65_536
FAULT_COMMANDS = {"stop_loop": b"H", "late_tick": b"T", "stick_gate": b"S"}
KINDS = ("gate", "state", "fault", "pulse", "rx_error")


PR_SET_PDEATHSIG = 1


def _die_with_parent() -> None:
    """Let the kernel kill the emulator when this process ends (prctl(2))."""
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)


class QemuCore:
    """Backend of the core in the emulator: bytes and inputs in, bytes and log events out."""

    def __init__(self, image: Path, settings: BoardSettings, sink: Callable[[dict[str, Any]], None]) -> None:
        self._sink = sink
        self._clock_offset_us: int | None = None
        self._gate_on = False
        self._pending_inputs: deque[tuple[str, bool]] = deque()
        self._inputs = SAFE_INPUTS
        self._started_s = time.monotonic()
        self._log_buffer = b""
        self._state_count = 0
        self._folder = tempfile.TemporaryDirectory(prefix="board-")
        self._stderr_path = Path(self._folder.name) / "stderr"  # stderr of QEMU, printed if it fails to start
        ports = [Path(self._folder.name) / f"uart{k}" for k in range(3)]
        options = [
            item
            for k, port in enumerate(ports)
            for item in ("-chardev", f"socket,id=c{k},path={port},server=on,wait=on", "-serial", f"chardev:c{k}")
        ]
        arguments = [
            "qemu-system-arm",
            "-M",
            "mps2-an385",
            "-kernel",
            str(image),
            "-display",
            "none",
            "-monitor",
            "none",
        ]
        with self._stderr_path.open("wb") as stderr:
            self._emulator = subprocess.Popen(
                [*arguments, "-nodefaults", "-nic", "none", *options],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=stderr,
                start_new_session=True,
                preexec_fn=_die_with_parent,
            )
        atexit.register(self.close)
        self._host_socket, self._log_socket, self._bench_socket = (self._connect(port) for port in ports)
        self._settings = settings
        self._poll_until(lambda: self._state_count > 0)

    def _connect(self, port: Path) -> socket.socket:
        deadline_s = time.monotonic() + START_TIMEOUT_S
        while True:
            link = socket.socket(socket.AF_UNIX)
            try:
                link.connect(str(port))
            except OSError:
                link.close()
                if time.monotonic() > deadline_s or self._emulator.poll() is not None:
                    sys.stderr.write(self._stderr_path.read_text())
                    raise
                time.sleep(0.005)
                continue
            link.setblocking(False)
            return link

    def _pack_config(self, settings: BoardSettings) -> bytes:
        seed = int.from_bytes(os.urandom(4), "little")
        head = struct.pack("<II12sHHBB", seed, FIRMWARE, bytes.fromhex(settings.uid), settings.cell_codes,
                           settings.queue_points, settings.key_edge, self._inputs)  # fmt: skip
        return head + settings.limits.encode_body()

    def _poll_until(self, condition: Callable[[], bool]) -> None:
        """Poll the log until a condition holds or TIMEOUT_S has passed."""
        deadline_s = time.monotonic() + TIMEOUT_S
        while not condition() and time.monotonic() < deadline_s and self._emulator.poll() is None:
            select.select([self._log_socket], [], [], 0.01)
            self._poll()

    # --- backend of the board process ---------------------------------------------------------------------------

    def advance(self, now_us: int) -> None:
        """Process the log; the emulator has its own clock."""
        self._poll()

    def receive(self, data: bytes, now_us: int) -> None:
        """Pass bytes from the host to the emulator."""
        while data:
            select.select([], [self._host_socket], [], TIMEOUT_S)
            data = data[self._host_socket.send(data) :]

    def bytes_to_send(self) -> bytes:
        """Return the bytes for the host, after all that the chip logged before them."""
        data = self._read(self._host_socket)
        self._poll()
        return data

    def on_link_lost(self, now_us: int) -> None:
        """Report the lost link and wait until the board is disarmed."""
        before = self._state_count
        self._bench_socket.sendall(b"L")
        self._poll_until(lambda: self._state_count > before or self._is_idle)

    @property
    def _is_idle(self) -> bool:
        return self._state in IDLE_STATES

    def set_input(self, name: str, value: bool, now_us: int) -> None:
        """Change the level of an input."""
        self._inputs = self._inputs | INPUT_BITS[name] if value else self._inputs & ~INPUT_BITS[name]
        self._pending_inputs.append((name, value))
        self._bench_socket.sendall(bytes([ord("I"), self._inputs]))

    def reset(self, now_us: int) -> None:
        """Reset the core."""
        self._bench_socket.sendall(b"R")

    def next_event_us(self) -> int | None:
        """Return the time of the next poll."""
        return self._now_us() + POLL_US

    def inject_fault(self, command: bytes) -> None:
        """Inject a fault of the board: H, T or S, as in main.c."""
        self._bench_socket.sendall(command)

    def close(self) -> None:
        """Stop the emulator."""
        self._emulator.kill()
        self._emulator.wait(timeout=TIMEOUT_S)
        self._folder.cleanup()

    def _now_us(self) -> int:
        return int((time.monotonic() - self._started_s) * 1e6)

    # --- log ----------------------------------------------------------------------------------------------------

    def _read(self, link: socket.socket) -> bytes:
        data = b""
        with suppress(BlockingIOError):
            while piece := link.recv(READ_MAX):
                data += piece
        return data

    def _poll(self) -> None:
        *whole, self._log_buffer = (self._log_buffer + self._read(self._log_socket)).split(b"\n")
        for line in whole:
            if not line.endswith(b"."):  # truncated by a reset
                continue
            kind, *numbers = line[:-1].decode("ascii").split()
            values = [int(number) for number in numbers]
            if kind == "C":
                self._configure()
                continue
            if self._clock_offset_us is None:  # the emulator's clock starts later than this process
                self._clock_offset_us = self._now_us() - values[0]
            event = {"T": self._log_event, "G": self._pin_event, "I": self._input_event, "P": self._lease_event}[kind](
                *values
            )
            if event["event"] == "gate":
                self._gate_on = event["on"]
            self._sink(event | {"t_us": values[0] + self._clock_offset_us})

    def _configure(self) -> None:
        """Configure the chip at power-up or after a watchdog reset: its clock restarts, its gate is off."""
        if self._gate_on:
            self._sink({"t_us": self._now_us(), "event": "gate", "on": False, "reason": "reset"})
        self._gate_on, self._clock_offset_us = False, None
        self._pending_inputs.clear()
        self._bench_socket.sendall(self._pack_config(self._settings))

    def _log_event(self, *values: int) -> dict[str, Any]:
        at_us, kind, on, is_point, state, before, reason, fault, x, y, duty, index, on_us, off_us = values
        event: dict[str, Any] = {"t_us": at_us, "event": KINDS[kind]}
        if event["event"] == "gate":
            point = f"point {index}" if on else f"point {index} done"
            return event | {"on": bool(on), "reason": point if is_point else m.EVENT_REASONS[reason]}
        if event["event"] == "state":
            self._state_count += 1
            self._state = m.STATES[state]
            return event | {"state": m.STATES[state], "before": m.STATES[before], "reason": m.EVENT_REASONS[reason]}
        if event["event"] == "fault":
            return event | {"fault": m.FAULTS[fault]}
        if event["event"] == "pulse":
            offset_us = self._clock_offset_us or 0
            times = {"on_us": on_us + offset_us, "off_us": off_us + offset_us}
            return event | {"index": index, "x": x, "y": y, "duty": duty, **times}
        return event | {"bad_frames": index}

    def _pin_event(self, at_us: int, on: int, duty: int) -> dict[str, Any]:
        """Return the actual change of the gate's pin."""
        return {"t_us": at_us, "event": "pin", "on": bool(on)}

    def _lease_event(self, at_us: int, until_us: int) -> dict[str, Any]:
        """Return the receipt of a LEASE and its expiry."""
        return {"t_us": at_us, "event": "lease", "until_us": until_us + (self._clock_offset_us or 0)}

    def _input_event(self, at_us: int, bits: int) -> dict[str, Any]:
        """Return the first time at which the core could detect a change of an input."""
        name, value = self._pending_inputs.popleft()
        return {"t_us": at_us, "event": "input", "input": name, "value": value}


if __name__ == "__main__":
    arguments = sys.argv[1:]
    image = IMAGE
    if "--image" in arguments:
        at = arguments.index("--image")
        image = Path(arguments[at + 1])
        del arguments[at : at + 2]
    actions = {name: partial(QemuCore.inject_fault, command=command) for name, command in FAULT_COMMANDS.items()}
    sys.exit(main(arguments, partial(QemuCore, image), actions))
