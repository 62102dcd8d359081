"""Thermal state of a nominal display against the closed forms of a single pixel."""

import numpy as np
import pytest

from optodrive.physics.nominal_display import NominalThermalState
from optodrive.physics.parameters import PixelArray
from optodrive.physics.pixel import Pixel, advance, cooling_peak

NARROW = Pixel(382.0, 81e-6, 0.66, 3e-3, 4e-6, 2e-4)
WIDE = Pixel(95.0, 102e-6, 0.66, 5e-3, 3e-6, 3e-4)


def columns_of(rows):
    """Convert rows of (pixel, start_s, width_s, power_w) to pulses [n, 4]."""
    return np.array([(*pulse, pixel) for pixel, *pulse in rows], dtype=float).reshape(-1, 4)


@pytest.fixture
def pixels():
    columns = zip(
        *([getattr(p, name) for name in PixelArray.__dataclass_fields__] for p in (NARROW, WIDE)), strict=True
    )
    return PixelArray(*(np.array(column) for column in columns))


def events(*rows):
    pixel, start, width, power = zip(*rows, strict=True)
    return np.array(pixel), np.array(start), np.array(width), np.array(power)


def test_starts_cold_on_its_own_time_line(pixels):
    heat = NominalThermalState(pixels, at_s=5.0)
    assert heat.rises_k(1, 7.0) == (0.0, 0.0)
    with pytest.raises(ValueError, match="advanced to 5"):
        heat.rises_k(1, 4.9)


def test_pulses_follow_the_closed_form_and_leave_neighbours_alone(pixels):
    heat = NominalThermalState(pixels)
    heat.apply_pulse(0, 0.010, 0.008, 2.45)
    heat.apply_pulse(0, 0.030, 0.004, 1.0)
    pulsed = advance(NARROW, 0.0, 0.0, 2.45, 0.008)
    again = advance(NARROW, *advance(NARROW, *pulsed, 0.0, 0.012), 1.0, 0.004)
    assert heat.rises_k(0, 0.050) == pytest.approx(advance(NARROW, *again, 0.0, 0.016), rel=1e-12)
    assert heat.rises_k(1, 0.050) == (0.0, 0.0)


def test_asking_does_not_change_the_answer(pixels):
    heat = NominalThermalState(pixels)
    heat.apply_pulse(0, 0.0, 0.01, 2.45)
    later = heat.rises_k(0, 0.5)
    sooner = heat.rises_k(0, 0.02)
    assert sooner[0] > later[0]
    assert heat.rises_k(0, 0.5) == later


def test_a_pulse_before_the_last_ones_end_is_refused(pixels):
    heat = NominalThermalState(pixels)
    heat.apply_pulse(0, 0.0, 0.01, 2.45)
    with pytest.raises(ValueError, match="pixel 0"):
        heat.apply_pulse(0, 0.009, 0.01, 2.45)
    heat.apply_pulse(1, 0.009, 0.01, 2.45)


def test_abutting_pulses_bear_rounding_and_are_one(pixels):
    heat, whole = NominalThermalState(pixels), NominalThermalState(pixels)
    heat.apply_pulse(0, 0.1, 0.2, 1.0)
    heat.apply_pulse(0, 0.3, 0.1, 1.0)
    whole.apply_pulse(0, 0.1, 0.3, 1.0)
    assert 0.1 + 0.2 > 0.3
    assert heat.rises_k(0, 0.5) == pytest.approx(whole.rises_k(0, 0.5), rel=1e-12)


def test_asked_a_rounding_before_its_end_a_pulse_has_ended(pixels):
    heat = NominalThermalState(pixels)
    heat.apply_pulse(0, 0.0, 0.01, 2.45)
    assert heat.rises_k(0, 0.01 - 0.9e-9) == heat.rises_k(0, 0.01)


def test_a_copy_is_independent(pixels):
    heat = NominalThermalState(pixels)
    heat.apply_pulse(0, 0.0, 0.01, 2.45)
    twin = heat.copy()
    before = heat.rises_k(0, 0.02)
    twin.apply_pulse(0, 0.01, 0.01, 2.45)
    assert heat.rises_k(0, 0.02) == before
    assert twin.rises_k(0, 0.02) != before


def test_shifted_heat_is_the_same_later(pixels):
    heat = NominalThermalState(pixels)
    heat.apply_pulse(0, 1.0, 0.01, 2.45)
    assert heat.copy_shifted(-1.0).rises_k(0, 0.02) == pytest.approx(heat.rises_k(0, 1.02), rel=1e-9)


def test_peak_is_the_cooling_peak_within_its_time(pixels):
    heat = NominalThermalState(pixels)
    heat.apply_pulse(1, 0.0, 0.01, 2.45)
    end = advance(WIDE, 0.0, 0.0, 2.45, 0.01)
    assert heat.peak_m(1) == pytest.approx(WIDE.kappa_m_per_k * cooling_peak(WIDE, *end)[0], rel=1e-12)
    assert heat.peak_m(1, 0.0) == pytest.approx(WIDE.kappa_m_per_k * end[1], rel=1e-12)
    assert heat.peak_m(0) == 0.0


def test_peaks_of_interleaved_trains_meet_a_dense_trace(pixels):
    rows = [
        (0, 0.000, 0.0100, 2.45),
        (1, 0.012, 0.0050, 2.45),
        (0, 0.018, 0.0030, 1.2),
        (1, 0.0175, 0.0004, 0.5),
        (0, 0.0215, 0.0200, 2.45),
        (0, 0.060, 0.0004, 0.01),
        (0, 0.300, 0.0002, 0.1),
    ]
    heat = NominalThermalState(pixels)
    peaks = heat.apply_pulses(*events(*rows)).displacement_m
    t_s = np.arange(0.0, 1.0, 5e-6)
    trace = NominalThermalState(pixels).simulate_traces(columns_of(rows), [0, 1], t_s)
    for row, (pixel, start_s, _, _) in enumerate(rows):
        following = [later[1] for later in rows[row + 1 :] if later[0] == pixel]
        during = (t_s >= start_s) & (t_s <= (following[0] if following else np.inf))
        assert peaks[row] == pytest.approx(trace.displacement_m[during, pixel].max(), rel=1e-4), row
    assert heat.rises_k(0, 0.5) == pytest.approx(
        (trace.absorber_k[100_000, 0], trace.displacement_m[100_000, 0] / NARROW.kappa_m_per_k), rel=1e-9
    )


def test_peaks_of_no_pulses():
    none = np.zeros(0)
    heat = NominalThermalState(PixelArray.uniform(NARROW, 3))
    assert heat.apply_pulses(np.zeros(0, dtype=np.int64), none, none, none).displacement_m.shape == (0,)


def test_trace_is_exact_at_edges_and_between(pixels):
    rows = [(0, 0.001, 0.008, 2.45), (1, 0.010, 0.002, 2.45)]
    t_s = np.array([0.0, 0.001, 0.005, 0.009, 0.030])
    trace = NominalThermalState(pixels).simulate_traces(columns_of(rows), [1, 0], t_s)
    pulsed = advance(NARROW, 0.0, 0.0, 2.45, 0.008)
    expected = [
        (0.0, 0.0),
        (0.0, 0.0),
        advance(NARROW, 0.0, 0.0, 2.45, 0.004),
        pulsed,
        advance(NARROW, *pulsed, 0.0, 0.021),
    ]
    got = np.stack([trace.absorber_k[:, 1], trace.gas_k[:, 1]], axis=1)
    assert got == pytest.approx(np.array(expected), rel=1e-9, abs=1e-9)
    assert trace.pixel.tolist() == [1, 0]
    assert trace.displacement_m[4] == pytest.approx(trace.gas_k[4] * [3e-6, 4e-6])
    assert trace.force_n[4] == pytest.approx(trace.gas_k[4] * [3e-4, 2e-4])
    assert trace.displacement_m[4].min() > 0


def test_trace_leaves_the_heat_as_it_was(pixels):
    heat = NominalThermalState(pixels)
    heat.apply_pulse(0, 0.0, 0.01, 2.45)
    before = heat.rises_k(0, 0.02)
    trace = heat.simulate_traces(columns_of([(0, 0.02, 0.01, 2.45)]), [0], np.array([0.02, 0.03]))
    assert trace.absorber_k[0, 0] == pytest.approx(before[0])
    assert heat.rises_k(0, 0.02) == before


def test_a_pixel_looked_at_twice_shows_the_same_twice(pixels):
    trace = NominalThermalState(pixels).simulate_traces(
        columns_of([(1, 0.0, 0.01, 2.45)]), [1, 1], np.array([0.005, 0.02])
    )
    assert trace.displacement_m[:, 0].min() > 0
    assert trace.displacement_m[:, 0].tolist() == trace.displacement_m[:, 1].tolist()


def test_a_trace_that_begins_before_the_heat_or_crosses_pulses_is_refused(pixels):
    heat = NominalThermalState(pixels, at_s=5.0)
    with pytest.raises(ValueError, match="last event is at 5"):
        heat.simulate_traces(columns_of([]), [0], np.array([4.0, 6.0]))
    with pytest.raises(ValueError, match=r"pixel 1 at 5\.9 s: its last event is at 6"):
        heat.simulate_traces(columns_of([(1, 5.5, 0.5, 1.0), (1, 5.9, 0.5, 1.0)]), [1], np.array([5.0, 7.0]))
    assert heat.simulate_traces(columns_of([]), [0], np.array([5.0, 6.0])).absorber_k.tolist() == [[0.0], [0.0]]


def test_arrays_of_pixels():
    array = PixelArray.uniform(NARROW, 4)
    assert len(array) == 4
    assert array.elements == (NARROW,) * 4
    with pytest.raises(ValueError, match="read-only"):
        array.tau_g_s[0] = 1.0
