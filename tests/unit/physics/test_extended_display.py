"""Displays with terms: nominal without terms, and equal to single pixels in `pixel_ode` with them."""

from dataclasses import replace

import numpy as np
import pytest

from displays import DISPLAYS
from optodrive.core.errors import DivergedError
from optodrive.device.panel import Neighbours
from optodrive.physics import extended_display
from optodrive.physics.extended_display import ExtendedThermalState
from optodrive.physics.extended_pulses import peak_after_off_m
from optodrive.physics.nominal_display import NominalThermalState
from optodrive.physics.parameters import PixelArray
from optodrive.physics.pixel import Pixel
from optodrive.physics.pixel_ode import ActiveTerms, PixelExperiment, simulate_signals
from optodrive.physics.pulse_for_height import DriveRange
from optodrive.physics.term import CONTEXT_SIZE, ELSEWHERE, GAS
from optodrive.physics.term_kernels import STATE_COUNT, TERMS

PIXEL = Pixel(184.0, 126e-6, 0.66, 3e-3, 4e-6, 2e-4)
DRIVE = DriveRange.from_laser(2.45, 5000.0, 0.050)
SMALL = Neighbours.from_display(DISPLAYS["display-16"].config.display)
ARRAY = PixelArray.uniform(PIXEL, 16)
AMBIENT_K, FULL_W = 296.15, 2.45
SINGLE = sorted(term.key for term in TERMS if any(term.kernels))
OF_EACH_KIND = ("", "laser_lag", "panel_heating", "neighbour_crosstalk", "radiation", "gas_leak", "membrane_creep")
"""No term, and one each of laser, panel, neighbours, absorber, gas and membrane."""


def default_values(*keys):
    return {term.key: {item.name: item.default for item in term.parameters} for term in TERMS if term.key in keys}


def extended(*keys, at_s=0.0):
    return ExtendedThermalState(ARRAY, default_values(*keys), AMBIENT_K, FULL_W, SMALL, at_s)


def some_pulses(seed, count=40, pixels=(0, 1, 5, 15)):
    generator = np.random.default_rng(seed)
    width_s = generator.integers(1, 60, count) * 2e-4
    start_s = np.cumsum(np.concatenate([[0.0], width_s[:-1]]) + generator.exponential(4e-3, count))
    return generator.choice(pixels, count), start_s, width_s, generator.uniform(0.2, FULL_W, count)


def test_a_display_with_a_term_that_diverges_is_refused_by_name():
    with pytest.raises(DivergedError, match="term gas_leak: got a time constant of 200 µs"):
        ExtendedThermalState(ARRAY, {"gas_leak": {"rate": 5000.0}}, AMBIENT_K, FULL_W, SMALL)


def test_the_search_for_a_peak_ends_where_there_is_no_number():
    active, work = ActiveTerms.from_values({}), np.zeros((8, STATE_COUNT))
    work[0, GAS] = np.nan
    assert np.isnan(peak_after_off_m(PIXEL, active, np.zeros(CONTEXT_SIZE), work, 0.0, 0.0))


def select_acting(keys, columns, pixel):
    """Return the pulses [n] that act on a pixel: its own, its neighbours', and all others through laser and panel."""
    terms = [term for term in TERMS if term.key in keys]
    is_near = np.isin(columns[0], [pixel, *SMALL.indices[pixel]])
    if not any(term.couples_neighbours for term in terms):
        is_near = columns[0] == pixel
    if any(term.has_laser_state or term.has_panel_state for term in terms):
        return (np.where(is_near, columns[0], ELSEWHERE), *columns[1:])
    return tuple(column[is_near] for column in columns)


def simulate_alone(keys, pixel, columns, until_s):
    """Simulate one pixel through the same pulses, finely sampled: time, absorber, displacement."""
    index, start_s, width_s, power_w = columns
    t_s = np.unique(np.concatenate([np.arange(0.0, until_s, 2e-5), start_s]))
    scene = PixelExperiment(
        np.column_stack([start_s, width_s, power_w, index]),
        pixel,
        AMBIENT_K,
        (t_s, t_s, t_s[:0]),
        dose_before=1.0,
        session_time=1.0,
    )
    absorber_k, displacement_m, _ = simulate_signals(scene, PIXEL, ActiveTerms.from_values(default_values(*keys)))
    return t_s, absorber_k, displacement_m


@pytest.mark.parametrize("seed", [1, 2])
def test_without_terms_it_is_the_nominal_display(seed):
    columns = some_pulses(seed)
    ours, nominal = extended(), NominalThermalState(ARRAY)
    peaks, expected = ours.apply_pulses(*columns), nominal.apply_pulses(*columns)
    assert peaks.displacement_m == pytest.approx(expected.displacement_m, rel=2e-4)
    assert peaks.absorber_k == pytest.approx(expected.absorber_k, rel=2e-4)
    end_s = columns[1][-1] + 0.1
    for target_m in (2e-5, 1.5e-4, 9e-4):
        periods, duty = ours.solve_pulse(1, end_s, target_m, DRIVE)
        theirs = nominal.solve_pulse(1, end_s, target_m, DRIVE)
        assert periods * duty == pytest.approx(theirs[0] * theirs[1], rel=1e-3)
        assert abs(periods - theirs[0]) <= 1
        fine = replace(DRIVE, is_fine=True)
        assert ours.solve_pulse(1, end_s, target_m, fine) == pytest.approx(
            nominal.solve_pulse(1, end_s, target_m, fine), rel=1e-3
        )
    assert ours.max_displacement_m(DRIVE) == pytest.approx(nominal.max_displacement_m(DRIVE), rel=2e-4)


@pytest.mark.parametrize("key", [*SINGLE, "laser_droop+membrane_creep", "laser_lag+neighbour_crosstalk"])
def test_each_pulse_brings_its_pixel_to_what_one_pixel_alone_does(key):
    keys = key.split("+")
    columns = some_pulses(3)
    index, start_s, *_ = columns
    peaks = extended(*keys).apply_pulses(*columns).displacement_m
    for pixel in (0, 1, 5):
        own = select_acting(keys, columns, pixel)
        t_s, _, displacement_m = simulate_alone(keys, pixel, own, start_s[-1] + 0.3)
        rows = np.flatnonzero(index == pixel)
        for row, after in zip(rows, [*rows[1:], None], strict=True):
            until_s = np.inf if after is None else start_s[after]
            during = (t_s >= start_s[row]) & (t_s <= until_s)
            assert peaks[row] == pytest.approx(displacement_m[during].max(), rel=2e-4, abs=2e-8), (pixel, row)


@pytest.mark.parametrize("rest_s", [0.5, 30.0, 600.0])
def test_every_pixel_sees_the_panel_that_light_on_others_warmed(rest_s):
    """A pixel without light is a pixel alone, whose panel has the light of all: after minutes, and after a rest."""
    values = {"panel_heating": {"resistance": 20.0, "capacity": 5.0, "share": 0.65}}
    heat = ExtendedThermalState(ARRAY, values, AMBIENT_K, FULL_W, SMALL)
    start_s = np.arange(400) * 0.1
    columns = (np.tile([1, 15, 2, 7], 100), start_s, np.full(400, 0.02), np.full(400, FULL_W))
    heat.apply_pulses(*columns)
    at_s = start_s[-1] + rest_s
    pulses = np.column_stack([*columns[1:], np.full(400, ELSEWHERE)])
    t_s = np.array([at_s, at_s + 0.05])
    scene = PixelExperiment(pulses, 5, AMBIENT_K, (t_s, t_s, t_s[:0]), dose_before=1.0, session_time=1.0)
    absorber_k, displacement_m, _ = simulate_signals(scene, PIXEL, ActiveTerms.from_values(values))
    state = heat.state_at(at_s)
    assert state.displacement_m[5] == pytest.approx(displacement_m[0], rel=2e-3)
    assert state.absorber_k[5] == pytest.approx(absorber_k[0], rel=2e-3)
    assert heat.simulate_displacement_m(np.zeros((0, 4)), 5, t_s) == pytest.approx(displacement_m, rel=2e-3)
    heat.apply_pulses(np.array([3]), np.array([at_s]), np.array([0.02]), np.array([FULL_W]))
    assert heat.state_at(at_s + 0.05).displacement_m[5] > displacement_m[1]


@pytest.mark.parametrize("is_fine", [False, True])
@pytest.mark.parametrize("key", [*SINGLE, "radiation+gas_leak"])
def test_a_pulse_asked_for_a_height_reaches_it_after_others(key, is_fine):
    keys = key.split("+")
    for target_m in (8e-5, 2.5e-4, 4.5e-4):
        heat = extended(*keys)
        before = some_pulses(4, 10, pixels=(5,))
        heat.apply_pulses(*before)
        at_s = before[1][-1] + 0.06
        periods, duty = heat.solve_pulse(5, at_s, target_m, replace(DRIVE, is_fine=is_fine))
        assert 0 < periods <= DRIVE.max_periods
        assert 0 < duty <= 1
        one = (np.array([5]), np.array([at_s]), np.array([periods * DRIVE.period_s]), np.array([duty * FULL_W]))
        combined = tuple(np.concatenate(pair) for pair in zip(before, one, strict=True))
        t_s, _, displacement_m = simulate_alone(keys, 5, combined, at_s + 0.3)
        assert displacement_m[t_s >= at_s].max() == pytest.approx(target_m, rel=1e-3)
        if periods > 1:
            shorter = extended(*keys)
            shorter.apply_pulses(*before)
            columns = (np.array([5]), np.array([at_s]), np.array([(periods - 1) * DRIVE.period_s]), np.array([FULL_W]))
            assert shorter.apply_pulses(*columns).displacement_m[0] < target_m


@pytest.mark.parametrize("key", ["laser_lag", "laser_droop"])
@pytest.mark.parametrize("gap_s", [4e-4, 2e-3])
@pytest.mark.parametrize("target_m", [4e-5, 2e-4])
def test_a_pulse_asked_for_just_after_one_on_another_pixel_reaches_its_height(key, gap_s, target_m):
    before = some_pulses(4, 10, pixels=(1,))
    heat, at_s = extended(key), before[1][-1] + before[2][-1] + gap_s
    heat.apply_pulses(*before)
    periods, duty = heat.solve_pulse(5, at_s, target_m, DRIVE)
    one = (np.array([5]), np.array([at_s]), np.array([periods * DRIVE.period_s]), np.array([duty * FULL_W]))
    combined = tuple(np.concatenate(pair) for pair in zip(before, one, strict=True))
    _, _, displacement_m = simulate_alone([key], 5, combined, at_s + 0.3)
    assert displacement_m.max() == pytest.approx(target_m, rel=1e-3)
    pulse = np.array([[at_s, one[2][0], one[3][0], 5.0]])
    t_s = at_s + np.linspace(0.0, 0.08, 1601)
    assert heat.simulate_displacement_m(pulse, 5, t_s).max() == pytest.approx(target_m, rel=1e-3)


@pytest.mark.parametrize("key", ["", "laser_turn_on+membrane_creep", "gas_leak"])
def test_a_pulse_asked_to_be_wide_and_to_count_late_is(key):
    keys = key.split("+")
    heat, before = extended(*keys), some_pulses(4, 10, pixels=(5,))
    heat.apply_pulses(*before)
    at_s = before[1][-1] + 0.06
    for min_periods, from_s in ((60, 0.0), (20, 0.02), (1, 0.015)):
        periods, duty = heat.solve_pulse(5, at_s, 1e-4, DRIVE, min_periods, from_s)
        assert periods >= min_periods
        pulse = np.array([[at_s, periods * DRIVE.period_s, duty * FULL_W, 5.0]])
        t_s = at_s + max(from_s, 0.0) + np.linspace(0.0, 0.08, 1601)
        assert heat.simulate_displacement_m(pulse, 5, t_s).max() == pytest.approx(1e-4, rel=1e-3)
        if not key:
            nominal = NominalThermalState(ARRAY)
            nominal.apply_pulses(*before)
            theirs = nominal.solve_pulse(5, at_s, 1e-4, DRIVE, min_periods, from_s)
            assert periods == theirs[0]
            assert duty == pytest.approx(theirs[1], rel=1e-2)


@pytest.mark.parametrize(
    "key", [pytest.param(key, marks=() if key in OF_EACH_KIND else pytest.mark.slow) for key in ("", *SINGLE)]
)
@pytest.mark.parametrize("pixel", [pytest.param(0, marks=pytest.mark.slow), 5])
def test_heights_from_the_heat_there_are_those_of_the_whole_run(key, pixel):
    keys = key.split("+")
    columns = some_pulses(9)
    own = select_acting(keys, columns, pixel)
    half = int(np.flatnonzero(columns[0] == pixel)[3]) - 1
    heat = extended(*keys)
    heat.apply_pulses(*(column[: half + 1] for column in columns))
    pulses = np.column_stack([*columns[1:], columns[0]])
    t_s, _, displacement_m = simulate_alone(keys, pixel, own, pulses[-1, 0] + 0.1)
    after = t_s > pulses[half, :2].sum() + 1e-6
    untouched = heat.copy()
    ours_m = heat.simulate_displacement_m(pulses[half + 1 :], pixel, t_s[after])
    assert ours_m == pytest.approx(displacement_m[after], rel=1e-3, abs=5e-8)
    assert heat.solve_pulse(pixel, t_s[-1], 4e-4, DRIVE) == untouched.solve_pulse(pixel, t_s[-1], 4e-4, DRIVE)
    with pytest.raises(ValueError, match="lies before it"):
        heat.simulate_displacement_m(pulses[half + 1 :], pixel, np.zeros(1))


def test_no_pulse_where_the_heat_left_reaches_the_height_and_the_longest_where_none_does():
    heat = extended("radiation")
    heat.apply_pulses(np.array([2]), np.zeros(1), np.array([0.05]), np.array([FULL_W]))
    assert heat.solve_pulse(2, 0.051, 1e-4, DRIVE) is None
    assert heat.solve_pulse(3, 0.051, 2 * heat.max_displacement_m(DRIVE)[3], DRIVE) == (DRIVE.max_periods, 1.0)
    assert heat.max_displacement_m(DRIVE)[2] == heat.max_displacement_m(DRIVE)[3]


def test_one_pixel_out_of_the_beam_reaches_less():
    values = default_values("beam_misalignment")
    values["beam_misalignment"]["pixel"] = 6.0
    reaches_m = ExtendedThermalState(ARRAY, values, AMBIENT_K, FULL_W, SMALL).max_displacement_m(DRIVE)
    assert reaches_m[6] < 0.97 * reaches_m[5]
    assert np.delete(reaches_m, 6) == pytest.approx(reaches_m[5])


def test_a_neighbours_light_lifts_a_pixel_only_where_they_exchange_heat():
    for keys, min_k in ((("neighbour_crosstalk",), 1e-7), (("radiation",), 0.0)):
        heat = extended(*keys)
        heat.apply_pulses(np.array([5]), np.zeros(1), np.array([0.05]), np.array([FULL_W]))
        beside = int(SMALL.indices[5][0])
        assert (np.abs(heat.copy()._events.states[beside]).max() > min_k) == (min_k > 0)


def test_copies_and_shifts_stand_alone():
    heat, columns = extended("membrane_creep"), some_pulses(6)
    twin = heat.copy()
    heat.apply_pulses(*columns)
    at_s = columns[1][-1] + 0.05
    later = heat.copy_shifted(-1.0)
    request = (2.5e-4, DRIVE)
    assert later.solve_pulse(1, at_s - 1.0, *request) == pytest.approx(heat.solve_pulse(1, at_s, *request), rel=1e-6)
    assert twin.solve_pulse(1, 0.0, *request) == pytest.approx(
        extended("membrane_creep").solve_pulse(1, 0.0, *request), rel=1e-12
    )


def test_what_comes_too_early_is_refused():
    heat = extended("radiation", at_s=5.0)
    with pytest.raises(ValueError, match=r"pixel 1 was advanced to 5\.0 s, 4\.0 s lies before it"):
        heat.solve_pulse(1, 4.0, 1e-4, DRIVE)
    with pytest.raises(ValueError, match="pixel 1 was advanced"):
        heat.apply_pulses(np.array([1]), np.array([4.9]), np.array([0.01]), np.array([1.0]))
    with pytest.raises(IndexError):
        heat.apply_pulses(np.array([16]), np.array([6.0]), np.array([0.01]), np.array([1.0]))


def test_traces_are_taken_from_rest_and_show_every_pixel_asked_for():
    heat, columns = extended("membrane_stiffening"), some_pulses(7)
    pulses = np.column_stack([*columns[1:], columns[0]])
    t_s = np.linspace(0.0, 0.4, 4001)
    traced = heat.simulate_traces(pulses, [5, 0], t_s)
    assert traced.pixel.tolist() == [5, 0]
    own = columns[0] == 5
    expected = heat.copy().apply_pulses(*(column[own] for column in columns)).displacement_m.max()
    assert traced.displacement_m[:, 0].max() == pytest.approx(expected, rel=1e-3)
    stiff = traced.displacement_m[:, 0] < 0.995 * PIXEL.kappa_m_per_k * traced.gas_k[:, 0]
    assert stiff.any()
    nominal = NominalThermalState(ARRAY).simulate_traces(pulses, [5, 0], t_s)
    assert traced.gas_k == pytest.approx(nominal.gas_k, rel=1e-3, abs=1e-3)
    heat.apply_pulses(*columns)
    with pytest.raises(ValueError, match="from the cold state"):
        heat.simulate_traces(pulses, [5], t_s)


def test_it_ticks_while_it_works_and_pieces_change_nothing(monkeypatch):
    columns, ticks = some_pulses(8, count=300), []
    whole = extended("gas_leak").apply_pulses(*columns)
    monkeypatch.setattr(extended_display, "BATCH", 7)
    pieces = extended("gas_leak").apply_pulses(*columns, lambda: ticks.append(1))
    assert len(ticks) == 43 + 3
    assert pieces.displacement_m.tolist() == whole.displacement_m.tolist()
    assert pieces.absorber_k.tolist() == whole.absorber_k.tolist()
