"""The core on an emulated Cortex-M3, judged in the chip's own time: loss of its host, edges, watchdog, stalls.

The host is a real session whose time is virtual: it grants the chip's time.
"""

import os
import random
import signal
import threading

import numpy as np
import pytest
from session_rig import configured

from link_service_rig import CuttableLink
from optodrive.core.clock import ManualClock
from optodrive.link.board_setup import build_board_requirements
from optodrive.link.protocol.quantisation import WirePoints
from optodrive.link.session import board_link
from optodrive.link.session.session import BoardSession
from optodrive.link.simulator.guards import DEFAULT_LIMITS, BoardSettings

TICK_US = 100
WATCHDOG_US = 50_000
LEASE_S = DEFAULT_LIMITS.lease_ms * 1e-3
DARK_US, ON_US, DUTY = 600, 8000, 2000
PLACES = np.array([(30_500, 32_000), (34_000, 32_000), (30_500, 33_500), (34_000, 33_500)])
ROUNDS, MANY_ROUNDS = 3, 30
LATE_MAX_US = 2 * TICK_US
"""From an edge's time to the pin: what the main loop and the guards compute before."""


def build_points(count):
    rows = np.arange(count)
    columns = [np.full(count, value) for value in (DARK_US, ON_US, DUTY)]
    return WirePoints(np.column_stack([PLACES[rows % len(PLACES)], *columns]).astype(np.uint16), rows)


class Rig:
    """A session and a chip in one virtual time."""

    def __init__(self, make_chip):
        self.clock, self.log = ManualClock(), []
        self.chip = make_chip(BoardSettings(), self.log.append, seed=1)
        self.link = CuttableLink(self.chip, self.clock)
        self.session = BoardSession(self.link, self.clock, build_board_requirements(configured(LEASE_S)))

    def of(self, kind):
        return [event for event in self.log if event["event"] == kind]

    def step(self):
        self.session.step(0.002, renew_lease=True)

    def until(self, condition, steps=5000):
        for _ in range(steps):
            if condition():
                return
            self.step()
        raise AssertionError(f"{self.session.board}; log {self.log[-8:]}")

    def emit(self, duration_s=0.0):
        """Connect, arm, and emit points of a job that lasts many leases."""
        self.session.connect()
        if self.session.board.state == "FAULT":
            self.session.disarm()
            self.until(lambda: self.session.board.state == "DISARMED")
        self.session.arm()
        self.until(lambda: self.session.is_ready)
        self.log.clear()
        self.session.begin(build_points(4000), self.session.board_s() + 0.05, 1.5 * LEASE_S)
        self.until(lambda: len(self.of("pulse")) > 2)
        self.run(duration_s)

    def run(self, duration_s):
        """Let time pass for the host and the chip."""
        until_s = self.clock.now_s() + duration_s
        while self.clock.now_s() < until_s:
            self.step()

    def pass_time(self, duration_s):
        """Let time pass for the chip alone."""
        self.clock.sleep(duration_s)
        self.chip.advance(round(self.clock.now_s() * 1e6))


def kill_host(rig):
    """The kernel closes the port of a host that was killed."""
    rig.link.close()
    rig.pass_time(2 * LEASE_S)


def stop_host(rig):
    """A stopped host sends nothing and leaves the port open."""
    rig.pass_time(2 * LEASE_S)


def close_port(rig):
    rig.session.disconnect()
    rig.pass_time(2 * LEASE_S)


def cut_cable(rig):
    """Let nothing pass any more. The host runs on and renews the lease."""
    rig.link.is_cut = True
    rig.run(2 * LEASE_S)
    rig.link.is_cut = False


WAYS = {
    "kill -9": (kill_host, ("DISARMED", "link lost")),
    "SIGSTOP": (stop_host, ("FAULT", "fault")),
    "close": (close_port, ("DISARMED", "link lost")),
    "cut cable": (cut_cable, ("FAULT", "fault")),
}


def check_host_loss(rig, way):
    """Lose the host of an emitting chip. Return the time of the last edge after the end of the lease, µs."""
    lose, ended = WAYS[way]
    lost_us = rig.clock.now_s() * 1e6
    assert rig.chip.state == "RUNNING"
    lose(rig)
    state, last_pin, last_gate, lease = (rig.of(kind)[-1] for kind in ("state", "pin", "gate", "lease"))
    assert (state["state"], state["reason"]) == ended
    assert not last_gate["on"]
    assert not last_pin["on"]
    assert not rig.chip.gate
    late_us = last_pin["t_us"] - lease["until_us"]
    assert late_us <= TICK_US
    assert lease["until_us"] - lease["t_us"] == LEASE_S * 1e6
    if ended[0] == "FAULT":  # by nothing but the end of the lease
        assert rig.of("fault")[-1]["fault"] == "LINK"
        assert late_us >= -DARK_US - TICK_US
        assert state["t_us"] == lease["until_us"]
    else:
        assert last_pin["t_us"] <= lost_us + TICK_US
    rig.session.disconnect()
    return late_us


@pytest.fixture
def rig(chips):
    rig = Rig(chips(0))
    yield rig
    rig.chip.close()


@pytest.mark.parametrize("rounds", [ROUNDS, pytest.param(MANY_ROUNDS, marks=pytest.mark.slow)])
@pytest.mark.parametrize("way", WAYS)
def test_the_gate_is_off_a_tick_after_the_lease_of_a_lost_host(rig, way, rounds):
    source = random.Random(0)
    late_us = []
    for _ in range(rounds):
        rig.emit(source.uniform(0.0, 0.15))
        late_us.append(check_host_loss(rig, way))
    print(f"{way}: last edge {min(late_us)} to {max(late_us)} µs after the end of the lease")


@pytest.mark.parametrize(("guard", "way"), [(3, "SIGSTOP"), (3, "cut cable"), (1, "kill -9")])
def test_a_chip_without_a_guard_is_detected(chips, guard, way):
    rig = Rig(chips(guard))
    rig.emit(0.5e-6 * ON_US)
    with pytest.raises(AssertionError):
        check_host_loss(rig, way)
    rig.chip.close()


def test_the_pin_follows_the_log_and_is_never_early(rig):
    rig.emit()
    rig.until(lambda: len(rig.of("pulse")) > 200)
    pulses = rig.of("pulse")
    pins = rig.of("pin")[: 2 * len(pulses)]
    assert [pin["on"] for pin in pins] == [True, False] * len(pulses)
    due_us = [at_us for pulse in pulses for at_us in (pulse["on_us"], pulse["off_us"])]
    late_us = np.array([pin["t_us"] for pin in pins]) - due_us
    print(f"pin after the log's edge: median {np.median(late_us):.0f} µs, at most {late_us.max()} µs")
    assert late_us.min() >= 0
    assert late_us.max() <= LATE_MAX_US


def check_watchdog(rig):
    rig.chip.inject_fault("stop_loop")
    stopped_us = rig.clock.now_s() * 1e6
    rig.pass_time(2 * WATCHDOG_US * 1e-6)
    assert rig.of("state")[-1]["reason"] == "boot"
    last = rig.of("pin")[-1]
    assert not last["on"]
    assert rig.of("gate")[-1] == last | {"event": "gate", "reason": "reset"}, "not the end of a pulse"
    # The next tick feeds it once more, for the loop's last iteration.
    assert WATCHDOG_US <= last["t_us"] - stopped_us <= WATCHDOG_US + 2 * TICK_US


def test_the_watchdog_turns_the_gate_off_after_50_ms(rig):
    rig.emit()
    check_watchdog(rig)


def test_a_chip_without_a_watchdog_is_detected(chips):
    rig = Rig(chips(15))
    rig.emit()
    with pytest.raises(AssertionError):
        check_watchdog(rig)
    rig.chip.close()


class Staller(threading.Thread):
    """Suspends a process again and again, until it ends."""

    def __init__(self, pid):
        super().__init__(daemon=True)
        self._pid, self._ended = pid, threading.Event()
        self.count = 0

    def run(self):
        while not self._ended.wait(0.002):
            os.kill(self._pid, signal.SIGSTOP)
            self._ended.wait(0.003)
            os.kill(self._pid, signal.SIGCONT)
            self.count += 1

    def end(self):
        self._ended.set()
        self.join()


def test_a_computer_that_stalls_changes_nothing(chips, monkeypatch):
    def start():
        monkeypatch.setattr(board_link.secrets, "randbits", random.Random(4).getrandbits)
        return Rig(chips(0))

    rig, steps = start(), 0
    staller = Staller(rig.chip.pid)
    staller.start()
    rig.emit()
    while staller.count < 20:
        rig.step()
        steps += 1
    stop_host(rig)
    staller.end()
    rig.chip.close()
    stalled_log = rig.log
    rig = start()
    rig.emit()
    for _ in range(steps):
        rig.step()
    stop_host(rig)
    rig.chip.close()
    assert rig.log == stalled_log
