"""Beats and restarts of a child whose process only sleeps: the test sends its beats and lets the time pass."""

import json
import os
import signal
import time

import pytest

from optodrive.core.child_process import BEAT, READY
from optodrive.core.clock import ManualClock
from optodrive.daemon.log import DaemonLog, Notifier
from optodrive.daemon.supervisor.child import HANG_S, RESTART_DELAYS_S, START_TIMEOUT_S, STEADY_S, Child
from optodrive.daemon.supervisor.supervisor import STALL_S, LinkView, Supervisor

MOMENT_S, STEP_S = 0.01, 0.05


class Sleeper:
    """A child under test, its clock, and its end of the channel."""

    def __init__(self):
        self.clock = ManualClock(1000.0)
        self.child = Child("planner", self.start_process, self.clock)
        self.channel = None

    def start_process(self, channel, number):
        self.close_channel()
        self.channel = channel.dup()
        return os.posix_spawn("/bin/sleep", ["sleep", "600"], {})

    def close_channel(self):
        if self.channel is not None:
            self.channel.close()

    def send(self, kind):
        self.channel.send(json.dumps({"kind": kind}).encode())
        self.child.receive()

    def die(self):
        """Kill the process and return how the child describes its end."""
        self.child.send_signal(signal.SIGKILL)
        while (ended := self.child.collect()) is None:
            time.sleep(0.001)
        return ended

    def live(self, lifetime_s):
        """Start the process, let it die after a time, and return the delay after which it is due again."""
        self.child.start()
        self.clock.sleep(lifetime_s)
        self.die()
        moments = 0
        while not self.child.is_due:
            self.clock.sleep(MOMENT_S)
            moments += 1
        return moments * MOMENT_S


@pytest.fixture
def sleeper():
    it = Sleeper()
    yield it
    if it.child.is_running:
        it.die()
    it.close_channel()


def test_a_child_hangs_after_two_seconds_without_a_beat(sleeper):
    sleeper.child.start()
    sleeper.send(READY)
    for _ in range(5):
        sleeper.clock.sleep(HANG_S - MOMENT_S)
        assert sleeper.child.find_hang(sleeper.clock.now_s()) is None
        sleeper.send(BEAT)
    sleeper.clock.sleep(HANG_S + MOMENT_S)
    assert sleeper.child.find_hang(sleeper.clock.now_s()) == "no beat for 2 s"
    sleeper.child.kill("killed: no beat for 2 s")
    assert sleeper.child.find_hang(sleeper.clock.now_s()) is None, "it is reported once"
    assert sleeper.die() == "killed: no beat for 2 s"


def test_a_supervisor_that_is_suspended_between_beats_and_verdict_kills_nothing(sleeper):
    sleeper.child.start()
    sleeper.send(READY)
    stepped_s = sleeper.clock.now_s()
    sleeper.child.receive()
    sleeper.clock.sleep(HANG_S + 1.0)
    assert sleeper.child.find_hang(stepped_s) is None
    sleeper.child.excuse()
    assert sleeper.child.find_hang(sleeper.clock.now_s()) is None


def test_a_child_hangs_if_it_is_not_ready_in_time(sleeper):
    sleeper.child.start()
    sleeper.clock.sleep(START_TIMEOUT_S - MOMENT_S)
    sleeper.send(BEAT)
    assert sleeper.child.find_hang(sleeper.clock.now_s()) is None
    sleeper.clock.sleep(2 * MOMENT_S)
    assert sleeper.child.find_hang(sleeper.clock.now_s()) == "not ready after 20 s"


@pytest.mark.parametrize("limit_s", [HANG_S, START_TIMEOUT_S])
def test_an_excused_child_has_all_its_time_again(sleeper, limit_s):
    sleeper.child.start()
    if limit_s == HANG_S:
        sleeper.send(READY)
    sleeper.clock.sleep(limit_s + 1.0)
    assert sleeper.child.find_hang(sleeper.clock.now_s()) is not None
    sleeper.child.excuse()
    sleeper.clock.sleep(limit_s - MOMENT_S)
    assert sleeper.child.find_hang(sleeper.clock.now_s()) is None
    sleeper.clock.sleep(2 * MOMENT_S)
    assert sleeper.child.find_hang(sleeper.clock.now_s()) is not None


def test_a_child_that_keeps_dying_starts_again_less_and_less_often(sleeper):
    delays_s = [sleeper.live(0.3) for _ in range(len(RESTART_DELAYS_S) + 2)]
    assert delays_s == pytest.approx(
        [*RESTART_DELAYS_S, RESTART_DELAYS_S[-1], RESTART_DELAYS_S[-1]], abs=1.5 * MOMENT_S
    )
    assert list(RESTART_DELAYS_S) == sorted(set(RESTART_DELAYS_S))


def test_a_child_that_lived_for_a_minute_starts_again_at_once(sleeper):
    assert [sleeper.live(0.3) for _ in range(3)] == pytest.approx(list(RESTART_DELAYS_S[:3]), abs=1.5 * MOMENT_S)
    assert sleeper.live(STEADY_S - MOMENT_S) == pytest.approx(RESTART_DELAYS_S[3], abs=1.5 * MOMENT_S)
    assert sleeper.live(STEADY_S + MOMENT_S) == 0.0


@pytest.fixture
def supervisor(sleeper, tmp_path):
    """A supervisor that serves with one child, and whose steps the test takes."""
    clock, log = sleeper.clock, DaemonLog()
    notifier = Notifier(clock, {})
    supervisor = Supervisor(sleeper.child, LinkView(tmp_path / "nowhere", clock), notifier, log, clock)
    supervisor._is_serving = True
    supervisor._step()
    sleeper.send(READY)
    yield supervisor
    supervisor.close()
    notifier.close()
    log.close()


def test_children_that_were_stopped_with_the_supervisor_have_all_their_time_again(sleeper, supervisor):
    """Ctrl-Z and fg: the supervisor may run first again, and finds no beats of the meantime."""
    pid = sleeper.child.pid
    sleeper.clock.sleep(HANG_S + STALL_S)
    supervisor._step()
    sleeper.clock.sleep(HANG_S / 4)
    supervisor._step()
    assert (sleeper.child.pid, sleeper.child.killed_because) == (pid, "")
    for _ in range(2):
        sleeper.clock.sleep(0.9 * STALL_S)
        supervisor._step()
    assert sleeper.child.killed_because or sleeper.child.starts == 2, "killed, and maybe collected in the same step"
    while sleeper.child.starts == 1:
        supervisor._step()
    assert [entry["reason"] for entry in supervisor._audit] == ["killed: no beat for 2 s"]


def test_a_child_that_died_again_starts_after_its_delay(sleeper, supervisor):
    for number, delay_s in enumerate(RESTART_DELAYS_S[:3], 1):
        os.kill(sleeper.child.pid, signal.SIGKILL)
        first, waited_s = sleeper.child.pid, 0.0
        while sleeper.child.pid == first:
            supervisor._step()
        while not sleeper.child.is_running:
            sleeper.clock.sleep(STEP_S)
            waited_s += STEP_S
            supervisor._step()
        assert sleeper.child.starts == number + 1
        assert waited_s == pytest.approx(delay_s, abs=1.5 * STEP_S)
