"""A frame that is repeated gives each pixel the period of the frames."""

import numpy as np
import pytest

from displays import DISPLAYS
from optodrive.core.types.stimuli import FrameSequence, TactileFrame
from optodrive.planning.pipeline import plan_sequence
from optodrive.planning.scheduler import scheduler

PERIOD_S, REPEATS = 0.1, 8


def find_worst_interval(name, count, seed):
    """Return the largest deviation of an interval between two pulses of a pixel, in periods."""
    display, rng = DISPLAYS[name], np.random.default_rng(seed)
    target_m = np.zeros(len(display.layout))
    target_m[rng.choice(len(target_m), count, replace=False)] = 40e-6
    frames = tuple(TactileFrame(str(k), k * PERIOD_S, PERIOD_S, target_m) for k in range(REPEATS))
    plan = plan_sequence(display, FrameSequence(frames), *display.build_cold_state()).plan
    intervals_s = [np.diff(plan.start_s[plan.pixel == pixel]) for pixel in np.flatnonzero(target_m)]
    assert all(len(each) == REPEATS - 1 for each in intervals_s)
    return float(np.abs(np.concatenate(intervals_s) - PERIOD_S).max()) / PERIOD_S


@pytest.mark.parametrize(("name", "count"), [("display-437", 3), ("display-437", 24), ("display-1511", 20)])
def test_each_pixel_keeps_the_period(name, count):
    assert max(find_worst_interval(name, count, seed) for seed in range(3)) < 0.05


def test_a_path_that_reverses_is_caught(monkeypatch):
    """Mutant: the shortest path each time."""
    monkeypatch.setattr(scheduler, "RETURN_US", 10**9)
    assert find_worst_interval("display-437", 24, 0) > 0.5
