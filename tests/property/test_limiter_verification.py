"""The encoded bytes of limited plans pass the limiter's verification after any previous plans."""

import numpy as np
import pytest

from optodrive.core.types.stimuli import FrameSequence, PulseTrain
from optodrive.daemon.engine.active_plan import ThermalEstimate
from optodrive.device.config_file import load_config
from optodrive.link.board_setup import build_board_requirements
from optodrive.link.protocol.quantisation import decode, quantise
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.limiter.limiter import commit_until, verify
from optodrive.planning.pipeline import plan_sequence

CONFIG = load_config()
DISPLAY = DisplayModel.from_config(CONFIG)
SCALE = build_board_requirements(CONFIG).scale
STRONG, BRISK = (0.040, 0.001, 2.4), (0.010, 0.010, 1.0)
"""Width, gap, s, and power, W: three caps trim the first, sometimes to zero."""


@pytest.mark.parametrize("seed", range(2))
def test_truncated_plans_in_succession_are_verified(seed):
    random = np.random.default_rng(seed)
    thermal, now_s, omitted, trimmed_by_touch = ThermalEstimate(*DISPLAY.build_cold_state()), 3.0, 0, 0
    for _ in range(40):
        start_s = round(now_s + random.uniform(0.05, 3.0), 6)
        budget = thermal.shift(-start_s).budget
        width_s, gap_s, power_w = STRONG if random.random() < 0.6 else BRISK
        train = PulseTrain(200, 0.0, 3.0, width_s, gap_s, power_w)
        plan = plan_sequence(DISPLAY, FrameSequence((), (train,)), DISPLAY.build_cold_heat(), budget).plan
        points = quantise(plan, SCALE)
        decoded = decode(points.encode_payload(), SCALE)
        verify(plan, points.row[decoded.index], decoded, budget, DISPLAY.budget)
        omitted += len(plan) - len(decoded.index)
        trimmed_by_touch += np.count_nonzero(plan.reason == "touch_temperature")
        until_s = random.uniform(0.2, 4.0)
        state = commit_until(plan, until_s, budget, DISPLAY.budget)
        thermal = ThermalEstimate(DISPLAY.build_cold_heat(), state).shift(start_s)
        now_s = start_s + until_s
    assert omitted
    assert trimmed_by_touch


def test_power_below_the_board_s_minimum_is_not_committed():
    trains = tuple(
        PulseTrain(200, 0.05 * k, 0.01, 0.01, 0.001, fraction * CONFIG.min_power_w)
        for k, fraction in enumerate((0.9, 1.0))
    )
    heat, budget = DISPLAY.build_cold_state()
    plan = plan_sequence(DISPLAY, FrameSequence((), trains), heat, budget).plan
    points = quantise(plan, SCALE)
    assert points.table[:, 4].tolist() == [0, 1]
    assert commit_until(plan, 1.0, budget, DISPLAY.budget).recent_power_w.tolist() == [CONFIG.min_power_w]
