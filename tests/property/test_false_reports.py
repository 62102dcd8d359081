"""False reports of a board: no light is emitted in an epoch in which nobody has armed it.

A proxy between daemon and board falsifies fields of the board's messages for a while, with a right CRC, and is honest
again. Every epoch that ends, ends dark within a few milliseconds; a board is never armed for longer than a lease unless
it was armed in this epoch; and afterwards the board can be armed again and executes a plan.
"""

import random
from dataclasses import replace
from typing import NamedTuple

import pytest
from hypothesis import event, given
from hypothesis import strategies as st

from link_service_rig import OPERATOR, REQUIREMENTS, WEB, ServiceRig
from optodrive.link.protocol.states import LEASED_STATES
from optodrive.link.session.session import BoardSession
from optodrive.link.simulator.guards import DEFAULT_LIMITS, BoardSettings
from tampered_link import FIELDS, TamperedLink
from wire_points import build_points

STEP_S = 0.005
REACTION_S = 3 * STEP_S
"""Time from the end of an epoch to the last begin of a pulse."""
LEASE_S = 0.5
LONG = {"lease_ms": round(LEASE_S * 1e3)}
SETTINGS = BoardSettings(limits=replace(DEFAULT_LIMITS, **LONG))
PATIENT = replace(REQUIREMENTS, lease_s=LEASE_S, limits=replace(REQUIREMENTS.limits, **LONG))
SETTLED_S = 2.6
"""Time after which a link is up again that a false report has ended."""
PHASES = ("connecting", "arming", "armed", "running", "stopping")
STATE_FIELDS = [field for field in FIELDS if field.name in ("state", "fault", "reason")]


class Falsification(NamedTuple):
    """The change of a field: its value is set, or added to, or random."""

    how: str
    value: int = 0

    def build(self):
        if self.how == "set":
            return lambda value, maximum: min(self.value, maximum)
        if self.how == "add":
            return lambda value, maximum: (value + self.value) & maximum
        source = random.Random(self.value)
        return lambda value, maximum: source.randint(0, maximum)


FALSIFICATIONS = st.one_of(
    st.builds(Falsification, st.just("set"), st.sampled_from([*range(8), 2**15, 2**16 - 1, 2**31, 2**63, 2**64 - 1])),
    st.builds(Falsification, st.just("add"), st.sampled_from([1, -1, 48, 1000, -1000, 10**6, -(10**6), 2**31, 2**62])),
    st.builds(Falsification, st.just("random"), st.integers(0, 99)),
)
DURATIONS_S = st.sampled_from([0.002, 0.02, 0.06, 0.15, 0.45, 1.5])


class Scene:
    """One plan under false reports.

    epochs: time at which each began
    armed: epochs in which the board was armed
    """

    def __init__(self, fields, falsification, phase, for_s):
        self.tampering = fields, falsification.build(), for_s
        self.phase = phase
        self.rig = ServiceRig(link_type=TamperedLink, settings=SETTINGS, requirements=PATIENT).hello_all()
        self.epochs, self.armed = [(0.0, self.rig.epoch)], set()
        self.unarmed_s = 0.0

    def run(self):
        rig = self.rig
        self.enter("connecting")
        self.step(self.tampering[2] + SETTLED_S if self.phase == "connecting" else 0.1)
        self.enter("arming")
        if self.arm()["error"] is None:
            self.enter("armed")
            self.step(0.1)
            rig.begin(build_points(2000, 1000))
            self.step(0.3)
        self.enter("running")
        self.step(0.7)
        self.enter("stopping")
        self.await_result(OPERATOR, "stop")
        self.step(self.tampering[2] + SETTLED_S)
        self.judge()
        return self

    def recover(self):
        """Arm and execute a plan, now that the link is honest."""
        rig = self.rig
        result = self.await_result(WEB, "disarm")
        if result["error"] is not None:  # a link keeps what HELLO stated until an honest answer contradicts it
            assert result["error"]["code"] == "link", result
            assert any(field.message == "HELLO_REPLY" for field in self.tampering[0]), result
            self.step(SETTLED_S)
            result = self.await_result(WEB, "disarm")
        assert result["error"] is None, result
        result = self.arm()
        assert result["error"] is None, result
        self.step(0.1)
        before = len(rig.list_emitted())
        rig.begin(build_points(20, 77))
        self.step(0.3)
        assert len(rig.list_emitted()) == before + 20, rig.find_refusals()
        self.judge()

    def enter(self, phase):
        if phase == self.phase:
            fields, falsify, for_s = self.tampering
            self.rig.link.tamper(fields, falsify, for_s)

    def arm(self):
        self.armed.add(self.rig.epoch)
        return self.await_result(WEB, "arm", caller="ann")

    def await_result(self, client, kind, **fields):
        request_id = self.rig.request(client, kind, **fields)
        while (result := self.rig.find_result(client, request_id)) is None:
            self.step(STEP_S)
        return result

    def step(self, duration_s):
        """Run, and note epochs and for how long the board has been armed in an epoch in which nobody armed it."""
        rig = self.rig
        until_s = rig.clock.now_s() + duration_s
        while rig.clock.now_s() < until_s:
            rig.run(STEP_S, STEP_S)
            now_s = rig.clock.now_s()
            if rig.epoch != self.epochs[-1][1]:
                self.epochs.append((now_s, rig.epoch))
            if rig.core.state not in LEASED_STATES or rig.epoch in self.armed:
                self.unarmed_s = now_s
            assert now_s - self.unarmed_s <= LEASE_S + REACTION_S, f"{rig.core.state}: {rig.service.epoch.reason}"

    def judge(self):
        for begin_s, _ in self.rig.list_emitted():
            epoch = [number for since_s, number in self.epochs if since_s + REACTION_S <= begin_s][-1]
            assert epoch in self.armed, f"light at {begin_s:.3f} s of {self.epochs}"


SCENES = st.builds(
    Scene,
    st.one_of(st.lists(st.sampled_from(FIELDS), min_size=1, max_size=3), st.just(STATE_FIELDS)),
    FALSIFICATIONS,
    st.sampled_from(PHASES),
    DURATIONS_S,
)


@given(SCENES)
def test_light_needs_an_arming_of_its_epoch_whatever_a_board_reports(scene):
    scene.run().recover()
    event(f"{scene.phase}: {min(2, len(scene.epochs))} epochs, 2 meaning more")


def build_hidden_state(for_s):
    """Return the scene in which STATUS and ACK say DISARMED while the board runs. EVENT is honest."""
    fields = [field for field in STATE_FIELDS if field.name == "state" and field.message != "EVENT"]
    return Scene(fields, Falsification("set", 1), "running", for_s)


@pytest.mark.parametrize("for_s", [0.02, 0.45])
def test_a_board_that_is_said_to_be_disarmed_is_aborted(for_s):
    scene = build_hidden_state(for_s).run()
    assert scene.epochs[1][0] < scene.rig.clock.now_s()
    scene.recover()


def test_without_an_abort_the_light_ends_with_the_lease(monkeypatch):
    """Mutant: two independent ends of the light, of which this is the slower one."""
    monkeypatch.setattr(BoardSession, "abort", BoardSession.end_arming)
    with pytest.raises(AssertionError, match="light at"):
        build_hidden_state(0.02).run()


def test_without_both_the_light_goes_on(monkeypatch):
    """Mutant: the lease follows the reported state, too."""
    monkeypatch.setattr(BoardSession, "abort", BoardSession.end_arming)
    monkeypatch.setattr(BoardSession, "_may_have_lease", property(lambda self: self.board.state in LEASED_STATES))
    with pytest.raises(AssertionError, match="RUNNING"):
        build_hidden_state(0.02).run()


def arm_from_elsewhere(rig):
    """Let the board go to ARMING without a request of the host. Return the reason for which it leaves that state."""
    assert rig.core.machine.request_arming(1) == ""
    rig.until(lambda: rig.core.state not in LEASED_STATES)
    return [entry["reason"] for entry in rig.log if entry["event"] == "state"][-1]


def test_a_board_that_is_armed_by_itself_is_aborted_when_it_is_seen():
    assert arm_from_elsewhere(ServiceRig().hello_all().connect()) == "abort"


def test_without_the_abort_it_would_have_its_lease(monkeypatch):
    """Mutant."""
    monkeypatch.setattr(BoardSession, "_is_armed_by_itself", False)
    assert arm_from_elsewhere(ServiceRig().hello_all().connect()) == "fault"
