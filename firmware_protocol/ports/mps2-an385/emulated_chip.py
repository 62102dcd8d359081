"""The board's core on an emulated Cortex-M3 whose time its host grants: requires qemu-system-arm and the image (make).

QEMU counts instructions (-icount): each takes 32 ns of the chip's time, which stops while the chip waits for its host.
However slow this computer is, the chip is as punctual as its program. The interface is that of a board behind a pty
(`BoardBackend`), so the host's time may be virtual or the computer's; another emulator with this interface is driven
in the same way.
"""

import os
import struct
import subprocess
import weakref
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from optodrive.link.protocol import messages as m
from optodrive.link.simulator.guards import BoardSettings

INSTRUCTION_SHIFT = 5
"""An instruction takes 2**5 ns, little less than a cycle of the chip's 25 MHz."""
INPUT_BITS = {"interlock": 1, "key": 2, "estop": 4}
SAFE_INPUTS = 3
FIRMWARE = 0x0001_0000
COMMAND = struct.Struct("<QHB256s")
RECORD = struct.Struct("<cH")
TIMES = struct.Struct("<QQ")
TRACE = struct.Struct("<3QI3H7B")
BYTES_MAX = 256
NEVER_US = 2**64 - 1
KINDS = ("gate", "state", "fault", "pulse", "rx_error")


class EmulatedChip:
    """A board of bytes, inputs and a log. sink: receives each log event; seed: of its entropy, by default random.

    Besides the events of any board, the log has `pin`, an actual change of the gate, and `lease`, the receipt of a
    LEASE with its end.
    """

    lease_until_us = 0
    """The chip reports its leases itself."""
    FAULTS = {"stop_loop": b"H", "stop_tick": b"K", "late_tick": b"T", "stick_gate": b"S"}  # noqa: RUF012 - nobody writes to it

    def __init__(
        self,
        image: Path,
        settings: BoardSettings | None,
        sink: Callable[[dict[str, Any]], None],
        seed: int | None = None,
    ) -> None:
        self._settings, self._sink, self._seed = settings or BoardSettings(), sink, seed
        self._now_us = self._chip_us = 0
        self._due_us = NEVER_US
        self._inputs, self._input_name = SAFE_INPUTS, ""
        self._sent_us = 0
        self._output: deque[tuple[int, bytes]] = deque()
        self.state, self.gate = "BOOT", False
        self._emulator = subprocess.Popen(
            [
                *("qemu-system-arm", "-M", "mps2-an385", "-kernel", str(image), "-nodefaults", "-nic", "none"),
                *("-display", "none", "-icount", f"shift={INSTRUCTION_SHIFT},align=off,sleep=off"),
                *("-semihosting-config", "enable=on,target=native"),
            ],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,
        )
        self._commands, self._records = self._emulator.stdin, self._emulator.stdout
        self.pid = self._emulator.pid
        self.close = weakref.finalize(self, _end, self._emulator)
        self._read_until_done()

    # --- backend of a board -------------------------------------------------------------------------------------

    def advance(self, now_us: int) -> None:
        """Let the chip run until a time."""
        self._now_us = now_us
        while self._chip_us < now_us:  # again after a reset
            self._command(b"U", at_us=now_us)

    def receive(self, data: bytes, now_us: int) -> None:
        """Pass bytes from the host to the chip."""
        self.advance(now_us)
        for at in range(0, len(data), BYTES_MAX):
            self._command(b"B", data[at : at + BYTES_MAX])

    def bytes_to_send(self) -> bytes:
        """Return the bytes for the host that the chip has sent by now."""
        data = b""
        while self._output and self._output[0][0] <= self._now_us:
            data += self._output.popleft()[1]
        return data

    def on_link_lost(self, now_us: int) -> None:
        """Report the lost link."""
        self.advance(now_us)
        self._command(b"L")

    def set_input(self, name: str, value: bool, now_us: int) -> None:
        """Change the level of an input."""
        self.advance(now_us)
        self._inputs = self._inputs | INPUT_BITS[name] if value else self._inputs & ~INPUT_BITS[name]
        self._input_name = name
        self._command(b"I", bytes([self._inputs]))

    def receive_trigger(self, now_us: int) -> None:
        """Pass a rising edge to the trigger input."""
        self.advance(now_us)
        self._command(b"E")

    def reset(self, now_us: int) -> None:
        """Reset the core."""
        self.advance(now_us)
        self._command(b"R")
        self._output.clear()

    def next_event_us(self) -> int | None:
        """Return the time of the next due event, None if there is none."""
        return None if self._due_us == NEVER_US else self._due_us

    def inject_fault(self, name: str) -> None:
        """Break a part of the board: one of FAULTS."""
        self._command(self.FAULTS[name])

    # --- the emulator -------------------------------------------------------------------------------------------

    def _command(self, kind: bytes, data: bytes = b"", at_us: int = 0) -> None:
        self._commands.write(COMMAND.pack(at_us, len(data), kind[0], data))
        self._commands.flush()
        self._read_until_done()

    def _read_until_done(self) -> None:
        """Process what the chip writes until it waits for the next command."""
        while True:
            kind, size = RECORD.unpack(self._read(RECORD.size))
            body = self._read(size)
            if kind == b"T":
                self._log_event(*TRACE.unpack(body))
                continue
            if kind == b"O":
                self._output.append((self._sent_us, body))
                continue
            first, second = TIMES.unpack(body)
            if kind == b"D":
                self._chip_us, self._due_us = first, second
                return
            if kind == b"A":
                self._sent_us = first
            elif kind == b"C":
                self._configure(first)
            elif kind == b"G":
                self.gate = bool(second)
                self._sink({"t_us": first, "event": "pin", "on": self.gate})
            elif kind == b"P":
                self._sink({"t_us": first, "event": "lease", "until_us": second})
            elif kind == b"E":
                self._sink({"t_us": first, "event": "trigger", "count": second})
            elif kind == b"I":
                value = bool(self._inputs & INPUT_BITS[self._input_name])
                self._sink({"t_us": first, "event": "input", "input": self._input_name, "value": value})

    def _read(self, size: int) -> bytes:
        data = self._records.read(size)
        if len(data) < size:
            raise RuntimeError(f"the emulator has ended: {self._emulator.stderr.read().decode()}")
        return data

    def _configure(self, at_us: int) -> None:
        """Configure the chip at power-up or after a watchdog reset, at which its gate is off."""
        if self.gate:
            self._sink({"t_us": at_us, "event": "gate", "on": False, "reason": "reset"})
            self._sink({"t_us": at_us, "event": "pin", "on": False})
        self.gate = False
        self._output.clear()
        settings = self._settings
        seed = os.urandom(4) if self._seed is None else struct.pack("<I", self._seed)
        head = struct.pack("<4sI12sHHHHBB", seed, FIRMWARE, bytes.fromhex(settings.uid), settings.cell_codes,
                           settings.queue_points, settings.cells, settings.window_pulses,
                           settings.key_edge, self._inputs)  # fmt: skip
        data = head + settings.limits.encode_body()
        self._commands.write(COMMAND.pack(0, len(data), 0, data))
        self._commands.flush()

    def _log_event(self, at_us: int, on_us: int, off_us: int, index: int, *values: int) -> None:
        x, y, duty, kind, on, is_point, state, before, reason, fault = values
        event: dict[str, Any] = {"t_us": at_us, "event": KINDS[kind]}
        if event["event"] == "gate":
            point = f"point {index}" if on else f"point {index} done"
            event |= {"on": bool(on), "reason": point if is_point else m.EVENT_REASONS[reason]}
        elif event["event"] == "state":
            self.state = m.STATES[state]
            event |= {"state": self.state, "before": m.STATES[before], "reason": m.EVENT_REASONS[reason]}
        elif event["event"] == "fault":
            event |= {"fault": m.FAULTS[fault]}
        elif event["event"] == "pulse":
            event |= {"index": index, "x": x, "y": y, "duty": duty, "on_us": on_us, "off_us": off_us}
        else:
            event |= {"bad_frames": index}
        self._sink(event)


def _end(emulator: "subprocess.Popen[bytes]") -> None:
    emulator.kill()
    with suppress(BrokenPipeError):  # of a command that the emulator did not read
        emulator.communicate()
