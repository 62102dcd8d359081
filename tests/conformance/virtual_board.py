"""Boards in virtual time: a board core in this process, the port of a host, and a clock that waits for nobody."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

from board_log import BoardLog

from optodrive.core.clock import ManualClock
from optodrive.link.simulator.guards import DEFAULT_LIMITS, BoardSettings
from optodrive.link.simulator.measured_mirrors import MIRROR_FAULTS

READ_WAIT_S = 0.005
ADVANCE_US = 5000
"""Longest step of a board; its events have their exact times."""
WATCHDOG_US = 50_000
WATCHDOG_CAUSE = 3
LATE_TICK_US = 1000
HEADS = {"silence_head": 0, "fail_head": 0x7D7D}
"""Status that the scan head then returns: none, or one without power."""
HEAD_OK = 0xFDFD
BYTE_S = 10 / 1_000_000
"""Time of a byte on the line."""


class VirtualClock(ManualClock):
    """A clock that advances boards while its owner sleeps."""

    def __init__(self):
        super().__init__()
        self.boards = []

    def now_us(self):
        """Return the time in µs."""
        return round(self.now_s() * 1e6)

    def sleep(self, duration_s):
        """Advance the boards and the time."""
        before_us = self.now_us()
        super().sleep(duration_s)
        for board in self.boards:
            for at_us in range(before_us + ADVANCE_US, self.now_us(), ADVANCE_US):
                board.advance(at_us)
            board.advance(self.now_us())


class VirtualBoard(BoardLog):
    """A board core with its port. steps: of its script, carried out by `next_step`.

    The C core's main loop or tick can stop (the watchdog then resets it), its tick be late and its gate stick, as in
    the ports.
    """

    patience_s = 15.0

    def __init__(self, make_core, settings, clock, seed, steps):
        self.clock = clock
        self._log = []
        self.core = make_core(settings, self._log.append, seed=seed)
        self._steps = list(steps)
        self._is_open = self._loop_stopped = self._tick_stopped = False
        self._resumes_us = 0
        self._input = self._output = b""
        clock.boards.append(self)

    def events(self):
        """Return all log entries so far."""
        return list(self._log)

    def output_edges(self):
        """Return the edges of the core's calls. The simulated board's are those that it logs."""
        return self.core.gate_edges if hasattr(self.core, "gate_edges") else super().output_edges()

    # --- time ---

    @property
    def _is_serving(self):
        return not self._loop_stopped and not self._tick_stopped and self.clock.now_us() >= self._resumes_us

    def advance(self, now_us):
        """Advance to a time."""
        if now_us < self._resumes_us:
            return
        if self._resumes_us:
            self.core.tick(self._resumes_us)
            self._resumes_us = 0
        if not self._loop_stopped and not self._tick_stopped:
            self.core.advance(now_us)
            self._receive(now_us)
            return
        if self._loop_stopped:
            self.core.advance(now_us, loop=False)
        else:
            self.core.loop(now_us)
        if now_us - self.core.fed_us > WATCHDOG_US:
            self.core.reset(now_us, WATCHDOG_CAUSE)
            self._loop_stopped = self._tick_stopped = False

    def _receive(self, now_us):
        data, self._input = self._input, b""
        if data:
            self.core.receive(data, now_us)
        self._output += self.core.bytes_to_send() if self._is_open else b""

    def next_step(self):
        """Carry out the next step of the script."""
        step, now_us = self._steps.pop(0), self.clock.now_us()
        if "set" in step:
            self.core.set_input(step["set"], step["value"], now_us)
        elif step["do"] == "trigger":
            self.core.receive_trigger(now_us)
        elif step["do"] == "reset":
            self.core.reset(now_us)
            self._output = b""
        elif step["do"] == "stop_loop":
            self._loop_stopped = True
        elif step["do"] == "stop_tick":
            self._tick_stopped = True
        elif step["do"] == "late_tick":
            self._resumes_us = now_us + LATE_TICK_US
        elif step["do"] in HEADS:
            self.core.set_head(HEADS[step["do"]])
        elif step["do"] in MIRROR_FAULTS:
            self.core.inject_fault(step["do"], now_us)
        elif step["do"] == "repair":
            self.core.inject_fault("", now_us)
            if hasattr(self.core, "set_head"):
                self.core.set_head(HEAD_OK)
        else:
            assert step["do"] == "stick_gate"
            self.core.stick(stuck=True, on=self.core.gate_output)

    # --- port ---

    def open(self):
        """Return the host's end of the port."""
        assert not self._is_open, "one host at a time"
        self._is_open = True
        self._log.append({"t_us": self.clock.now_us(), "event": "port", "open": True})
        self.core.bytes_to_send()
        return VirtualLine(self)

    def close(self):
        """Close the port."""
        if self._is_open:
            self._log.append({"t_us": self.clock.now_us(), "event": "port", "open": False})
            self.core.on_link_lost(self.clock.now_us())
            self._is_open, self._output = False, b""

    def receive(self, data):
        """Receive bytes from the host."""
        self._input += data
        if self._is_serving:
            self._receive(self.clock.now_us())

    def take_output(self):
        """Return the bytes for the host."""
        data, self._output = self._output, b""
        return data

    def end(self):
        """Close the port."""
        self.close()


class EmulatedBoard(VirtualBoard):
    """An emulated chip with its port: loop, tick, gate and watchdog are its own."""

    def advance(self, now_us):
        """Advance to a time."""
        self.core.advance(now_us)
        self._receive(now_us)

    def next_step(self):
        """Carry out the next step of the script."""
        if self._steps[0].get("do") in self.core.FAULTS:
            self.core.inject_fault(self._steps.pop(0)["do"])
        else:
            super().next_step()

    def end(self):
        """Close the port and end the emulator."""
        super().end()
        self.core.close()


class PicoBoard(EmulatedBoard):
    """An emulated Pico, whose adapter shows it by a pin whether a host has the port open."""

    def open(self):
        """Return the host's end of the port."""
        self.core.open_port(self.clock.now_us())
        return super().open()


class VirtualLine:
    """The host's end of a board's port."""

    def __init__(self, board):
        self._board = board

    def write(self, data):
        """Send bytes. They take their time on the line."""
        self._board.clock.sleep(len(data) * BYTE_S)
        self._board.receive(data)

    def read(self):
        """Return the bytes that have arrived. Wait for READ_WAIT_S if there are none."""
        data = self._board.take_output()
        if not data:
            self._board.clock.sleep(READ_WAIT_S)
            data = self._board.take_output()
        return data

    def close(self):
        """Close the port."""
        self._board.close()


class VirtualKind(NamedTuple):
    """A board core.

    make_core: (settings, sink, seed) → core
    make_board: of its port
    """

    name: str
    make_core: Callable[..., Any]
    make_board: Callable[..., VirtualBoard] = VirtualBoard

    def make_clock(self):
        """Return the clock of a bench."""
        return VirtualClock()

    def start(self, folder, clock, number, steps, limits):
        """Return a new board.

        number: its seed
        """
        guarded = {name: value for name, value in limits.items() if hasattr(DEFAULT_LIMITS, name)}
        others = {name: value for name, value in limits.items() if name not in guarded}
        settings = BoardSettings(replace(DEFAULT_LIMITS, **guarded), **others)
        return self.make_board(self.make_core, settings, clock, number, steps)
