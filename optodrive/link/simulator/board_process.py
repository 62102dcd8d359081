"""The simulated board as a process of its own on a pseudo-terminal.

python -m optodrive.link.simulator.board_process --pty LINK [--log FILE] [--limits FILE] [--script FILE] [--baud N]
    [--sensor LINK [--geometry SEED] [--config FILE] [--sensor-noise-um N] [--false-share N] [--no-readback]]
"""

import argparse
import json
import os
import select
import signal
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Protocol

from optodrive.core.clock import request_realtime_scheduling
from optodrive.core.errors import InputError
from optodrive.link.simulator.board_core import BoardCore
from optodrive.link.simulator.board_limits import BoardSettings, load_settings
from optodrive.link.simulator.faulty_link import FaultyLink
from optodrive.link.simulator.pseudo_terminal import check_link, open_pty
from optodrive.link.simulator.script import SENSOR_ACTIONS, Step, load_script
from optodrive.link.simulator.sensor_options import add_sensor_options, bench_of

if TYPE_CHECKING:
    from optodrive.link.simulator.bench import Bench

TURN_MAX_S = 0.005
LATE_US = 2_000
"""A turn that begins so long after its time was kept from the processor."""
BITS_A_BYTE = 10
BAUD_MIN = 300
BURST_BYTES = 64
READ_MAX = 4096


class Pace:
    """Lets bytes pass at a serial line's rate."""

    def __init__(self, baud: int) -> None:
        self._bytes_per_s = baud / BITS_A_BYTE
        self._tokens = float(BURST_BYTES)
        self._at_s = 0.0

    def allowed(self, now_s: float) -> int:
        """How many bytes may pass now."""
        # A late turn may catch up on what the line would have carried meanwhile, up to a whole read.
        self._tokens = min(READ_MAX, self._tokens + (now_s - self._at_s) * self._bytes_per_s)
        self._at_s = now_s
        return int(self._tokens)

    def passed(self, count: int) -> None:
        """Count bytes that passed."""
        self._tokens -= count

    def idle(self) -> None:
        """Nothing waits to pass: a line saves nothing up."""
        self._tokens = min(self._tokens, BURST_BYTES)


class Core(Protocol):
    """What stands behind the pty: the simulated board, or a real core elsewhere. Times in µs since the start."""

    def advance(self, now_us: int) -> None:
        """Do everything that falls due up to now."""

    def receive(self, data: bytes, now_us: int) -> None:
        """Take bytes that arrived at now_us."""

    def bytes_to_send(self) -> bytes:
        """Bytes for the host since the last call."""

    def link_lost(self, now_us: int) -> None:
        """The host's end closed."""

    def set_input(self, name: str, value: bool, now_us: int) -> None:
        """An input changes."""

    def reset(self, now_us: int) -> None:
        """Power lost and back."""

    def next_event_us(self) -> int | None:
        """When it must be looked at next, None for whenever."""


MakeCore = Callable[[BoardSettings, Callable[[dict[str, Any]], None]], Core]
Actions = Mapping[str, Callable[[Any], None]]
"""What a script may do to this core and to no other, by name."""
NO_ACTIONS: Actions = {}


class PtyBoard:
    """A core between a pty and the real clock; failure: why it ended by itself, '' where it did not."""

    def __init__(
        self,
        link: Path,
        log: BinaryIO | None,
        settings: BoardSettings,
        script: list[Step],
        baud: int,
        exit_closed_s: float | None,
        make_core: MakeCore = BoardCore,
        actions: Actions = NO_ACTIONS,
        bench: "Bench | None" = None,
    ) -> None:
        self.failure = ""
        self._actions = actions
        self._bench = bench
        self._link_path = link
        self._log_file = log
        self._script = [step for step in script if not step.from_light]
        self._since_light = [step for step in script if step.from_light]
        self._exit_closed_s = exit_closed_s
        self._started_s = time.monotonic()
        self._running = True
        self._core = make_core(settings, self._log)
        self._faults = FaultyLink()
        self._in_pace, self._out_pace = Pace(baud), Pace(baud)
        self._out = b""
        self._open = False
        self._was_open = False
        self._closed_since_s = 0.0
        self._master = -1
        self._due_us = 0
        self._make_pty()

    def _make_pty(self) -> None:
        self._master = open_pty(self._link_path)

    def _log(self, event: dict[str, Any]) -> None:
        if self._bench is not None:
            self._bench.note(event)
        if self._since_light and event["event"] == "gate":
            self._time_from_light(event["t_us"] * 1e-6)
        if self._log_file is None:
            return
        try:
            self._log_file.write(json.dumps(event).encode() + b"\n")
        except OSError as error:
            self._log_file = None
            self.failure = f"the log cannot be written ({error.strerror}); without its witness the board ends dark"
            self.stop()

    def _now_s(self) -> float:
        return time.monotonic() - self._started_s

    def stop(self, *_: object) -> None:
        """End after this turn."""
        self._running = False

    def run(self) -> None:
        """Serve until stopped, then go dark."""
        try:
            while self._running:
                self._turn()
        finally:
            self._core.link_lost(self._now_us())
            self._link_path.unlink(missing_ok=True)
            if self._bench is not None:
                self._bench.close()

    def _now_us(self) -> int:
        return int(self._now_s() * 1e6)

    def _turn(self) -> None:
        if self._open and self._now_us() - self._due_us > LATE_US:
            # This process ran late, not the board that it stands for: what lies there came bit by bit meanwhile.
            self._read(self._due_us)
        self._follow_script()
        self._core.advance(self._now_us())
        self._watch_port()
        if self._open:
            self._read(self._now_us())
            self._core.advance(self._now_us())
            self._write()
        else:
            self._core.bytes_to_send()
            self._out = b""
        if self._bench is not None:
            self._bench.serve(self._now_us())
        self._wait()

    def _wait(self) -> None:
        now_us, due_us = self._now_us(), self._core.next_event_us()
        wait_s = TURN_MAX_S if due_us is None else min(TURN_MAX_S, max(0.0, (due_us - now_us) * 1e-6))
        if self._script:
            wait_s = min(wait_s, max(0.0, self._script[0].at_s - self._now_s()))
        self._due_us = now_us + round(wait_s * 1e6)
        if not self._open:
            time.sleep(max(wait_s, 0.001))
        elif self._in_pace.allowed(self._now_s()) < 1:
            time.sleep(0.0005)
        else:
            select.select([self._master], [self._master] if self._out else [], [], wait_s)

    def _watch_port(self) -> None:
        poller = select.poll()
        poller.register(self._master, select.POLLIN)
        hung_up = any(flags & select.POLLHUP for _, flags in poller.poll(0))
        if self._open and hung_up:
            self._last_words()
            self._port_closed(self._now_us())
        elif not self._open and not hung_up:
            self._log({"t_us": self._now_us(), "event": "port", "open": True})
            self._was_open = True
        self._open = not hung_up
        closed_for_s = self._now_s() - self._closed_since_s
        if self._exit_closed_s is not None and self._was_open and not self._open and closed_for_s > self._exit_closed_s:
            self._running = False

    def _port_closed(self, now_us: int) -> None:
        self._log({"t_us": now_us, "event": "port", "open": False})
        self._core.link_lost(now_us)
        self._closed_since_s = self._now_s()
        self._open = False

    def _read(self, since_us: int) -> None:
        """Take what lies there as if it had come evenly from since_us until now."""
        allowed = self._in_pace.allowed(self._now_s())
        if allowed < 1:
            return
        try:
            data = os.read(self._master, allowed)
        except (BlockingIOError, OSError):
            self._in_pace.idle()
            return  # nothing there, or the host has just closed: the next look at the port tells
        self._in_pace.passed(len(data))
        if len(data) < allowed:
            self._in_pace.idle()
        data, late_us = self._faults.carry(data), self._now_us() - since_us
        pieces = max(1, late_us // LATE_US)
        for k in range(pieces):
            piece = data[len(data) * k // pieces : len(data) * (k + 1) // pieces]
            self._core.receive(piece, since_us + late_us * (k + 1) // pieces)

    def _last_words(self) -> None:
        """Take what a host wrote before it closed, so that no later host finds it in the line."""
        with suppress(OSError):  # empty, or the other end's EIO
            while data := os.read(self._master, READ_MAX):
                self._core.receive(self._faults.carry(data), self._now_us())

    def _write(self) -> None:
        self._out += self._faults.carry(self._core.bytes_to_send())
        allowed = min(self._out_pace.allowed(self._now_s()), len(self._out))
        if not self._out:
            self._out_pace.idle()
        if allowed < 1:
            return
        try:
            written = os.write(self._master, self._out[:allowed])
        except (BlockingIOError, OSError):
            return
        self._out_pace.passed(written)
        self._out = self._out[written:]

    def _time_from_light(self, light_s: float) -> None:
        self._script += [replace(step, at_s=light_s + step.at_s) for step in self._since_light]
        self._script.sort(key=lambda step: step.at_s)
        self._since_light = []

    def _follow_script(self) -> None:
        while self._script and self._script[0].at_s <= self._now_s():
            self._do(self._script.pop(0))

    def _do(self, step: Step) -> None:
        now_us = min(self._now_us(), int(step.at_s * 1e6))  # it happened when the script says, not when we looked
        if step.kind == "set":
            self._core.set_input(step.name, step.value, now_us)
        elif step.name == "reset":
            self._core.reset(now_us)
        elif step.name == "repair":
            self._faults.repair()
        elif step.name == "close":
            self._port_closed(now_us)
            os.close(self._master)
            self._make_pty()
        elif step.name in self._actions:
            self._actions[step.name](self._core)
        elif step.name in SENSOR_ACTIONS:
            if self._bench is not None:
                self._bench.break_down(step.name, now_us)
        else:
            self._faults.break_down(step.name, step.rate)


def _check_options(options: argparse.Namespace) -> None:
    check_link("--pty", options.pty)
    if options.baud < BAUD_MIN:
        raise InputError("--baud", options.baud, f"at least {BAUD_MIN}")


def main(arguments: list[str] | None = None, make_core: MakeCore = BoardCore, actions: Actions = NO_ACTIONS) -> int:
    """Run a board until SIGTERM or SIGINT."""
    parser = argparse.ArgumentParser(
        prog="optodrive.link.simulator.board_process", description="A simulated board on a pty."
    )
    parser.add_argument("--pty", type=Path, required=True, metavar="LINK", help="link this name to the pty")
    parser.add_argument("--log", type=Path, help="JSON lines: gate edges, states, faults, pulses")
    parser.add_argument("--limits", type=Path, help="TOML: the board's own limits")
    parser.add_argument("--script", type=Path, help="TOML: what happens to it, and when")
    parser.add_argument("--baud", type=int, default=1_000_000, help="pace of the serial line")
    parser.add_argument("--exit-when-closed", type=float, metavar="SECONDS", help="end when no host has it open")
    parser.add_argument("--seed", type=int, help="make the same nonces every time, so that a session can be replayed")
    add_sensor_options(parser)
    options = parser.parse_args(arguments)
    try:
        _check_options(options)
        settings = load_settings(options.limits) if options.limits else BoardSettings()
        script = load_script(options.script, actions) if options.script else []
        log = options.log.open("ab", buffering=0) if options.log else None
        bench = bench_of(options, settings)
    except InputError as error:
        print(f"optodrive.link.simulator.board_process: {error}", file=sys.stderr)
        return error.exit_status
    except OSError as error:
        print(f"optodrive.link.simulator.board_process: --log {options.log}: {error.strerror}", file=sys.stderr)
        return 2
    simulated = make_core is BoardCore
    if simulated:
        make_core = partial(BoardCore, seed=options.seed, steer=bench.mirrors.go if bench else None)
    board = PtyBoard(
        options.pty, log, settings, script, options.baud, options.exit_when_closed, make_core, actions, bench
    )
    if simulated:
        request_realtime_scheduling()  # a real board waits for none; before an emulator's, it would starve what it serves
    signal.signal(signal.SIGTERM, board.stop)
    signal.signal(signal.SIGINT, board.stop)
    board.run()
    if board.failure:
        print(f"optodrive.link.simulator.board_process: {board.failure}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
