"""A frame that is repeated gives each pixel the period of the frames."""

import numpy as np
import pytest

from displays import DISPLAYS
from optodrive.core.types.stimuli import FrameSequence, TactileFrame
from optodrive.planning.pipeline import plan_sequence
from optodrive.planning.scheduler.scheduler import Scheduler

PERIOD_S, REPEATS = 0.1, 8


def find_worst_interval(name, count, seed, period_s=PERIOD_S, first=0):
    """Return the largest deviation of an interval between two pulses of a pixel, in periods, from the n-th on."""
    display, rng = DISPLAYS[name], np.random.default_rng(seed)
    target_m = np.zeros(len(display.layout))
    target_m[rng.choice(len(target_m), count, replace=False)] = 40e-6
    frames = tuple(TactileFrame(str(k), k * period_s, period_s, target_m) for k in range(REPEATS))
    plan = plan_sequence(display, FrameSequence(frames), *display.build_cold_state()).plan
    intervals_s = [np.diff(plan.start_s[plan.pixel == pixel]) for pixel in np.flatnonzero(target_m)]
    assert all(len(each) == REPEATS - 1 for each in intervals_s)
    return float(np.abs(np.concatenate([each[first:] for each in intervals_s]) - period_s).max()) / period_s


@pytest.mark.parametrize(("name", "count"), [("display-437", 3), ("display-437", 24), ("display-1511", 20)])
def test_each_pixel_keeps_the_period(name, count):
    assert max(find_worst_interval(name, count, seed) for seed in range(3)) < 0.05


@pytest.mark.parametrize(
    ("name", "count", "rate_hz"), [("display-437", 14, 20), ("display-1511", 6, 30), ("display-437", 5, 50)]
)
def test_each_pixel_keeps_the_period_where_the_mirrors_have_just_the_time_to_return(name, count, rate_hz):
    """The first pulses are longer, of cold pixels."""
    assert max(find_worst_interval(name, count, seed, 1.0 / rate_hz, 2) for seed in range(3)) < 0.05


def test_a_path_that_reverses_is_caught(monkeypatch):
    """Mutant: the shortest path each time."""
    monkeypatch.setattr(Scheduler, "_can_repeat_order", lambda *_: False)
    assert find_worst_interval("display-437", 24, 0) > 0.5
