"""A frame whose moves exceed the galvo cap is drawn with pauses instead of missing pulses."""

from dataclasses import replace

import numpy as np
import pytest

from displays import DISPLAYS
from optodrive.core.types.stimuli import FrameSequence, PulseTrain, TactileFrame
from optodrive.planning.feasibility.check import check_feasibility
from optodrive.planning.limiter.limiter import limit
from optodrive.planning.pipeline import plan_sequence

DISPLAY = DISPLAYS["display-1511"]


def frame(height_um, duration_s=60.0, count=1511):
    target_m = np.zeros(1511)
    target_m[:count] = height_um * 1e-6
    return TactileFrame("f", 0.0, duration_s, target_m)


def with_galvo_cap(rad_per_s2):
    """Return the display with another galvo cap."""
    caps = DISPLAY.budget.caps._replace(galvo_rad2_per_s4=rad_per_s2**2)
    return replace(DISPLAY, budget=DISPLAY.budget._replace(caps=caps))


@pytest.mark.parametrize("policy", ["trim", "delay", "refuse"])
def test_every_pixel_of_a_low_frame_gets_its_pulse_under_any_policy(policy):
    display = with_galvo_cap(6e4)
    planned = plan_sequence(display, FrameSequence((frame(20),)), *display.build_cold_state(), policy)
    plan = planned.plan
    assert len(plan) == 1511
    assert (plan.reason == "").all()
    assert planned.predicted_m == pytest.approx(20e-6, rel=1e-3)
    pauses_s = plan.start_s[1:] - (plan.start_s + plan.width_s)[:-1] - plan.settling_s[1:]
    long_pauses_s = pauses_s[pauses_s > 1e-5]
    assert long_pauses_s.sum() == pytest.approx(planned.galvo_pause_s, abs=1e-6)
    doubled_s = np.minimum(0.01 * 2.0 ** np.arange(len(long_pauses_s)), 0.1)
    assert long_pauses_s == pytest.approx(doubled_s, abs=1e-5)
    assert long_pauses_s.any()
    assert limit(plan, display.build_cold_state()[1], display.budget, "refuse")[0].trimmed_j.sum() == 0


def test_a_frame_within_the_galvo_cap_has_no_pause():
    planned = plan_sequence(DISPLAY, FrameSequence((frame(100),)), *DISPLAY.build_cold_state())
    assert planned.galvo_pause_s == 0.0


def test_feasibility_includes_the_pauses():
    display = with_galvo_cap(6e4)
    planned = plan_sequence(display, FrameSequence((frame(20, count=400),)), *display.build_cold_state())
    assert planned.galvo_pause_s > 0.05

    def check(duration_s):
        sequence = FrameSequence((frame(20, duration_s, count=400),))
        return check_feasibility(display, sequence, *display.build_cold_state())[1]

    assert check(planned.duration_s).fits
    late = check(planned.duration_s - 0.05)
    assert not late.fits
    assert late.name == "f"


def test_without_a_feasible_move_there_is_no_pause_and_no_power():
    planned = plan_sequence(with_galvo_cap(1e3), FrameSequence((frame(20, count=5),)), *DISPLAY.build_cold_state())
    assert planned.galvo_pause_s == 0.0
    assert set(planned.plan.reason[planned.plan.power_w == 0]) == {"galvo_acceleration"}


def test_a_train_keeps_its_times_and_loses_pulses_above_the_galvo_cap():
    trains = tuple(PulseTrain(pixel, 0.005 * k, 3.0, 0.0002, 0.0098, 1.0) for k, pixel in enumerate((0, 700)))
    plan = plan_sequence(with_galvo_cap(5e4), FrameSequence((), trains), *DISPLAY.build_cold_state()).plan
    assert set(plan.reason) == {"", "galvo_acceleration"}
    assert plan.start_s == pytest.approx(plan.requested_start_s, abs=1e-3)


def test_a_frame_between_trains_pauses_and_the_trains_are_not_delayed():
    train = PulseTrain(700, 0.0, 2.0, 0.001, 0.049, 1.0)
    display = with_galvo_cap(6e4)
    planned = plan_sequence(display, FrameSequence((frame(20, count=400),), (train,)), *DISPLAY.build_cold_state())
    plan, is_train = planned.plan, planned.plan.source == 1
    assert planned.galvo_pause_s > 0
    assert (plan.power_w[~is_train] > 0).all()
    assert np.count_nonzero(is_train) == 40


def test_a_frame_with_pauses_waits_for_a_cap_as_a_whole():
    capped = with_galvo_cap(6e4)
    caps = capped.budget.caps._replace(touch_k=0.15)
    display = replace(capped, budget=capped.budget._replace(caps=caps))
    frames = tuple(replace(frame(20, 0.6, 200), show_at_s=0.6 * k) for k in range(3))
    planned = plan_sequence(display, FrameSequence(frames), *display.build_cold_state(), "delay")
    plan = planned.plan
    assert planned.delays
    dark_s = plan.start_s[1:] - (plan.start_s + plan.width_s)[:-1] - plan.settling_s[1:]
    within_frame = plan.source[1:] == plan.source[:-1]
    assert planned.galvo_pause_s > 0.0
    assert dark_s[within_frame].sum() == pytest.approx(planned.galvo_pause_s, abs=1e-6)
