"""The compiled pulse application equals the closed forms, step by step."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from optodrive.physics.nominal_display import NominalThermalState
from optodrive.physics.parameters import PixelArray
from optodrive.physics.pixel import Pixel, advance, cooling_peak, gas_peak

PIXELS = (
    Pixel(382.0, 81e-6, 0.66, 3e-3, 4e-6, 2e-4),
    Pixel(95.0, 102e-6, 0.5, 64e-3, 3e-6, 3e-4),
    Pixel(145.0, 99e-6, 0.66, 145.0 * 99e-6, 4e-6, 2e-4),
)
ARRAY = PixelArray(*(np.array(column) for column in zip(*PIXELS, strict=True)))

gaps_s = st.sampled_from([0.0, 1e-9, 4e-4, 0.02]) | st.floats(0.0, 0.1) | st.floats(1.0, 1e5)
widths_s = st.floats(1e-5, 0.1)
one_pulse = st.tuples(st.sampled_from([0, 0, 0, 1, 2]), gaps_s, widths_s, st.floats(0.0, 2.45))


def build_columns(rows):
    pixel, gap_s, width_s, power_w = (np.array(column) for column in zip(*rows, strict=True))
    return pixel, np.cumsum(gap_s + width_s) - width_s, width_s, power_w


def apply_stepwise(columns):
    """Return peaks [n] of displacement and absorber, and each pixel's last time and rises, by single calls."""
    state = [(0.0, 0.0, 0.0)] * len(PIXELS)
    displacements, absorbers, last = [], [], {}
    for row, (index, start_s, width_s, power_w) in enumerate(zip(*(c.tolist() for c in columns), strict=True)):
        pixel, (at_s, *rises) = PIXELS[index], state[index]
        off_s = max(0.0, start_s - at_s)
        if index in last:
            displacements[last[index]] = max(
                displacements[last[index]], pixel.kappa_m_per_k * cooling_peak(pixel, *rises, off_s)[0]
            )
        begin = advance(pixel, *rises, 0.0, off_s)
        end = advance(pixel, *begin, power_w, width_s)
        displacements.append(pixel.kappa_m_per_k * gas_peak(pixel, *begin, power_w, width_s)[0])
        absorbers.append(max(begin[0], end[0]))
        state[index], last[index] = (start_s + width_s, *end), row
    for index, row in last.items():
        pixel, (_, *rises) = PIXELS[index], state[index]
        displacements[row] = max(displacements[row], pixel.kappa_m_per_k * cooling_peak(pixel, *rises)[0])
    return displacements, absorbers, state


@given(st.lists(one_pulse, min_size=1, max_size=30))
def test_compiled_application_equals_stepwise_application(rows):
    columns, heat = build_columns(rows), NominalThermalState(ARRAY)
    peaks = heat.apply_pulses(*columns)
    displacements, absorbers, state = apply_stepwise(columns)
    assert peaks.displacement_m == pytest.approx(np.array(displacements), rel=1e-12, abs=1e-300)
    assert peaks.absorber_k == pytest.approx(np.array(absorbers), rel=1e-12, abs=1e-300)
    for index, (at_s, *rises) in enumerate(state):
        assert heat.rises_k(index, at_s) == pytest.approx(tuple(rises), rel=1e-12, abs=1e-300)


@given(st.lists(one_pulse, min_size=2, max_size=20), st.data())
def test_pulses_in_two_lists_leave_the_same_heat(rows, data):
    columns = build_columns(rows)
    cut = data.draw(st.integers(0, len(rows)))
    whole, parts = NominalThermalState(ARRAY), NominalThermalState(ARRAY)
    whole.apply_pulses(*columns)
    parts.apply_pulses(*(column[:cut] for column in columns))
    parts.apply_pulses(*(column[cut:] for column in columns))
    end_s = columns[1][-1] + columns[2][-1]
    assert [whole.rises_k(i, end_s) for i in range(3)] == [parts.rises_k(i, end_s) for i in range(3)]


def test_read_only_and_narrow_columns_are_taken():
    pixel, start_s = np.array([0, 2], dtype=np.int32), np.array([0.0, 0.1])
    pixel.flags.writeable = start_s.flags.writeable = False
    half = np.array([0.01, 0.02], dtype=np.float32)
    assert NominalThermalState(ARRAY).apply_pulses(pixel, start_s, half, half).displacement_m.min() > 0


def test_unknown_pixels_and_ragged_columns_are_refused():
    one = np.ones(1)
    with pytest.raises(IndexError, match="3 to 3 of 3"):
        NominalThermalState(ARRAY).apply_pulses(np.array([3]), one, one, one)
    with pytest.raises(IndexError, match="-1 to -1 of 3"):
        NominalThermalState(ARRAY).apply_pulses(np.array([-1]), one, one, one)
    with pytest.raises(ValueError, match="differ in length"):
        NominalThermalState(ARRAY).apply_pulses(np.array([0]), one, np.ones(2), one)
