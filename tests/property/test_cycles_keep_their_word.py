"""Random trains by height, held against solve_ivp of the pixel's two equations."""

from functools import cache

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from optodrive.core.errors import InputError
from optodrive.core.types.stimuli import FrameSequence, HeightTrain
from optodrive.device.config import load_config
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.pipeline import plan_sequence
from reference_models.nominal_pixel import height_um

PIXELS = (25, 26, 47, 46)
SETTLE_S = 0.35
"""Ten relaxation times of the slowest pixel."""


@cache
def display_of(bridge_width_m):
    config = load_config("display-437")
    section = config.display.model_copy(update={"bridge_width_m": bridge_width_m})
    return DisplayModel.from_config(config.model_copy(update={"display": section}))


def trains_of(count, period_s, target_m, swing_m):
    cycles = 3 + int(SETTLE_S / period_s)
    step_s = round(period_s / count, 6)
    return tuple(
        HeightTrain(PIXELS[k], k * step_s, cycles * period_s, period_s, target_m, swing_m) for k in range(count)
    )


def bounds_um(display, trains, word):
    """The most or the least that refusals name of each train, µm; the slots of trains differ a little."""
    return [bound_um(display, (*trains[k:], *trains[:k]), word) for k in range(len(trains))]


def bound_um(display, trains, word):
    """The most or the least that the refusal of the first train names, µm, or None where the trains are planned."""
    try:
        plan_sequence(display, FrameSequence(trains=trains), *display.build_cold_state())
    except InputError as error:
        if f"{word} " not in str(error):
            return None
        return float(str(error).split(f"{word} ")[1].split()[0])
    return None


@pytest.mark.parametrize("count", [1, 4])
@settings(max_examples=12)
@given(data=st.data())
def test_steady_cycles_have_the_height_and_the_swing_that_was_asked(count, data):
    display = display_of(data.draw(st.sampled_from([0.2e-3, 0.3e-3, 0.4e-3, 0.55e-3])))
    period_s = round(data.draw(st.floats(0.005 if count == 1 else 0.012, 0.1)), 6)
    most_um = bound_um(display, trains_of(count, period_s, 1.0, None), "at most")
    target_m = 1e-6 * most_um * data.draw(st.floats(0.1, 0.95))
    swing_m = None
    if data.draw(st.booleans()):
        largest_um = bounds_um(display, trains_of(count, period_s, target_m, target_m), "at most")
        assume(None not in largest_um)
        largest_um = min(largest_um)
        smallest_um = max(bounds_um(display, trains_of(count, period_s, target_m, 1e-9), "at least"))
        assume(largest_um > 1.05 * smallest_um)
        share = data.draw(st.floats(0.0, 1.0))
        swing_m = 1e-6 * (1.001 * smallest_um + share * (0.999 * largest_um - 1.001 * smallest_um))
    trains = trains_of(count, period_s, target_m, swing_m)
    result = plan_sequence(display, FrameSequence(trains=trains), *display.build_cold_state())
    plan = result.plan
    assume(not plan.trimmed_j.any())
    assert result.train_lateness_max_s < 1e-9
    train = data.draw(st.sampled_from(trains))
    rows = plan.pixel == train.pixel
    starts_s = train.pulse_starts_s()[-4:-1] + result.lead_in_s
    t_s = np.linspace(starts_s[0], starts_s[-1] + period_s, 601)
    own = display.pixels.elements[train.pixel]
    pulses = np.column_stack([plan.start_s, plan.width_s, plan.power_w])[rows]
    each = height_um(own, pulses, t_s)[:-1].reshape(3, 200)
    assert each.max(axis=1) == pytest.approx(np.full(3, 1e6 * target_m), rel=0.03)
    if swing_m is not None:
        assert np.ptp(each, axis=1) == pytest.approx(np.full(3, 1e6 * swing_m), rel=0.03)


def test_near_full_power_wide_and_narrow_pulses_do_not_take_turns():
    """The steady pulse, 13 periods, needs 99 % of the laser's power: wanting ever so little more, 14 would be had."""
    display = display_of(0.2e-3)
    train = HeightTrain(PIXELS[0], 0.0, 0.37, 0.005859, 551.5e-6, 13.63635e-6)
    plan = plan_sequence(display, FrameSequence(trains=(train,)), *display.build_cold_state()).plan
    assert plan.width_s[-20:] == pytest.approx(np.full(20, 13 * display.scan_head.drive.period_s))
    assert plan.power_w[-20:] == pytest.approx(np.full(20, plan.power_w[-1]), rel=1e-3)
