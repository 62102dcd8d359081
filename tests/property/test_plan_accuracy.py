"""Prediction, target and cap of random plans on every display against an independent integrator."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from displays import DISPLAYS
from optodrive.core.types.stimuli import FrameSequence, PulseTrain, TactileFrame
from optodrive.physics.pulse_for_height import max_displacement_m
from optodrive.planning.pipeline import plan_sequence

STEP_S = 2e-5


def integrate(pixel, pulses, until_s):
    """Integrate the pixel's two equations by fourth-order Runge–Kutta. Return times, absorber rise, displacement."""
    steps = int(np.ceil(until_s / STEP_S))
    power = np.zeros(steps)
    time = np.arange(steps) * STEP_S
    for start_s, width_s, power_w in pulses:
        overlap = np.clip(np.minimum(time + STEP_S, start_s + width_s) - np.maximum(time, start_s), 0, None)
        power += power_w * overlap / STEP_S
    matrix = np.array([[-1 / (pixel.r_k_per_w * pixel.c_j_per_k), 0.0], [0.5 / pixel.tau_g_s, -1 / pixel.tau_g_s]])
    drive = np.array([pixel.epsilon / pixel.c_j_per_k, 0.0])
    h = STEP_S
    hm = h * matrix
    propagate = np.eye(2) + hm + hm @ hm / 2 + hm @ hm @ hm / 6 + hm @ hm @ hm @ hm / 24
    source = h * (np.eye(2) + hm / 2 + hm @ hm / 6 + hm @ hm @ hm / 24) @ drive
    state = np.zeros((steps + 1, 2))
    for k in range(steps):
        state[k + 1] = propagate @ state[k] + source * power[k]
    return np.arange(steps + 1) * STEP_S, state[:, 0], pixel.kappa_m_per_k * state[:, 1]


@st.composite
def sequences(draw, name):
    """Sample a few frames on a few pixels, close in time, and possibly a train."""
    display = DISPLAYS[name]
    count = len(display.layout)
    height_max_um = max_displacement_m(display.pixels.elements[0], display.scan_head.drive) * 1e6
    pixels = draw(st.lists(st.integers(0, count - 1), min_size=1, max_size=4, unique=True))
    frames, at_s = [], 0.0
    for k in range(draw(st.integers(1, 4))):
        target = np.zeros(count)
        for pixel in pixels:
            target[pixel] = 1e-6 * draw(st.one_of(st.just(0.0), st.floats(0.5, height_max_um * 0.999)))
        duration = draw(st.sampled_from([0.02, 0.06, 0.15, 0.4]))
        frames.append(TactileFrame(f"f{k}", at_s, duration, target))
        at_s += duration
    trains = ()
    if draw(st.booleans()):
        width, gap = draw(st.sampled_from([(0.02, 0.06), (0.025, 0.025), (0.04, 0.01), (0.001, 0.001), (0.05, 0.0)]))
        start = draw(st.floats(0.0, 0.3))
        trains = (PulseTrain(draw(st.sampled_from(pixels)), start, 0.3, width, gap, draw(st.floats(0.2, 2.45))),)
    return FrameSequence(tuple(frames), trains)


@pytest.mark.parametrize(
    "name", [name if name != "display-16" else pytest.param(name, marks=pytest.mark.slow) for name in sorted(DISPLAYS)]
)
@settings(max_examples=12 * settings.default.max_examples // 100)
@given(data=st.data())
def test_prediction_target_and_cap_hold_in_an_independent_integrator(name, data):
    display = DISPLAYS[name]
    sequence = data.draw(sequences(name))
    result = plan_sequence(display, sequence, *display.build_cold_state())
    plan = result.plan
    cap_k = display.config.limits.absorber_max_c - display.config.ambient_c
    ends_s = plan.start_s + plan.width_s
    for pixel in np.unique(plan.pixel):
        rows = np.flatnonzero(plan.pixel == pixel)
        pulses = list(zip(plan.start_s[rows], plan.width_s[rows], plan.power_w[rows], strict=True))
        time, absorber, height = integrate(display.pixels.elements[pixel], pulses, ends_s[rows[-1]] + 0.05)
        assert absorber.max() <= cap_k
        assert result.plan.headroom_k[pixel] <= cap_k - absorber.max() + 1e-6
        until = np.append(plan.start_s[rows[1:]], np.inf)
        for row, limit_s in zip(rows, until, strict=True):
            window = (time >= plan.start_s[row]) & (time <= limit_s)
            # The gas falls by a few per cent per step, so the window's edges are interpolated.
            edges = np.interp([plan.start_s[row], min(limit_s, time[-1])], time, height)
            measured = max(height[window].max(initial=0.0), *edges)
            assert measured == pytest.approx(result.predicted_m[row], rel=0.02, abs=2e-8)
            is_cut_short = limit_s - ends_s[row] < 0.008  # the gas lags: the next pulse starts before this one's peak
            if plan.source[row] < len(sequence.frames) and not plan.reason[row] and not is_cut_short:
                assert measured == pytest.approx(plan.target_m[row], rel=0.05)
