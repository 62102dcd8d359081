"""State of a whole display at one time against its pixels one by one."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from optodrive.device.config_file import load_config
from optodrive.device.panel import Neighbours
from optodrive.physics.extended_display import ExtendedThermalState
from optodrive.physics.nominal_display import NominalThermalState
from optodrive.physics.parameters import build_display_pixels, load_parameters

CONFIG = load_config("display-16")
PIXELS = build_display_pixels(CONFIG, load_parameters(CONFIG.pixel_model.parameters))
TERMS = {"bridge_conductivity": {"exponent": 0.8}}


def nominal():
    return NominalThermalState(PIXELS)


def extended():
    return ExtendedThermalState(PIXELS, TERMS, 293.15, 2.45, Neighbours.from_display(CONFIG.display))


def apply_test_pulses(heat):
    """Apply a pulse to pixels 0 to 9, one every 10 ms."""
    pixel = np.arange(10)
    heat.apply_pulses(pixel, 0.01 * pixel, np.full(10, 5e-3), np.linspace(0.5, 2.4, 10))
    return heat


@given(after_s=st.floats(0.0, 2.0))
def test_nominal_pixels_are_where_each_says_it_is(after_s):
    heat, at_s = apply_test_pulses(nominal()), 0.1 + after_s
    seen = heat.state_at(at_s)
    for pixel in range(len(PIXELS)):
        absorber_k, gas_k = heat.rises_k(pixel, at_s)
        assert seen.absorber_k[pixel] == pytest.approx(absorber_k, abs=1e-9)
        assert seen.displacement_m[pixel] == pytest.approx(PIXELS.elements[pixel].kappa_m_per_k * gas_k, abs=1e-15)


@pytest.mark.parametrize("make", [nominal, extended])
def test_a_look_changes_nothing_and_a_time_before_an_event_counts_as_the_event(make):
    heat, untouched = apply_test_pulses(make()), apply_test_pulses(make())
    first = heat.state_at(0.12)
    heat.state_at(3.0)
    again = heat.state_at(0.12)
    assert np.allclose(first.displacement_m, again.displacement_m, rtol=1e-4, atol=1e-10)
    assert heat.state_at(-1.0).absorber_k[9] == pytest.approx(heat.state_at(0.095).absorber_k[9])
    more = (np.array([3]), np.array([0.2]), np.array([4e-3]), np.array([2.0]))
    assert heat.apply_pulses(*more).displacement_m == pytest.approx(untouched.apply_pulses(*more).displacement_m)


def test_stepped_pixels_looked_at_again_and_again_are_where_one_long_look_has_them():
    heat = apply_test_pulses(extended())
    none = np.zeros((0, 4))
    for at_s in np.arange(0.1, 0.6, 0.033):
        seen = heat.state_at(at_s)
        for pixel in (0, 5, 9, 12):
            alone_m = heat.simulate_displacement_m(none, pixel, np.array([at_s]))[0]
            assert seen.displacement_m[pixel] == pytest.approx(alone_m, rel=2e-4, abs=1e-10)


def test_a_pulse_told_late_is_seen_from_then_on():
    heat = apply_test_pulses(extended())
    heat.state_at(0.5)
    heat.apply_pulses(np.array([2]), np.array([0.45]), np.array([5e-3]), np.array([2.0]))
    expected_m = heat.simulate_displacement_m(np.zeros((0, 4)), 2, np.array([0.5]))[0]
    assert expected_m > 1e-6
    assert heat.state_at(0.5).displacement_m[2] == pytest.approx(expected_m, rel=2e-4)


def test_a_copy_is_looked_at_by_itself():
    heat = apply_test_pulses(extended())
    heat.state_at(0.2)
    later = heat.copy_shifted(1.0)
    assert later.state_at(1.2).displacement_m == pytest.approx(heat.state_at(0.2).displacement_m, rel=1e-4, abs=1e-10)
