"""Balance of recurring pixels over a whole plan."""

from itertools import product

import numpy as np
import pytest

from optodrive.core.types.stimuli import FrameSequence, TactileFrame
from optodrive.planning.pipeline import plan_sequence
from optodrive.planning.scheduler.stage_balance import FrameLoads, balance
from stage_rig import build_stages as build_display


def build_case(seed, frames=4, pixels=8, stages=2):
    """Return beam times [f, n], reach [k, n], and all pixels on the first stage that reaches them."""
    rng = np.random.default_rng(seed)
    cost_s = np.where(rng.random((frames, pixels)) < 0.6, rng.uniform(2e-3, 20e-3, (frames, pixels)), 0.0)
    reach = rng.random((stages, pixels)) < 0.8
    reach[rng.integers(0, stages, pixels), np.arange(pixels)] = True
    return cost_s, reach, np.argmax(reach, axis=0)


def build_loads(cost_s, stage, stages):
    loads_s = np.stack([np.bincount(stage, each, stages) for each in cost_s])
    return FrameLoads(loads_s, *np.zeros((3, len(cost_s))))


def find_end_s(cost_s, stage, stages):
    """Return the time of a plan whose frames begin on all stages when the one before has ended on all."""
    return sum(np.bincount(stage, each, stages).max() for each in cost_s)


def test_the_share_is_nearly_the_best_of_all():
    over = []
    for seed in range(12):
        cost_s, reach, stage = build_case(seed)
        loads = build_loads(cost_s, stage, 2)
        balance(loads, cost_s, stage, reach)
        assert reach[stage, np.arange(8)].all()
        assert loads.loads_s == pytest.approx(build_loads(cost_s, stage, 2).loads_s)
        shares = (np.array(each) for each in product(range(2), repeat=8))
        best_s = min(find_end_s(cost_s, each, 2) for each in shares if reach[each, np.arange(8)].all())
        over.append(find_end_s(cost_s, stage, 2) / best_s)
    assert max(over) < 1.1
    assert np.mean(over) < 1.03


def test_light_that_is_shared_later_fills_what_is_uneven():
    cost_s, stage = np.full((2, 4), 5e-3), np.zeros(4, dtype=np.int64)
    loads = build_loads(cost_s, stage, 2)._replace(shared_s=np.full(2, 20e-3))
    balance(loads, cost_s, stage, np.ones((2, 4), dtype=bool))
    assert stage.tolist() == [0] * 4


@pytest.mark.parametrize("wait_s", [0.03, 0.05, 0.3])
def test_warm_pixels_are_expected_to_need_less(wait_s):
    display = build_display("display-437", 2)
    target_m = np.where(np.arange(437) == 218, 100e-6, 0.0)
    frames = tuple(TactileFrame(f"f{k}", wait_s * k, 1.0, target_m) for k in range(2))
    plan = plan_sequence(display, FrameSequence(frames), *display.build_cold_state()).plan
    show_at_s = np.array([0.0, float(np.diff(plan.start_s)[0])])
    expected_s = display.pulse_widths.compute_frames_s(np.tile(target_m, (2, 1)), show_at_s, 2, 0.0).sum(axis=1)
    assert expected_s == pytest.approx(plan.width_s, rel=0.2)
    assert (expected_s[1] < 0.95 * expected_s[0]) == (wait_s < 0.1)
