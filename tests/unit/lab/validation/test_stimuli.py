"""Pulses and trains agree with dense searches and with closed-form results."""

from math import exp, inf

import numpy as np
import pytest

from optodrive.lab.validation.stimuli import compute_steady_train, pulse_peak_k, width_to_reach_s
from optodrive.physics.pixel import Pixel, advance

PIXEL = Pixel(145.0, 99e-6, 0.66, 3e-3, 4e-6, 2e-4)
QUICK = Pixel(145.0, 99e-6, 0.66, 1e-6, 4e-6, 2e-4)


def area(t_s, gas):
    return np.sum(np.diff(t_s) * (np.array(gas[1:]) + np.array(gas[:-1])) / 2)


def test_pulse_peak_meets_a_dense_search():
    gate_off_state = advance(PIXEL, 0.0, 0.0, 2.45, 0.008)
    gas = [advance(PIXEL, *gate_off_state, 0.0, t)[1] for t in np.linspace(0, 0.02, 20_001)]
    assert pulse_peak_k(PIXEL, 2.45, 0.008) == pytest.approx(max(gas), rel=1e-7)


@pytest.mark.parametrize("height_m", [5e-6, 50e-6, 400e-6])
def test_the_width_found_reaches_the_height_and_no_less_does(height_m):
    width_s = width_to_reach_s(PIXEL, 2.45, height_m)
    assert PIXEL.kappa_m_per_k * pulse_peak_k(PIXEL, 2.45, width_s) == pytest.approx(height_m, rel=1e-9)
    assert PIXEL.kappa_m_per_k * pulse_peak_k(PIXEL, 2.45, 0.999 * width_s) < height_m


def test_a_height_out_of_reach_takes_for_ever():
    assert width_to_reach_s(PIXEL, 2.45, 1e-3) == inf


@pytest.mark.parametrize(("width_s", "gap_s"), [(2.5e-3, 2.5e-3), (0.02, 0.06), (0.05, 0.001), (2e-4, 0.3)])
def test_steady_train_meets_a_long_dense_run(width_s, gap_s):
    state = (0.0, 0.0)
    for _ in range(int(1.0 / (width_s + gap_s)) + 2):
        state = advance(PIXEL, *advance(PIXEL, *state, 2.45, width_s), 0.0, gap_s)
    gate_off_state = advance(PIXEL, *state, 2.45, width_s)
    on_s, off_s = (span_s * np.linspace(0, 1, 8001) ** 3 for span_s in (width_s, gap_s))
    on = [advance(PIXEL, *state, 2.45, t)[1] for t in on_s]
    off = [advance(PIXEL, *gate_off_state, 0.0, t)[1] for t in off_s]
    mean = (area(on_s, on) + area(off_s, off)) / (width_s + gap_s)
    train = compute_steady_train(PIXEL, 2.45, width_s, gap_s)
    assert train.max_k == pytest.approx(max(on + off), rel=1e-6)
    assert train.min_k == pytest.approx(min(on + off), rel=1e-6, abs=1e-9)
    assert train.mean_k == pytest.approx(mean, rel=1e-5)


def test_without_lag_a_train_follows_the_geometric_series():
    tau = QUICK.tau_s
    train, first_k = compute_steady_train(QUICK, 2.45, tau, tau), pulse_peak_k(QUICK, 2.45, tau)
    assert (train.max_k - train.min_k) / first_k == pytest.approx((1 - exp(-1)) / (1 - exp(-2)), rel=1e-3)
    assert train.mean_k / first_k == pytest.approx(0.5 / (1 - exp(-1)), rel=1e-3)
