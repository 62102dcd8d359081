"""Random trains by height, held against solve_ivp of the pixel's two equations."""

from functools import cache

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from optodrive.config import load_config
from optodrive.errors import InputError
from optodrive.flow import FrameSequence, HeightTrain
from optodrive.pipeline import Display, prepare

PIXELS = (25, 26, 47, 46)
SETTLE_S = 0.35
"""Ten relaxation times of the slowest pixel."""


@cache
def display_of(bridge_width_m):
    config = load_config("display-437")
    section = config.display.model_copy(update={"bridge_width_m": bridge_width_m})
    return Display.of(config.model_copy(update={"display": section}))


def trains_of(count, period_s, target_m, swing_m):
    cycles = 3 + int(SETTLE_S / period_s)
    step_s = round(period_s / count, 6)
    return tuple(
        HeightTrain(PIXELS[k], k * step_s, cycles * period_s, period_s, target_m, swing_m) for k in range(count)
    )


def bound_um(display, trains, word):
    """The most or the least that a refusal names, µm, or None where the trains are planned."""
    try:
        prepare(display, FrameSequence(trains=trains), *display.at_rest())
    except InputError as error:
        if f"{word} " not in str(error):
            return None
        return float(str(error).split(f"{word} ")[1].split()[0])
    return None


def height_um(pixel, pulses, t_s):
    """Displacement at t_s [m] under pulses [n, 3] in order, from rest."""
    edges_s = [0.0, *np.concatenate([pulses[:, :1], pulses[:, :1] + pulses[:, 1:2]], axis=1).ravel(), t_s[-1] + 1e-3]
    power_w = [0.0, *np.column_stack([pulses[:, 2], np.zeros(len(pulses))]).ravel()]
    state, height = np.zeros(2), np.zeros(len(t_s))
    for begin_s, end_s, light_w in zip(edges_s[:-1], edges_s[1:], power_w, strict=True):
        if end_s <= begin_s:
            continue

        def slope(_, y, light_w=light_w):
            heating = (pixel.epsilon * light_w - y[0] / pixel.r_k_per_w) / pixel.c_j_per_k
            return [heating, (y[0] / 2 - y[1]) / pixel.tau_g_s]

        inside = (t_s >= begin_s) & (t_s < end_s)
        run = solve_ivp(slope, (begin_s, end_s), state, t_eval=[*t_s[inside], end_s], rtol=1e-7, atol=1e-7)
        height[inside], state = run.y[1][:-1], run.y[:, -1]
    return 1e6 * pixel.kappa_m_per_k * height


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
        largest_um = bound_um(display, trains_of(count, period_s, target_m, target_m), "at most")
        smallest_um = bound_um(display, trains_of(count, period_s, target_m, 1e-9), "at least")
        assume(largest_um is not None and largest_um > 1.05 * smallest_um)
        share = data.draw(st.floats(0.0, 1.0))
        swing_m = 1e-6 * (1.001 * smallest_um + share * (0.999 * largest_um - 1.001 * smallest_um))
    trains = trains_of(count, period_s, target_m, swing_m)
    result = prepare(display, FrameSequence(trains=trains), *display.at_rest())
    plan = result.plan
    assume(not plan.trimmed_j.any())
    assert result.train_late_s < 1e-9
    train = data.draw(st.sampled_from(trains))
    rows = plan.pixel == train.pixel
    starts_s = train.pulse_starts_s()[-4:-1] + result.lead_s
    t_s = np.linspace(starts_s[0], starts_s[-1] + period_s, 601)
    own = display.pixels.each[train.pixel]
    pulses = np.column_stack([plan.start_s, plan.width_s, plan.power_w])[rows]
    each = height_um(own, pulses, t_s)[:-1].reshape(3, 200)
    assert each.max(axis=1) == pytest.approx(np.full(3, 1e6 * target_m), rel=0.03)
    if swing_m is not None:
        # Widths are whole PWM periods: a swing near zero changes by much with one.
        dark_s = period_s - plan.width_s[rows][-1]
        step = 0.5 * display.machine.drive.period_s * max(2.0 / dark_s, 1.0 / plan.width_s[rows][-1])
        assert np.ptp(each, axis=1) == pytest.approx(np.full(3, 1e6 * swing_m), rel=max(0.03, step))
