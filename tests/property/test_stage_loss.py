"""One of several boards is lost at a random moment: all light ends within a lease, and nothing else is lit."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from displays import DISPLAYS
from link_service_rig import WEB
from optodrive.core.types.stimuli import FrameSequence, PulseTrain
from optodrive.link.board_setup import build_scales
from optodrive.link.protocol.states import ARMED_STATES
from optodrive.link.service.link_service import LinkService
from optodrive.link.session import board_link
from planner_rig import build_frame
from stage_rig import BreakingLink, StageRig, build_stages

LEASE_S = DISPLAYS["display-437"].config.board.lease_s
REACTION_S = 0.02
"""Time from what ends the light until the last gate is off, without the lease."""
KINDS = ("fault", "silence", "unplugged", "power lost", "emergency stop")


def break_board(rig, stage, kind):
    core, link = rig.cores[stage], rig.links[stage]
    now_us = link._now_us()
    if kind == "fault":
        core.set_input("interlock", False, now_us)
    elif kind == "emergency stop":
        core.set_input("estop", True, now_us)
    elif kind == "silence":
        link.is_cut = True
    elif kind == "unplugged":
        link.is_broken = True
        core.on_link_lost(now_us)
    else:
        core.reset(now_us)


def repair(rig, stage):
    core, link = rig.cores[stage], rig.links[stage]
    link.is_cut = link.is_broken = False
    for name, value in (("interlock", True), ("estop", False)):
        core.set_input(name, value, link._now_us())


def list_planned(rig, record, plan):
    """Return begin in host time, x and y code, and stage of all pulses of a plan, [n, 4]."""
    rows = []
    for stage, scale in enumerate(build_scales(rig.display.config)):
        mine = plan.stage == stage
        codes = scale.to_codes(plan.x_rad[mine]), scale.to_codes(plan.y_rad[mine])
        rows.append(np.column_stack([record.start_s + plan.start_s[mine], *codes, np.full(mine.sum(), stage)]))
    return np.concatenate(rows)


def play_trains_through(monkeypatch, kind):
    """Break the first of two boards during trains. Return until when the other one's light lasts after that, s."""
    rig = StageRig(monkeypatch, build_stages("display-437", 2), link_type=BreakingLink).ready()
    rig.run(1.0)
    rig.arm()
    rig.run(0.01)
    trains = tuple(PulseTrain(50 * k, 0.0, 1.5, 0.02, 0.01, 1.0) for k in range(2))
    record = rig.store.find(rig.submit(FrameSequence((), trains), rig.remote.epoch).result().plan)
    rig.until(lambda: rig.clock.now_s() >= record.start_s + 0.2)
    broken_s = rig.clock.now_s()
    break_board(rig, 0, kind)
    rig.run(0.5)
    return rig.list_pulses()[:, 1].max() - broken_s


def test_without_abort_to_the_others_their_light_goes_on(monkeypatch):
    """Mutant: the loss of a board is not noticed."""
    monkeypatch.setattr(LinkService, "_watch_board", lambda _: None)
    assert play_trains_through(monkeypatch, "fault") > LEASE_S + REACTION_S


def test_without_the_short_silence_the_light_of_the_others_goes_on(monkeypatch):
    monkeypatch.setattr(board_link.BoardLink, "_silence_max_s", board_link.SILENCE_TIMEOUT_S)
    assert play_trains_through(monkeypatch, "silence") > LEASE_S + REACTION_S


@pytest.fixture
def patch(monkeypatch):
    return monkeypatch


@pytest.mark.parametrize("kind", KINDS)
@settings(
    max_examples=settings.default.max_examples // 20,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(
    count=st.integers(2, 4),
    stage=st.integers(0, 3),
    trains=st.booleans(),
    streamed=st.booleans(),
    after_s=st.floats(0.0, 0.6),
)
def test_all_light_ends_within_a_lease_and_nothing_else_is_emitted(
    patch, count, kind, stage, trains, streamed, after_s
):
    stage %= count
    rig = StageRig(patch, build_stages("display-437", count), link_type=BreakingLink).ready()
    rig.run(1.0)
    rig.arm()
    rig.run(0.01)
    sequence = build_frame(200.0, range(437), 9.0, 437)
    if trains:
        sequence = FrameSequence((), tuple(PulseTrain(50 * k, 0.0, 1.5, 0.02, 0.01, 1.0) for k in range(count)))
    record = rig.store.find(rig.submit(sequence, rig.remote.epoch, streamed and not trains).result().plan)
    plan = rig.queue.state.waiting[0].planned.plan
    rig.until(lambda: rig.clock.now_s() >= record.start_s + after_s)
    broken_s = rig.clock.now_s()
    break_board(rig, stage, kind)
    rig.until(lambda: rig.clock.now_s() > broken_s + 1.5)
    assert record.status == "failed"
    assert not {core.state for core in rig.cores} & set(ARMED_STATES)
    pulses, planned = rig.list_pulses(), list_planned(rig, record, plan)
    assert pulses[:, 1].max(initial=0.0) < broken_s + LEASE_S + REACTION_S
    for on_s, _, x, y, emitting in pulses:
        same = planned[(planned[:, 1:] == (x, y, emitting)).all(axis=1)]
        assert len(same)
        assert np.abs(same[:, 0] - on_s).min() < 2e-4
    repair(rig, stage)
    rig.until(lambda: rig.remote.connected)
    rig.await_result(WEB, rig.request(WEB, "disarm"))
    rig.run(1.0)
    rig.arm()
    rig.run(0.01)
    again = rig.store.find(rig.submit(build_frame(40.0, range(20), 1.0, 437), rig.remote.epoch).result().plan)
    rig.until(lambda: again.has_ended)
    assert again.status == "done"
