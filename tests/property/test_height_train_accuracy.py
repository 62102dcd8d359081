"""Random height trains against solve_ivp of the pixel's two equations."""

from functools import cache

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from optodrive.core.errors import InputError
from optodrive.core.types.stimuli import FrameSequence, HeightTrain
from optodrive.device.config_file import load_config
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.pipeline import plan_sequence
from reference_models.nominal_pixel import height_um

PIXELS = (25, 26, 47, 46)
SETTLE_S = 0.35
"""Ten relaxation times of the slowest pixel."""


@cache
def build_display(bridge_width_m):
    config = load_config("display-437")
    section = config.display.model_copy(update={"bridge_width_m": bridge_width_m})
    return DisplayModel.from_config(config.model_copy(update={"display": section}))


def build_trains(count, period_s, target_m, peak_to_peak_m):
    cycle_count = 3 + int(SETTLE_S / period_s)
    step_s = round(period_s / count, 6)
    return tuple(
        HeightTrain(PIXELS[k], k * step_s, cycle_count * period_s, period_s, target_m, peak_to_peak_m)
        for k in range(count)
    )


def parse_bounds_um(display, trains, phrase):
    """Return the bound that the refusal of each train names, µm. The slots of the trains differ a little."""
    return [parse_bound_um(display, (*trains[k:], *trains[:k]), phrase) for k in range(len(trains))]


def parse_bound_um(display, trains, phrase):
    """Return the bound that the refusal of the first train names, µm, or None if the trains are planned."""
    try:
        plan_sequence(display, FrameSequence(trains=trains), *display.build_cold_state())
    except InputError as error:
        if f"{phrase} " not in str(error):
            return None
        return float(str(error).split(f"{phrase} ")[1].split()[0])
    return None


@pytest.mark.parametrize("count", [1, 4])
@settings(max_examples=12)
@given(data=st.data())
def test_steady_cycles_reach_the_target_height_and_peak_to_peak(count, data):
    display = build_display(data.draw(st.sampled_from([0.2e-3, 0.3e-3, 0.4e-3, 0.55e-3])))
    period_s = round(data.draw(st.floats(0.005 if count == 1 else 0.012, 0.1)), 6)
    height_max_um = parse_bound_um(display, build_trains(count, period_s, 1.0, None), "at most")
    target_m = 1e-6 * height_max_um * data.draw(st.floats(0.1, 0.95))
    peak_to_peak_m = None
    if data.draw(st.booleans()):
        peak_to_peak_max_um = parse_bounds_um(display, build_trains(count, period_s, target_m, target_m), "at most")
        assume(None not in peak_to_peak_max_um)
        peak_to_peak_max_um = min(peak_to_peak_max_um)
        peak_to_peak_min_um = max(parse_bounds_um(display, build_trains(count, period_s, target_m, 1e-9), "at least"))
        assume(peak_to_peak_max_um > 1.05 * peak_to_peak_min_um)
        fraction = data.draw(st.floats(0.0, 1.0))
        peak_to_peak_m = 1e-6 * (
            1.001 * peak_to_peak_min_um + fraction * (0.999 * peak_to_peak_max_um - 1.001 * peak_to_peak_min_um)
        )
    trains = build_trains(count, period_s, target_m, peak_to_peak_m)
    result = plan_sequence(display, FrameSequence(trains=trains), *display.build_cold_state())
    plan = result.plan
    assume(not plan.trimmed_j.any())
    assert result.train_lateness_max_s < 1e-9
    train = data.draw(st.sampled_from(trains))
    rows = plan.pixel == train.pixel
    starts_s = train.pulse_starts_s()[-4:-1] + result.lead_in_s
    t_s = np.linspace(starts_s[0], starts_s[-1] + period_s, 601)
    pixel = display.pixels.elements[train.pixel]
    pulses = np.column_stack([plan.start_s, plan.width_s, plan.power_w])[rows]
    cycles_um = height_um(pixel, pulses, t_s)[:-1].reshape(3, 200)
    assert cycles_um.max(axis=1) == pytest.approx(np.full(3, 1e6 * target_m), rel=0.03)
    if peak_to_peak_m is not None:
        assert np.ptp(cycles_um, axis=1) == pytest.approx(np.full(3, 1e6 * peak_to_peak_m), rel=0.03)


def test_pulse_widths_do_not_alternate_near_full_power():
    """The steady pulse has 13 periods at 99 % of the laser's power. A slightly larger demand would need 14."""
    display = build_display(0.2e-3)
    train = HeightTrain(PIXELS[0], 0.0, 0.37, 0.005859, 551.5e-6, 13.63635e-6)
    plan = plan_sequence(display, FrameSequence(trains=(train,)), *display.build_cold_state()).plan
    assert plan.width_s[-20:] == pytest.approx(np.full(20, 13 * display.scan_head.drive.period_s))
    assert plan.power_w[-20:] == pytest.approx(np.full(20, plan.power_w[-1]), rel=1e-3)
