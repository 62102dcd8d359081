"""A board behind a pseudo-terminal in real time: it paces bytes, follows a script and writes a log."""

import json
import os
import select
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Protocol

from optodrive.link.simulator.board_core import EXACT_CLOCK, BoardClock, BoardCore
from optodrive.link.simulator.guards import BoardSettings
from optodrive.link.simulator.measured_mirrors import MIRROR_FAULTS
from optodrive.link.simulator.pseudo_terminal import READ_MAX, FaultyLink, LineRate, open_pty, remove_link
from optodrive.link.simulator.script import SENSOR_ACTIONS, ScriptStep

if TYPE_CHECKING:
    from optodrive.link.simulator.simulated_optics import SimulatedOptics

LOOP_WAIT_MAX_S = 0.02
POLLING_S = 0.005
"""Interval in which a port that opens, and requests to a sensor, are looked for; a wait does not end with them."""
LATE_LOOP_US = 2_000
"""An iteration this late was delayed by the operating system."""


class BoardBackend(Protocol):
    """A board behind the pty: the simulated board, or a firmware core elsewhere. Times are in µs since the start."""

    def advance(self, now_us: int) -> None:
        """Carry out each event due up to now_us."""

    def receive(self, data: bytes, now_us: int) -> None:
        """Process bytes that arrived at now_us."""

    def bytes_to_send(self) -> bytes:
        """Return the bytes for the host since the last call."""

    def on_link_lost(self, now_us: int) -> None:
        """Handle the close of the host's end."""

    def set_input(self, name: str, value: bool, now_us: int) -> None:
        """Change an input."""

    def receive_trigger(self, now_us: int) -> None:
        """Receive a rising edge at the trigger input."""

    def reset(self, now_us: int) -> None:
        """Lose and regain power."""

    def next_event_us(self) -> int | None:
        """Return the time of the next due event, None if there is none."""

    @property
    def lease_until_us(self) -> int:
        """End of the lease, 0 for a backend that logs it itself."""


BackendFactory = Callable[[BoardSettings, Callable[[dict[str, Any]], None]], BoardBackend]
ScriptActions = Mapping[str, Callable[[Any], None]]
"""Script actions of one kind of backend only, by name."""
NO_ACTIONS: ScriptActions = {}


class PtyBoard:
    """Connects a backend to a pty and the real clock. failure: why the board stopped by itself, '' if it did not."""

    def __init__(
        self,
        link: Path,
        log: BinaryIO | None,
        settings: BoardSettings,
        script: list[ScriptStep],
        baud: int,
        exit_when_closed_s: float | None,
        build_core: BackendFactory = BoardCore,
        actions: ScriptActions = NO_ACTIONS,
        optics: "SimulatedOptics | None" = None,
        clock: BoardClock = EXACT_CLOCK,
    ) -> None:
        self.failure = ""
        self._actions = actions
        self._optics = optics
        self._link_path = link
        self._log_file = log
        self._script = [step for step in script if step.origin == "start"]
        self._steps_from_first_pulse = [step for step in script if step.origin == "light"]
        self._steps_on_signal = [step for step in script if step.origin == "signal"]
        self._signal_count = 0
        self._exit_when_closed_s = exit_when_closed_s
        self._started_s = time.monotonic()
        self._clock = clock
        self._running = True
        self._core = build_core(settings, self._log)
        if isinstance(self._core, BoardCore):
            self._core.read_present_us = self._now_us
        if clock != EXACT_CLOCK:
            self._log({"t_us": 0, "event": "clock", "monotonic_s": self._started_s})
        self._faults = FaultyLink()
        self._input_rate, self._output_rate = LineRate(baud), LineRate(baud)
        self._output = b""
        self._is_open = False
        self._was_open = False
        self._closed_since_s = 0.0
        self._master = -1
        self._due_us = 0
        self._open_pty()

    def _open_pty(self) -> None:
        self._master = open_pty(self._link_path)
        self._terminal = self._link_path.readlink()

    def _log(self, event: dict[str, Any]) -> None:
        if self._optics is not None:
            self._optics.on_log_event(event)
        if self._steps_from_first_pulse and event["event"] == "gate":
            self._schedule_from_first_pulse(event["t_us"] * 1e-6)
        if self._log_file is None:
            return
        try:
            self._log_file.write(json.dumps(event).encode() + b"\n")
        except OSError as error:
            self._log_file = None
            self.failure = f"the log cannot be written ({error.strerror}); the board stops with the gate off"
            self.stop()

    def _now_s(self) -> float:
        return time.monotonic() - self._started_s

    def stop(self, *_: object) -> None:
        """Stop after this iteration."""
        self._running = False

    def on_signal(self, *_: object) -> None:
        """Carry out the next step that waits for a signal in the next iteration."""
        self._signal_count += 1

    def run(self) -> None:
        """Run until stopped, then disarm and remove the link."""
        try:
            while self._running:
                self._run_once()
        finally:
            self._core.on_link_lost(self._now_us())
            remove_link(self._link_path, self._terminal)
            if self._optics is not None:
                self._optics.close()

    def _now_us(self) -> int:
        return int(self._clock.read_s(self._now_s()) * 1e6)

    def _run_once(self) -> None:
        if self._is_open and self._now_us() - self._due_us > LATE_LOOP_US:
            # The process ran late, a real board would not: the waiting bytes arrived gradually in the meantime.
            self._read(self._due_us)
        self._advance()
        self._update_port_state()
        if self._is_open:
            self._read(self._now_us())
            self._advance()
            self._write()
        else:
            self._core.bytes_to_send()
            self._output = b""
        if self._optics is not None:
            self._optics.answer_requests(self._now_us())
        self._wait()

    def _advance(self) -> None:
        now_us = self._now_us()
        self._run_due_steps(now_us)
        self._core.advance(now_us)

    def _wait(self) -> None:
        now_us, due_us = self._now_us(), self._core.next_event_us()
        wait_s = LOOP_WAIT_MAX_S if self._is_open and self._optics is None else POLLING_S
        if due_us is not None:
            wait_s = min(wait_s, max(0.0, (due_us - now_us) * 1e-6))
        if self._script:
            wait_s = min(wait_s, max(0.0, self._script[0].at_s - self._now_s()))
        self._due_us = now_us + round(wait_s * 1e6)
        if not self._is_open:
            time.sleep(max(wait_s, 0.001))
        elif self._input_rate.available_bytes(self._now_s()) < 1:
            time.sleep(0.0005)
        else:
            select.select([self._master], [self._master] if self._output else [], [], wait_s)

    def _update_port_state(self) -> None:
        poller = select.poll()
        poller.register(self._master, select.POLLIN)
        hung_up = any(flags & select.POLLHUP for _, flags in poller.poll(0))
        if self._is_open and hung_up:
            self._drain_input()
            self._on_port_closed(self._now_us())
        elif not self._is_open and not hung_up:
            self._log({"t_us": self._now_us(), "event": "port", "open": True})
            self._was_open = True
        self._is_open = not hung_up
        closed_for_s = self._now_s() - self._closed_since_s
        if (
            self._exit_when_closed_s is not None
            and self._was_open
            and not self._is_open
            and closed_for_s > self._exit_when_closed_s
        ):
            self._running = False

    def _on_port_closed(self, now_us: int) -> None:
        self._log({"t_us": now_us, "event": "port", "open": False})
        self._core.on_link_lost(now_us)
        self._closed_since_s = self._now_s()
        self._is_open = False

    def _read(self, since_us: int) -> None:
        """Process the waiting bytes as if they had arrived evenly between since_us and now."""
        allowed = self._input_rate.available_bytes(self._now_s())
        if allowed < 1:
            return
        try:
            data = os.read(self._master, allowed)
        except (BlockingIOError, OSError):
            self._input_rate.cap_credit()
            return  # empty, or the host has just closed the port, which the next poll reports
        self._input_rate.consume(len(data))
        if len(data) < allowed:
            self._input_rate.cap_credit()
        data, late_us = self._faults.transmit(data), self._now_us() - since_us
        part_count = max(1, late_us // LATE_LOOP_US)
        for k in range(part_count):
            part = data[len(data) * k // part_count : len(data) * (k + 1) // part_count]
            at_us = since_us + late_us * (k + 1) // part_count
            self._run_due_steps(at_us)
            if not self._is_open:
                return  # a step has closed the port
            self._receive(part, at_us)

    def _receive(self, data: bytes, at_us: int) -> None:
        """Process bytes, and log the lease that they grant."""
        until_us = self._core.lease_until_us
        self._core.receive(data, at_us)
        if self._core.lease_until_us > until_us:
            self._log({"t_us": at_us, "event": "lease", "until_us": self._core.lease_until_us})

    def _drain_input(self) -> None:
        """Process the bytes that the host wrote before it closed, so that no later host receives their effect."""
        with suppress(OSError):  # empty, or EIO from the closed end
            while data := os.read(self._master, READ_MAX):
                self._receive(self._faults.transmit(data), self._now_us())

    def _write(self) -> None:
        self._output += self._faults.transmit(self._core.bytes_to_send())
        allowed = min(self._output_rate.available_bytes(self._now_s()), len(self._output))
        if not self._output:
            self._output_rate.cap_credit()
        if allowed < 1:
            return
        try:
            written = os.write(self._master, self._output[:allowed])
        except (BlockingIOError, OSError):
            return
        self._output_rate.consume(written)
        self._output = self._output[written:]

    def _schedule_from_first_pulse(self, first_pulse_s: float) -> None:
        self._script += [replace(step, at_s=first_pulse_s + step.at_s) for step in self._steps_from_first_pulse]
        self._script.sort(key=lambda step: step.at_s)
        self._steps_from_first_pulse = []

    def _run_due_steps(self, now_us: int) -> None:
        """Carry out the script's steps up to a time, each at its own time, however late this process runs."""
        while self._script and (at_us := int(self._clock.read_s(self._script[0].at_s) * 1e6)) <= now_us:
            self._run_step(self._script.pop(0), at_us)
        while self._signal_count:
            self._signal_count -= 1
            if self._steps_on_signal:
                self._run_step(self._steps_on_signal.pop(0), now_us)

    def _run_step(self, step: ScriptStep, now_us: int) -> None:
        if step.kind == "set":
            self._core.set_input(step.name, step.value, now_us)
        elif step.name == "reset":
            self._core.reset(now_us)
        elif step.name == "trigger":
            self._core.receive_trigger(now_us)
        elif step.name == "repair":
            self._faults.repair()
            self._inject_mirror_fault("", now_us)
        elif step.name == "close":
            self._on_port_closed(now_us)
            os.close(self._master)
            self._open_pty()
        elif step.name in self._actions:
            self._actions[step.name](self._core)
        elif step.name in MIRROR_FAULTS:
            self._inject_mirror_fault(step.name, now_us)
        elif step.name in SENSOR_ACTIONS:
            if self._optics is not None:
                self._optics.inject_fault(step.name, now_us)
        else:
            self._faults.inject_fault(step.name, step.rate)

    def _inject_mirror_fault(self, fault: str, now_us: int) -> None:
        if isinstance(self._core, BoardCore):
            self._core.inject_fault(fault, now_us)
