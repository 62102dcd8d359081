from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from optodrive.physics.pixel import Pixel, advance
from optodrive.physics.pulse_for_height import DriveRange, find_shortest_pulse, max_displacement_m, pulse_peak

PIXEL = Pixel(184.0, 126e-6, 0.66, 3e-3, 4e-6, 2e-4)
DRIVE = DriveRange.from_laser(2.45, 5000.0, 0.050)


def pulse_for_peak(pixel, theta_k, gamma_k, target_m, drive, min_periods=1, from_s=0.0):
    target_k = target_m / pixel.kappa_m_per_k
    span = (drive.max_power_w, drive.period_s, min(min_periods, drive.max_periods), drive.max_periods)
    permitted = (drive.is_fine, drive.min_duty)
    periods, duty = find_shortest_pulse(pixel, theta_k, gamma_k, target_k, *span, *permitted, from_s)
    return (periods, duty) if periods else None


def test_range_counts_whole_periods():
    assert DRIVE.max_periods == 250
    assert DriveRange.from_laser(2.45, 5000.0, 0.0301).max_periods == 150


@given(
    share=st.floats(1e-3, 1.0),
    theta=st.floats(0.0, 200.0),
    gas_share=st.floats(0.0, 1.0),
)
def test_the_pulse_reaches_its_target_from_any_heat(share, theta, gas_share):
    gamma = 0.5 * theta * gas_share
    target = share * max_displacement_m(PIXEL, DRIVE)
    pulse = pulse_for_peak(PIXEL, theta, gamma, target, DRIVE)
    dark_peak = pulse_peak(PIXEL, theta, gamma, 0.0, 1e-9)[0] * PIXEL.kappa_m_per_k
    if pulse is None:
        assert dark_peak >= target * (1 - 1e-9)
        return
    periods, duty = pulse
    assert 1 <= periods <= DRIVE.max_periods
    assert 0 < duty <= 1
    t = np.linspace(0, 0.1, 4001)
    width = periods * DRIVE.period_s
    gas = [
        advance(PIXEL, theta, gamma, duty * 2.45, s)[1]
        if s <= width
        else advance(PIXEL, *advance(PIXEL, theta, gamma, duty * 2.45, width), 0.0, s - width)[1]
        for s in t
    ]
    assert max(gas) * PIXEL.kappa_m_per_k == pytest.approx(target, rel=1e-4)


@given(theta=st.floats(1.0, 80.0), gas_share=st.floats(0.1, 2.0))
def test_heat_that_just_fails_the_target_asks_for_no_negative_power(theta, gas_share):
    gamma = 0.5 * theta * gas_share
    peak_k = pulse_peak(PIXEL, theta, gamma, 0.0, 1e-9)[0]
    pulse = pulse_for_peak(PIXEL, theta, gamma, np.nextafter(peak_k, np.inf) * PIXEL.kappa_m_per_k, DRIVE)
    assert pulse is None or pulse[1] >= 0.0


def test_it_is_the_shortest_width_that_can():
    periods, duty = pulse_for_peak(PIXEL, 0.0, 0.0, 100e-6, DRIVE)
    shorter = pulse_peak(PIXEL, 0.0, 0.0, 2.45, (periods - 1) * DRIVE.period_s)[0] * PIXEL.kappa_m_per_k
    assert shorter < 100e-6
    assert duty > 0.9 * (periods - 1) / periods


@given(share=st.floats(1e-2, 1.0), theta=st.floats(0.0, 20.0))
def test_a_fine_pulse_of_more_than_a_period_has_full_power_and_the_nearest_microsecond(share, theta):
    fine, target_m = replace(DRIVE, is_fine=True), share * max_displacement_m(PIXEL, DRIVE)
    whole, pulse = (pulse_for_peak(PIXEL, theta, 0.0, target_m, drive) for drive in (DRIVE, fine))
    if whole is None or whole[0] == 1:
        assert pulse == whole
        return
    periods, duty = pulse
    width_us = periods * DRIVE.period_s * 1e6
    assert duty == 1.0
    assert width_us == pytest.approx(round(width_us), abs=1e-6)

    def miss_m(us):
        return abs(pulse_peak(PIXEL, theta, 0.0, 2.45, us * 1e-6)[0] * PIXEL.kappa_m_per_k - target_m)

    assert miss_m(width_us) <= min(miss_m(width_us - 1), miss_m(width_us + 1)) + 1e-15
    assert 1e6 * DRIVE.period_s * (whole[0] - 1) <= width_us <= 1e6 * DRIVE.period_s * whole[0]


@given(share=st.floats(1e-4, 1.0), theta=st.floats(0.0, 20.0))
def test_a_laser_that_is_on_or_off_gets_the_nearest_microsecond(share, theta):
    drive, target_m = replace(DRIVE, is_fine=True, min_duty=1.0), share * max_displacement_m(PIXEL, DRIVE)
    assert drive.is_on_off
    pulse = pulse_for_peak(PIXEL, theta, 0.0, target_m, drive)
    width_us = 0.0 if pulse is None else pulse[0] * DRIVE.period_s * 1e6
    assert width_us == pytest.approx(round(width_us), abs=1e-6)
    assert pulse is None or pulse[1] == 1.0

    def miss_m(us):
        return abs(pulse_peak(PIXEL, theta, 0.0, 2.45, us * 1e-6)[0] * PIXEL.kappa_m_per_k - target_m)

    assert miss_m(width_us) <= min(miss_m(max(0.0, width_us - 1)), miss_m(width_us + 1)) + 1e-15


@given(share=st.floats(1e-4, 1.0), theta=st.floats(0.0, 20.0), weakest=st.floats(0.05, 0.95))
def test_no_pulse_is_weaker_than_the_laser_emits(share, theta, weakest):
    target_m = share * max_displacement_m(PIXEL, DRIVE)
    free, pulse = (pulse_for_peak(PIXEL, theta, 0.0, target_m, replace(DRIVE, min_duty=d)) for d in (0.0, weakest))
    if free is None or free[1] >= weakest:
        assert pulse == free
        return
    periods, duty = pulse or (0.0, 0.0)
    energy = free[0] * free[1]
    permitted = [0.0] if free[0] == 1 else [free[0] - 1.0]
    assert pulse is None or duty >= weakest
    assert abs(periods * duty - energy) <= min(abs(each - energy) for each in (*permitted, free[0] * weakest)) + 1e-9


def test_no_pulse_where_the_heat_is_enough():
    assert pulse_for_peak(PIXEL, 100.0, 50.0, 150e-6, DRIVE) is None


def test_a_target_unreachable_gets_the_longest_pulse():
    assert pulse_for_peak(PIXEL, 0.0, 0.0, 2 * max_displacement_m(PIXEL, DRIVE), DRIVE) == (250, 1.0)


@given(share=st.floats(1e-3, 0.9), theta=st.floats(0.0, 20.0), minimum=st.integers(1, 300))
def test_a_pulse_is_as_wide_as_told_and_its_duty_makes_up_the_rest(share, theta, minimum):
    target = share * max_displacement_m(PIXEL, DRIVE)
    narrow, wide = (pulse_for_peak(PIXEL, theta, 0.0, target, DRIVE, min_periods=n) for n in (1, minimum))
    if narrow is None:
        assert wide is None
        return
    assert wide[0] == max(narrow[0], min(minimum, DRIVE.max_periods))
    peak = pulse_peak(PIXEL, theta, 0.0, wide[1] * 2.45, wide[0] * DRIVE.period_s)[0] * PIXEL.kappa_m_per_k
    assert peak == pytest.approx(target, rel=1e-6)


@given(share=st.floats(0.01, 0.5), minimum=st.integers(1, 40), from_s=st.floats(0.01, 0.04))
def test_a_peak_may_count_only_from_a_time_on(share, minimum, from_s):
    target = share * max_displacement_m(PIXEL, DRIVE)
    periods, duty = pulse_for_peak(PIXEL, 0.0, 0.0, target, DRIVE, minimum, from_s)
    width = periods * DRIVE.period_s
    pulsed = advance(PIXEL, 0.0, 0.0, duty * 2.45, width)
    gas = [advance(PIXEL, *pulsed, 0.0, s)[1] for s in max(0.0, from_s - width) + np.linspace(0, 0.05, 2001)]
    assert periods >= minimum
    assert (duty == 1.0 and periods == DRIVE.max_periods) or max(gas) * PIXEL.kappa_m_per_k == pytest.approx(
        target, rel=1e-4
    )
