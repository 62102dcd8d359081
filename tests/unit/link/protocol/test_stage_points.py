"""Points of several stages: their bytes, their common end, their cut, and pauses before them."""

from dataclasses import replace

import numpy as np
import pytest

from displays import DISPLAYS
from optodrive.core.types.stimuli import FrameSequence, TactileFrame
from optodrive.link.board_setup import build_scales
from optodrive.link.protocol.quantisation import GATE_OFF_STEP_TICKS, TICKS_MAX
from optodrive.link.protocol.stage_points import PointCut, StagePoints, decode_stages
from optodrive.planning.pipeline import plan_sequence
from stage_rig import build_stages
from wire_points import build_points

DISPLAY = build_stages("display-437", 3)
SCALES = build_scales(DISPLAY.config)


@pytest.fixture(scope="module")
def plan():
    heights_m = np.random.default_rng(2).uniform(20e-6, 90e-6, 437)
    frame = TactileFrame("f", 0.0, 9.0, heights_m)
    return plan_sequence(DISPLAY, FrameSequence((frame,)), *DISPLAY.build_cold_state()).plan


def test_the_bytes_of_all_stages_decode_to_the_plan(plan):
    points = StagePoints.from_plan(plan, SCALES)
    payload = points.encode_payload()
    assert StagePoints.from_payload(payload, points.counts).encode_payload() == payload
    row, decoded = decode_stages(payload, points, SCALES)
    assert sorted(row) == list(range(437))
    assert decoded.start_s == pytest.approx(plan.start_s[row], abs=1e-9)
    assert decoded.width_s == pytest.approx(plan.width_s[row], abs=1e-9)
    for counts in ([1, 2], [len(payload) // 10, -1, 1]):
        with pytest.raises(ValueError, match="points"):
            StagePoints.from_payload(payload, counts)


def test_the_points_of_all_stages_end_together(plan):
    points = StagePoints.from_plan(plan, SCALES)
    ends = {int(one.compute_end_ticks()[-1]) for one in points.stages}
    assert ends == {round(plan.end_s * 1e6)}


@pytest.mark.parametrize("ticks", [0, 5, 60_000, TICKS_MAX, 200_000])
def test_a_pause_before_the_points_shifts_all_of_them(ticks):
    points = build_points(3, 100)
    later = points.add_pause(ticks)
    assert later.compute_end_ticks()[-3:].tolist() == (points.compute_end_ticks() + ticks).tolist()
    assert later.row[-3:].tolist() == [0, 1, 2]
    assert later.table[:-3, 3].tolist() == [0] * (len(later) - 3)
    assert len(later) - 3 == max(0, -(-(2000 + ticks - TICKS_MAX) // GATE_OFF_STEP_TICKS))


def test_a_cut_keeps_what_may_have_been_sent_and_all_rows_before_it(plan):
    points = StagePoints.from_plan(plan, SCALES)
    for sent_tick in (1.0, 3e4, 1e5, 2.5e5):
        cut = PointCut.find(points, sent_tick)
        for one, kept in zip(points.stages, cut.kept_points, strict=True):
            ends = one.compute_end_ticks()
            assert (ends[kept - 1 : -1] >= sent_tick).all()
            assert one.row[:kept].max() < cut.row
            assert not (one.row[kept:][one.row[kept:] >= 0] < cut.row).any()
            assert ends[kept - 1] <= cut.end_tick
        assert [int(plan.stage[row]) for row in cut.aim_rows] == [0, 1, 2]


@pytest.mark.parametrize("sent_tick", [-1000.0, 0.0])
def test_a_cut_before_the_begin_keeps_nothing(plan, sent_tick):
    assert PointCut.find(StagePoints.from_plan(plan, SCALES), sent_tick) == ([0, 0, 0], 0, 0, [-1, -1, -1])


def test_a_stage_without_pulses_idles_in_short_points():
    plan = plan_sequence(DISPLAYS["display-437"], build_sequence([5, 9]), *DISPLAYS["display-437"].build_cold_state())
    points = StagePoints.from_plan(replace(plan.plan, stage=np.array([1, 1])), SCALES)
    assert points.stages[0].table[:, 2].max() <= 10_000
    assert points.stages[0].row.max() == -1
    cut = PointCut.find(points, 2e4)
    assert cut.aim_rows[0] == -1


def build_sequence(pixels):
    target_m = np.zeros(437)
    target_m[pixels] = 100e-6
    return FrameSequence((TactileFrame("f", 0.0, 1.0, target_m),))
