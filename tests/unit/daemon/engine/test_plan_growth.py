"""A streamed frame is planned in two parts, and lights what it would as a whole."""

from dataclasses import fields, replace
from math import inf

import numpy as np
import pytest

from displays import DISPLAYS
from link_service_rig import WEB, ServiceRig
from optodrive.core.errors import LocalProtocolError
from optodrive.core.types.plans import LimitedPlan
from optodrive.core.types.stimuli import FrameSequence, TactileFrame
from optodrive.daemon.engine import planner as planner_module
from optodrive.daemon.engine.active_plan import ThermalEstimate
from optodrive.daemon.engine.plan_making import (
    PlanningRequest,
    PlanningSnapshot,
    build_cut_snapshot,
    grow_plan,
    make_plan,
    may_grow,
)
from optodrive.daemon.engine.planner import HORIZON_MAX_S, HORIZON_MIN_S, StreamHorizon
from optodrive.daemon.push import BuiltRequest, Push
from optodrive.link.board_setup import build_scales
from optodrive.link.protocol.quantisation import DUTY_MAX
from optodrive.physics.discovered_term import KEY, KNOTS, DiscoveredTerm
from optodrive.planning.batch_limiter import BatchLimiter
from planner_rig import PlannerRig, build_frame, build_train

FRAMES, PLAYED = 250, 20
STREAM = Push("frame", {}, 0.0, 0, streamed=True, lists_pulses=False)


def with_low_caps(name):
    """Return a display whose caps trim pulses and make the mirrors pause often."""
    display = DISPLAYS[name]
    caps = display.budget.caps._replace(absorber_k=60.0, galvo_rad2_per_s4=6e4**2)
    return replace(display, budget=display.budget._replace(caps=caps))


def draw_frame(rng, pixels):
    count = int(rng.integers(1, min(400, pixels)))
    target_m = np.zeros(pixels)
    target_m[rng.choice(pixels, count, replace=False)] = rng.uniform(10e-6, 120e-6, count)
    return FrameSequence((TactileFrame("f", 0.0, 3600.0, target_m),))


def make(display, sequence, snapshot, horizon_s=inf):
    built, scales = BuiltRequest(sequence), build_scales(display.config)
    request = PlanningRequest(lambda: built, STREAM)
    return make_plan(display, scales, request, built, snapshot, "p1", lambda fraction: None, horizon_s)


def begin(display):
    thermal = ThermalEstimate(*display.build_cold_state())
    return PlanningSnapshot(thermal, 0.0, thermal)


@pytest.mark.parametrize(
    "display", [DISPLAYS["display-1511"], with_low_caps("display-437")], ids=["display-1511", "low caps"]
)
def test_the_bytes_of_500_random_frames_in_two_parts_are_those_of_the_whole(display):
    rng, snapshot, scales, grown_plans = np.random.default_rng(7), begin(display), build_scales(display.config), 0
    for _ in range(FRAMES):
        sequence = draw_frame(rng, len(display.pixels))
        whole, plan = make(display, sequence, snapshot), make(display, sequence, snapshot, rng.uniform(0.0, 0.15))
        first = plan.points.encode_payload()
        if plan.growth is None:
            assert first == whole.points.encode_payload()
        else:
            grown = grow_plan(plan, plan.growth, scales, lambda fraction: None)
            assert first + grown.added.encode_payload() == whole.points.encode_payload()
            np.testing.assert_array_equal(grown.rows.points.stages[0].row, whole.points.stages[0].row)
            for item in fields(whole.planned.budget):
                one, other = (getattr(each.planned.budget, item.name) for each in (grown.rows, whole))
                np.testing.assert_array_equal(one, other, err_msg=item.name)
            plan = plan.rebase(plan.record.start_s, plan.before, grown.rows)
            grown_plans += 1
        assert plan.record.pulse_count == whole.record.pulse_count
        assert plan.crc == whole.crc
        at_s = whole.record.start_s + float(rng.uniform(0.0, 0.1))
        tick_s = scales[0].tick_s
        snapshot = build_cut_snapshot(whole, snapshot.thermal, at_s, display.budget, tick_s) or snapshot
    assert grown_plans > 0.8 * FRAMES


def test_a_second_part_that_is_not_limited_is_not_handed_over(monkeypatch):
    """Mutant: the limiter lets the second part pass."""
    display, grant, is_second = with_low_caps("display-437"), BatchLimiter.grant, []

    def grant_first(limiter, batch):
        if not is_second:
            return grant(limiter, batch)
        columns, nothing = {item.name: getattr(batch, item.name) for item in fields(batch)}, np.zeros(len(batch))
        headroom_k = np.zeros(len(display.pixels))
        return LimitedPlan(
            **columns, energy_j=nothing, trimmed_j=nothing, reason=np.full(len(batch), ""), headroom_k=headroom_k
        )

    monkeypatch.setattr(BatchLimiter, "grant", grant_first)
    target_m = np.full(len(display.pixels), 100e-6)
    sequence = FrameSequence((TactileFrame("f", 0.0, 3600.0, target_m),))
    plan = make(display, sequence, begin(display), 0.05)
    is_second.append(True)
    with pytest.raises(LocalProtocolError, match="passes a cap"):
        grow_plan(plan, plan.growth, build_scales(display.config), lambda fraction: None)


def test_a_part_does_not_end_with_the_gate_off():
    """Behind such a pulse the mirrors stand at the next lit one, which a part does not know."""
    display = DISPLAYS["display-437"]
    caps = display.budget.caps._replace(absorber_k=1e-3)
    dark = replace(display, budget=display.budget._replace(caps=caps))
    sequence = draw_frame(np.random.default_rng(1), len(display.pixels))
    assert make(dark, sequence, begin(dark), 0.02).growth is None
    assert make(display, sequence, begin(display), 0.02).growth is not None


def test_a_frame_that_a_discovered_term_may_refuse_is_planned_as_a_whole():
    """Its first part would play already when the second one leaves the range of the term's data."""
    table = {"where": "displacement", "depends_on": "gas", "unit": "m", "formula": "f", "source": "here"}
    term = DiscoveredTerm.model_validate(table | {"low": 0.0, "high": 100.0, "values": [0.0] * KNOTS})
    display = DISPLAYS["display-437"]
    found = display.parameters.model_copy(update={"discovered": (term,), "planner_terms": (KEY,)})
    extended = replace(display, parameters=found)
    target_m = np.where(np.arange(len(display.pixels)) < 40, 50e-6, 0.0)
    sequence = FrameSequence((TactileFrame("f", 0.0, 3600.0, target_m),))
    assert make(display, sequence, begin(display), 0.02).growth is not None
    assert make(extended, sequence, begin(extended), 0.02).growth is None


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, True),
        ({"streamed": False}, False),
        ({"lists_pulses": True}, False),
        ({"options": {"policy": "trim"}}, True),
        ({"options": {"policy": "refuse"}}, False),
        ({"options": {"policy": "delay"}}, False),
    ],
)
def test_only_the_frames_of_a_stream_are_planned_in_parts(changes, expected):
    assert may_grow(STREAM._replace(**changes), build_frame(), 1) == expected
    assert not may_grow(STREAM._replace(**changes), build_train(1.0), 1)
    assert not may_grow(STREAM._replace(**changes), build_frame(), 2)


def test_the_horizon_follows_the_interval_between_frames():
    horizon = StreamHorizon()
    assert horizon.follow(10.0) == HORIZON_MAX_S
    assert horizon.follow(10.05) == pytest.approx(0.075)
    assert horizon.follow(10.06) == HORIZON_MIN_S
    assert horizon.follow(12.0) == HORIZON_MAX_S


# --- in virtual time, on the link service and a simulated board


@pytest.fixture
def rig(rig, monkeypatch):
    """The rig, with a planner that plans little more than the lead of a frame at once."""
    monkeypatch.setattr(StreamHorizon, "follow", lambda self, arrived_s: 0.0)
    return rig


def stream(rig, height_um=200.0, pixels=range(16)):
    """Submit a frame as a stream does. Return its record."""
    future = rig.submit(build_frame(height_um, pixels), rig.remote.epoch, streamed=True, lists_pulses=False)
    return rig.store.find(future.result().plan)


def push(rig, sequence):
    return rig.store.find(rig.submit(sequence, rig.remote.epoch).result().plan)


def finish(rig, record):
    rig.until(lambda: record.has_ended)
    return record


def stall_until(rig, condition):
    """Run link and board without the planner's loop, once the plan has begun."""
    rig.until(lambda: rig.queue.state.running)
    for _ in range(1000):
        if condition():
            return
        ServiceRig.run(rig)
    pytest.fail("it did not come to that")


def list_emitted(rig):
    """Return (start from the first pulse in µs, width in µs, angles, duty) of the emitted pulses."""
    pulses = [event for event in rig.log if event["event"] == "pulse"]
    begin_us = pulses[0]["on_us"]
    return [
        (each["on_us"] - begin_us, each["off_us"] - each["on_us"], each["x"], each["y"], each["duty"])
        for each in pulses
    ]


def test_a_frame_grows_while_it_plays_and_is_one_plan(rig):
    record = stream(rig)
    assert 0 < record.pulse_count < 16
    finish(rig, record)
    assert (record.status, record.pulse_count, record.executed_count, record.dropped) == ("done", 16, 16, 0)
    assert len(rig.store.list_recent()) == 1
    assert record.execution.simulated_m == pytest.approx(200e-6, rel=0.01)
    assert rig.queue.accounts.totals == {"planned": 16, "sent": 16, "executed": 16}
    assert rig.session.board.underruns == 0


def test_the_board_emits_what_it_would_of_whole_plans(monkeypatch):
    """Random frames one after another, on two boards in step."""
    logs = []
    for horizon_s in (0.0, inf):
        monkeypatch.setattr(StreamHorizon, "follow", lambda self, arrived_s, horizon_s=horizon_s: horizon_s)
        rig, rng, grown = PlannerRig(monkeypatch).ready(), np.random.default_rng(4), 0
        rig.arm()
        for _ in range(PLAYED):
            target_m = rng.uniform(20e-6, 300e-6, 16) * (rng.random(16) < 0.8)
            sequence = FrameSequence((TactileFrame("f", 0.0, 3600.0, target_m),))
            record = rig.store.find(
                rig.submit(sequence, rig.remote.epoch, streamed=True, lists_pulses=False).result().plan
            )
            planned_at_once = record.pulse_count
            finish(rig, record)
            assert record.status == "done"
            grown += record.pulse_count > planned_at_once
        logs.append((list_emitted(rig), grown))
    (in_parts, grown), (whole, none) = logs
    assert in_parts == whole
    assert (grown > 0.8 * PLAYED, none) == (True, 0)


@pytest.mark.parametrize("executed", range(17))
def test_a_newer_frame_truncates_at_every_point_and_nothing_more_is_planned(rig, executed):
    first = stream(rig)
    rig.until(lambda: first.executed_count >= executed)
    planned = first.pulse_count
    second = stream(rig, 250.0)
    finish(rig, second)
    assert first.has_ended
    assert first.pulse_count == planned == first.executed_count + first.dropped
    assert first.status == ("done" if first.executed_count == 16 else "superseded")
    assert (second.status, second.executed_count) == ("done", 16)
    assert len(list_emitted(rig)) == first.executed_count + 16
    assert second.execution.simulated_m == pytest.approx(250e-6, rel=0.01)
    assert rig.session.board.underruns == 0


def test_a_rest_that_comes_too_late_is_a_frame_of_its_own(rig):
    first = stream(rig)
    planned = first.pulse_count
    stall_until(rig, lambda: len(rig.list_emitted()) == planned and not rig.boards.has_points)
    finish(rig, first)
    assert (first.status, first.executed_count) == ("superseded", planned)
    (rest,) = [record for record in rig.store.list_recent() if record is not first]
    finish(rig, rest)
    assert (rest.status, rest.executed_count) == ("done", 16 - planned)
    pixels = [pixel for record in (first, rest) for pixel in record.execution.pixel.tolist()]
    assert sorted(pixels) == list(range(16))
    assert rest.execution.simulated_m == pytest.approx(200e-6, rel=0.01)


def test_a_newer_frame_that_comes_after_a_late_end_leaves_no_rest(rig):
    first = stream(rig)
    stall_until(rig, lambda: not rig.boards.has_points and len(rig.list_emitted()) == first.pulse_count)
    second = stream(rig, 250.0)
    finish(rig, second)
    rig.run(1.0)
    assert (first.status, second.status) == ("superseded", "done")
    assert len(list_emitted(rig)) == first.executed_count + 16


def test_a_newer_frame_that_comes_before_the_rest_of_an_ended_one_is_one_plan(rig):
    first = stream(rig)
    stall_until(rig, lambda: not rig.boards.has_points and len(rig.list_emitted()) == first.pulse_count)
    rig.remote.connection.receive()
    rig.queue.update_jobs(None)  # the loop sees the end before the planning thread begins with the rest
    assert first.has_ended
    second = stream(rig, 250.0)
    finish(rig, second)
    rig.run(0.2)
    assert (second.status, second.executed_count) == ("done", 16)
    assert rig.store.list_recent() == [first, second]


@pytest.mark.parametrize("kind", ["stop", "pause"])
def test_nothing_is_planned_behind_a_frame_that_was_stopped_or_paused(rig, kind):
    record = stream(rig)
    planned = record.pulse_count
    rig.until(lambda: rig.list_emitted())
    rig.await_result(WEB, rig.request(WEB, kind))
    rig.run(0.2)
    assert record.has_ended
    count = len(rig.list_emitted())
    assert count <= record.executed_count + 1 < planned
    if kind == "pause":
        rig.request(WEB, "resume")
    else:
        rig.arm()
    rig.run(1.0)
    assert len(rig.list_emitted()) == count
    assert record.status == ("superseded" if kind == "pause" else "stopped")


def test_a_frame_that_has_not_begun_at_a_pause_is_played_whole_after_it(rig):
    record = stream(rig)
    assert record.pulse_count < 16
    rig.await_result(WEB, rig.request(WEB, "pause"))
    rig.run(0.2)
    assert not rig.list_emitted()
    rig.request(WEB, "resume")
    finish(rig, record)
    assert (record.status, record.pulse_count, record.executed_count) == ("done", 16, 16)
    assert rig.queue.accounts.totals == {"planned": 16, "sent": 16, "executed": 16}
    assert record.execution.simulated_m == pytest.approx(200e-6, rel=0.01)


def test_what_is_pushed_goes_behind_the_whole_frame(rig):
    record = stream(rig)
    assert record.pulse_count < 16
    other = push(rig, build_frame(90.0))
    assert record.pulse_count == 16
    finish(rig, other)
    assert (record.status, other.status) == ("done", "done")
    assert record.executed_count == other.executed_count == 16
    assert other.execution.simulated_m == pytest.approx(90e-6, rel=0.01)


def test_the_rest_keeps_to_a_cap_that_was_lowered_meanwhile(rig):
    record = stream(rig)
    planned = record.pulse_count
    rig.dimmer.set_share(0.5)
    finish(rig, record)
    (rest,) = [each for each in rig.store.list_recent() if each is not record]
    finish(rig, rest)
    assert record.status == "superseded"
    assert 0 < record.executed_count == planned - record.dropped
    assert (rest.status, rest.executed_count) == ("done", 16 - record.executed_count)
    duties = [duty for *_, duty in list_emitted(rig)]
    assert max(duties[: record.executed_count]) > 0.9 * DUTY_MAX
    assert max(duties[record.executed_count :]) <= 0.5 * DUTY_MAX


def test_a_rest_that_cannot_be_proven_is_not_played(rig, monkeypatch):
    def refuse(*_arguments):
        raise LocalProtocolError("encoded pulse 3 passes a cap")

    monkeypatch.setattr(planner_module, "grow_plan", refuse)
    record = stream(rig)
    finish(rig, record)
    assert (record.status, record.pulse_count) == ("failed", record.pulse_count)
    assert "the rest of a streamed frame could not be planned: encoded pulse 3 passes a cap" in record.error
    rig.run(0.5)
    assert len(rig.list_emitted()) <= record.pulse_count < 16
