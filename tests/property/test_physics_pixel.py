"""Properties of the closed forms for any pixel, also with the gas lag near RC."""

from math import exp

import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st

from optodrive.physics.pixel import Pixel, advance, cooling_peak, divided_difference, gas_peak

rises = st.floats(0.0, 600.0)
powers = st.floats(0.0, 2.5)
times = st.floats(0.0, 0.2)


@st.composite
def pixels(draw):
    r, c = draw(st.floats(50.0, 500.0)), draw(st.floats(50e-6, 200e-6))
    near = st.floats(-12, 0).flatmap(
        lambda n: st.sampled_from([r * c * (1 + 10.0**n), r * c * (1 - 10.0 ** (n - 0.1))])
    )
    return Pixel(r, c, draw(st.floats(0.1, 1.0)), draw(st.floats(5e-4, 0.1) | near | st.just(r * c)), 4e-6, 2e-4)


def assert_close(value, expected):
    assert value == pytest.approx(expected, rel=1e-9, abs=1e-9)


@given(pixels(), rises, rises, powers, times, times)
def test_two_steps_are_one(pixel, theta, gamma, power, first_s, second_s):
    halfway = advance(pixel, theta, gamma, power, first_s)
    assert_close(advance(pixel, *halfway, power, second_s), advance(pixel, theta, gamma, power, first_s + second_s))


@given(pixels(), rises, rises, powers, times, st.floats(0.0, 4.0))
def test_advance_is_linear_in_state_and_power(pixel, theta, gamma, power, t_s, factor):
    once = advance(pixel, theta, gamma, power, t_s)
    assert_close(
        advance(pixel, factor * theta, factor * gamma, factor * power, t_s), [factor * value for value in once]
    )


@given(pixels(), rises, rises, powers, powers, times)
def test_responses_superpose(pixel, theta, gamma, one_w, other_w, t_s):
    alone = advance(pixel, theta, gamma, one_w, t_s)
    driven = advance(pixel, 0.0, 0.0, other_w, t_s)
    assert_close(
        advance(pixel, theta, gamma, one_w + other_w, t_s), [a + b for a, b in zip(alone, driven, strict=True)]
    )


@given(st.floats(5.0, 300.0), st.floats(-14.0, -4.0), st.sampled_from([-1.0, 1.0]), st.floats(0.0, 0.3))
def test_the_divided_difference_is_continuous_where_the_lag_equals_rc(a, magnitude, side, t_s):
    b = a * (1 + side * 10.0**magnitude)
    # The divided difference of two rates lies between its values at either rate alone.
    limits = sorted([t_s * exp(-a * t_s), t_s * exp(-b * t_s)])
    value = divided_difference(a, b, t_s)
    assert limits[0] * (1 - 1e-12) <= value <= limits[1] * (1 + 1e-12)


@given(pixels(), rises, rises, st.floats(0.0, 1.0))
def test_no_state_with_the_gate_off_exceeds_the_peak(pixel, theta, gamma, t_s):
    peak, _ = cooling_peak(pixel, theta, gamma)
    assert advance(pixel, theta, gamma, 0.0, t_s)[1] <= peak * (1 + 1e-12) + 1e-12
    assert peak <= max(gamma, theta / 2) * (1 + 1e-12)


@given(pixels(), st.floats(1.0, 600.0), st.floats(0.0, 0.9))
@example(Pixel(145.0, 100e-6, 0.66, 14.5e-3 * 1.005, 4e-6, 2e-4), 500.0, 0.1)
def test_the_gas_peaks_where_it_equals_half_the_absorber(pixel, theta, fraction):
    peak, at_s = gas_peak(pixel, theta, fraction * theta / 2, 0.0, float("inf"))
    theta_then, gamma_then = advance(pixel, theta, fraction * theta / 2, 0.0, at_s)
    assert peak == gamma_then
    assert gamma_then == pytest.approx(theta_then / 2, rel=1e-7)


@given(pixels(), rises, rises, powers, st.floats(0.0, 1e4))
def test_rises_stay_between_start_and_steady(pixel, theta, gamma, power, t_s):
    steady = pixel.epsilon * power * pixel.r_k_per_w
    assume(theta + gamma + steady > 0)
    end_theta, end_gamma = advance(pixel, theta, gamma, power, t_s)
    tolerance = 1e-9 * (theta + gamma + steady)
    assert min(theta, steady) - tolerance <= end_theta <= max(theta, steady) + tolerance
    assert min(gamma, theta / 2, steady / 2) - tolerance <= end_gamma <= max(gamma, theta / 2, steady / 2) + tolerance
