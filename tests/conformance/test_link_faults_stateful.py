"""Stateful test of a session over a faulty link: it never arms by itself, and pulses stay permitted and in order."""

from contextlib import suppress

import pytest
from hypothesis import Phase, event, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)
from virtual_rig import VirtualRig
from wire_format import HOST

from optodrive.core.errors import LinkError, NotReadyError
from optodrive.link.session.session import BoardSession

UNSAFE = (("interlock", False), ("key", False), ("estop", True))
EXAMPLES = settings.default.max_examples * 3 // 5
"""24 in every run, 60 with --slow."""
ENDING = tuple(HOST[name][0] for name in ("HELLO", "ABORT"))


class Owner(RuleBasedStateMachine):
    """An application that owns a session.

    allowed: how often the board may have become ARMED
    """

    @initialize(seed=st.integers(0, 2**16), endings_come_again=st.booleans())
    def power_up(self, seed, endings_come_again):
        self.rig = VirtualRig(seed)
        self.rig.up.never_again = () if endings_come_again else ENDING
        self.allowed = self.jobs = 0

    @property
    def session(self):
        return self.rig.session

    def connected(self):
        return self.session.connected

    def is_in(self, *states):
        return self.session.connected and self.session.board.state in states

    def times(self, reason):
        return sum(entry["event"] == "state" and entry["reason"] == reason for entry in self.rig.log)

    def now_us(self):
        return round(self.rig.clock.now_s() * 1e6)

    def pass_time(self, condition, duration_s, lease=True):
        """Run the application's loop, which disconnects when the session fails."""
        until_s = self.rig.clock.now_s() + duration_s
        try:
            while self.rig.clock.now_s() < until_s and not condition():
                self.session.step(0.002, lease)
        except LinkError:
            self.session.disconnect()
            self.allowed = self.times("armed")

    # --- application ---

    def connect(self):
        if not self.connected():
            with suppress(LinkError):
                self.session.connect()

    @rule()
    def connect_and_no_more(self):
        self.connect()
        self.pass_time(lambda: False, 0.1)

    @rule(wait_s=st.sampled_from([0.0, 1.0, 2.5, 2.5, 2.5]))
    def arm(self, wait_s):
        """Acknowledge a fault, end an arming that has not succeeded, then arm once."""
        self.connect()
        if self.is_in("FAULT"):
            self.inputs_are_safe_again()
            self.session.disarm()
            self.pass_time(lambda: self.is_in("DISARMED"), 0.5)
        if self.is_in("DISARMED") and self.session.has_arming:
            with pytest.raises(NotReadyError, match="being armed already"):
                self.session.arm()
            self.session.abort()
            self.pass_time(lambda: self.session.is_acknowledged and self.is_in("DISARMED"), 0.5)
        if self.is_in("DISARMED"):
            self.allowed = self.times("armed") + 1
            self.session.arm()
            self.pass_time(lambda: self.session.is_ready, wait_s)

    @rule(count=st.integers(1, 1500), ahead_s=st.sampled_from([0.05, 0.25, 1.0]), wait_s=st.sampled_from([0.0, 0.1, 1]))
    def stream(self, count, ahead_s, wait_s):
        if not (self.connected() and self.session.is_ready):
            self.arm(2.5)
        if self.connected() and self.session.is_ready:
            self.rig.begin(count, ahead_s=ahead_s)
            self.jobs += 1
            self.pass_time(lambda: False, wait_s)

    @precondition(lambda self: self.connected())
    @rule(duration_s=st.sampled_from([0.002, 0.05, 0.3, 1.2]), lease=st.sampled_from([True, True, True, False]))
    def wait(self, duration_s, lease):
        self.pass_time(lambda: False, duration_s, lease)

    @precondition(lambda self: self.connected())
    @rule(order=st.sampled_from(["flush", "abort", "disarm"]))
    def order(self, order):
        getattr(self.session, order)()
        self.pass_time(lambda: False, 0.02)

    @precondition(lambda self: self.connected())
    @rule(how=st.sampled_from(["disconnect", "close", "break_down"]))
    def disconnect(self, how):
        if how == "break_down":
            self.rig.link.break_down()
            self.pass_time(lambda: False, 0.1)
        else:
            getattr(self.session, how)()
            self.allowed = self.times("armed")
        assert not self.connected()
        assert self.rig.core.state in ("DISARMED", "FAULT")

    # --- environment ---

    @rule(
        loss=st.sampled_from([0.0, 0.02, 0.05]),
        extra=st.sampled_from([0.0, 0.1, 0.4]),
        pauses=st.sampled_from([0.0, 0.01]),
    )
    def faults(self, loss, extra, pauses):
        for way in (self.rig.up, self.rig.down):
            way.loss, way.extra, way.pauses = loss, extra, pauses

    @rule(change=st.sampled_from(UNSAFE), comes_back=st.sampled_from([True, True, False]))
    def an_input_changes(self, change, comes_back):
        name, unsafe = change
        self.rig.core.set_input(name, unsafe, self.now_us())
        if comes_back:
            self.inputs_are_safe_again()

    def inputs_are_safe_again(self):
        for name, unsafe in UNSAFE:
            self.rig.core.set_input(name, not unsafe, self.now_us())

    @rule()
    def the_board_is_reset(self):
        self.rig.core.reset(self.now_us())

    @precondition(lambda self: self.connected())
    @rule(duration_s=st.sampled_from([0.03, 0.25, 3.0]))
    def the_host_stalls(self, duration_s):
        self.rig.clock.sleep(duration_s)
        self.rig.core.advance(self.now_us())

    # --- invariants ---

    @invariant()
    def gate_is_off_unless_running(self):
        assert not self.rig.core.gate or self.rig.core.state == "RUNNING"

    @invariant()
    def armed_only_as_often_as_its_owner_asked(self):
        assert self.times("armed") <= self.allowed, "armed by itself"

    def teardown(self):
        if hasattr(self, "rig"):
            self.session.close()
            pulses = self.rig.check()
            event(f"jobs: {min(self.jobs, 3)}, pulses: {'some' if pulses else 'none'}")


TestOwner = Owner.TestCase
TestOwner.settings = settings(max_examples=EXAMPLES, stateful_step_count=30)


def test_a_session_that_rearms_by_itself_is_detected(monkeypatch):
    connect = BoardSession.connect

    def eager(self):
        connect(self)
        if self.board.state == "DISARMED":
            self.arm()

    monkeypatch.setattr(BoardSession, "connect", eager)
    once = settings(max_examples=200, stateful_step_count=30, phases=[Phase.generate], database=None)
    with pytest.raises(AssertionError, match="armed by itself"):
        run_state_machine_as_test(Owner, settings=once)
