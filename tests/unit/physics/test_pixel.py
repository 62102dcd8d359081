"""Closed forms of the nominal pixel against an adaptive integrator and dense searches."""

from decimal import Decimal, localcontext

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from optodrive.physics.pixel import Pixel, advance, cooling_peak, divided_difference, gas_peak

SLOW_GAS = Pixel(95.0, 102e-6, 0.66, 64e-3, 4e-6, 2e-4)
FAST_GAS = Pixel(382.0, 81e-6, 0.66, 3e-3, 4e-6, 2e-4)
EQUAL = Pixel(145.0, 99e-6, 0.66, 145.0 * 99e-6, 4e-6, 2e-4)
PIXELS = pytest.mark.parametrize("pixel", [SLOW_GAS, FAST_GAS, EQUAL], ids=["slow gas", "fast gas", "equal"])


def integrate(pixel, theta, gamma, power, t_s):
    def slope(_, state):
        heating = (pixel.epsilon * power - state[0] / pixel.r_k_per_w) / pixel.c_j_per_k
        return [heating, (0.5 * state[0] - state[1]) / pixel.tau_g_s]

    result = solve_ivp(slope, (0, t_s), [theta, gamma], method="DOP853", rtol=1e-10, atol=1e-10)
    return result.y[:, -1]


@PIXELS
@pytest.mark.parametrize("start", [(0.0, 0.0), (400.0, 20.0), (30.0, 180.0)])
@pytest.mark.parametrize("power", [0.0, 0.7, 2.45])
@pytest.mark.parametrize("t_s", [1e-4, 8e-3, 0.05, 0.4])
def test_advance_meets_an_integrator(pixel, start, power, t_s):
    exact = integrate(pixel, *start, power, t_s)
    assert advance(pixel, *start, power, t_s) == pytest.approx(exact, rel=1e-8, abs=1e-7)


@PIXELS
def test_a_drive_of_many_steps_meets_an_integrator(pixel):
    steps = [(2.45, 0.008), (0.0, 0.003), (1.2, 0.02), (0.0, 0.05), (2.45, 0.0002)]
    closed = step_by_step = (0.0, 0.0)
    for power, t_s in steps:
        closed = advance(pixel, *closed, power, t_s)
        step_by_step = integrate(pixel, *step_by_step, power, t_s)
    assert closed == pytest.approx(step_by_step, rel=1e-8)


@PIXELS
def test_settles_at_the_steady_rises(pixel):
    steady = pixel.epsilon * 2.45 * pixel.r_k_per_w
    assert advance(pixel, 0.0, 0.0, 2.45, 100.0) == pytest.approx((steady, steady / 2), rel=1e-12)


@PIXELS
@pytest.mark.parametrize("dark_s", [10.0, 1e3, 1e6])
def test_long_darkness_cools_to_nothing(pixel, dark_s):
    theta, gamma = advance(pixel, 500.0, 250.0, 0.0, dark_s)
    assert 0.0 <= theta < 1e-9
    assert 0.0 <= gamma < 1e-9


def test_divided_difference_is_symmetric_and_exact_at_equal_rates():
    assert divided_difference(60.0, 300.0, 0.01) == divided_difference(300.0, 60.0, 0.01)
    assert divided_difference(60.0, 300.0, 0.01) == pytest.approx((np.exp(-0.6) - np.exp(-3.0)) / 240.0, rel=1e-14)
    assert divided_difference(70.0, 70.0, 0.02) == pytest.approx(0.02 * np.exp(-1.4), rel=1e-15)


@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize("magnitude", range(-15, 1))
@pytest.mark.parametrize("t_s", [2e-4, 0.01, 0.3])
def test_divided_difference_keeps_its_digits_as_the_rates_meet(magnitude, side, t_s):
    a = 70.0
    b = a * (1.0 + side * 0.7 * 10.0**magnitude)
    if a == b:
        exact = t_s * np.exp(-a * t_s)
    else:
        with localcontext(prec=60):
            exact_a, exact_b, t = Decimal(a), Decimal(b), Decimal(t_s)
            exact = float(((-exact_a * t).exp() - (-exact_b * t).exp()) / (exact_b - exact_a))
    assert divided_difference(a, b, t_s) == pytest.approx(exact, rel=2e-14)


def test_time_constant():
    assert pytest.approx(30.942e-3) == FAST_GAS.tau_s


@PIXELS
@pytest.mark.parametrize("start", [(400.0, 20.0), (400.0, 199.0), (30.0, 180.0), (100.0, 0.0), (0.0, 50.0)])
def test_cooling_peak_meets_a_dense_search(pixel, start):
    t_s = np.linspace(0, 0.5, 50_001)
    gas = np.array([advance(pixel, *start, 0.0, t)[1] for t in t_s])
    peak, at_s = cooling_peak(pixel, *start)
    assert peak == pytest.approx(gas.max(), rel=1e-6)
    assert at_s == pytest.approx(t_s[gas.argmax()], abs=2e-5)


@PIXELS
@pytest.mark.parametrize("within_s", [0.0, 2e-4, 3e-3, 0.1])
@pytest.mark.parametrize("power", [0.0, 0.3, 2.45])
@pytest.mark.parametrize("start", [(0.0, 0.0), (400.0, 20.0), (30.0, 180.0)])
def test_gas_peak_within_a_time_meets_a_dense_search(pixel, start, power, within_s):
    gas = [advance(pixel, *start, power, t)[1] for t in np.linspace(0, within_s, 4001)]
    peak, at_s = gas_peak(pixel, *start, power, within_s)
    assert peak == pytest.approx(max(gas), rel=1e-6)
    assert 0.0 <= at_s <= within_s
    assert advance(pixel, *start, power, at_s)[1] == pytest.approx(peak, rel=1e-12)


def test_a_cold_pixel_peaks_at_once():
    assert cooling_peak(FAST_GAS, 0.0, 0.0) == (0.0, 0.0)


def test_gas_hotter_than_its_target_peaks_at_once_also_where_almost_no_heat_is_left():
    assert cooling_peak(EQUAL, 5e-324, 1.0) == (1.0, 0.0)
    assert cooling_peak(FAST_GAS, 30.0, 180.0) == (180.0, 0.0)
