"""Lines, hops and drifts of an instrument are found, with their numbers, and nothing else is taken for one."""

from dataclasses import replace

import numpy as np
import pytest

from optodrive.core.types.measurements import Measurement, Run, Signal
from optodrive.lab.diagnosis.dataset import build_dataset
from optodrive.lab.diagnosis.instrument_disturbances import find_dc_coupled, find_disturbances
from optodrive.lab.diagnosis.noise_model import ColouredNoise, NoiseModel
from optodrive.lab.diagnosis.replicate_contrasts import JitterSensitivity, NoiseWindow

NOISE_M, NOISE_K = 2e-6, 0.2
T_S = np.arange(600) / 2500.0
POWERS_W = (0.5, 1.0, 1.5, 2.0, 2.45)


COLOURED = {
    0: ColouredNoise(NOISE_K, (1e-9, 1e-9), (0.01, 0.1)),
    1: ColouredNoise(NOISE_M, (1e-12, 1e-12), (0.01, 0.1)),
}
NOISE = NoiseModel(COLOURED, 0.005, 2e-5, {0: NOISE_K, 1: NOISE_M}, True)


def build_runs(add, seed=1, repeats=3, tau_s=0.0):
    """Return a recording of noise alone, to which `add(run number, rng)` adds displacements [600] and temperatures."""
    rng = np.random.default_rng(seed)
    runs = []
    for number in range(len(POWERS_W) * repeats):
        power_w = POWERS_W[number % len(POWERS_W)]
        displacement_m, temperature_k = add(number, rng)
        noise = rng.standard_normal((2, len(T_S)))
        if tau_s:
            share = np.exp(-(T_S[1] - T_S[0]) / tau_s)
            for row in range(1, len(T_S)):
                noise[:, row] = share * noise[:, row - 1] + np.sqrt(1.0 - share**2) * noise[:, row]
        signals = {
            "displacement_m": Signal(0, T_S, NOISE_M * noise[0] + displacement_m),
            "absorber_temperature_K": Signal(0, T_S, 293.0 + NOISE_K * noise[1] + temperature_k),
        }
        attributes = {"started_at": f"2026-11-25T10:{number:02d}:00", "group": f"{power_w} W"}
        runs.append(Run(f"r{number}", 293.0, np.array([[0.04, 0.05, power_w, 0.0]]), signals, attributes))
    return Measurement(tuple(runs))


def find(measurement):
    data = build_dataset(measurement)
    nothing = np.zeros(len(data.value))
    return find_disturbances(data, data.value, JitterSensitivity(nothing, nothing), NOISE), data


@pytest.mark.parametrize("is_random", [True, False])
@pytest.mark.parametrize("hz", [17.3, 50.0, 431.0])
def test_a_line_of_any_frequency_and_phase_is_found_and_removed(hz, is_random):
    def add(number, rng):
        phase = rng.uniform(0.0, 6.28) if is_random else 1.0
        return 5e-6 * np.sin(2.0 * np.pi * hz * T_S + phase), 0.0

    (found, added), data = find(build_runs(add))
    assert [(item.signal, item.form) for item in found] == [("displacement_m", "line")]
    assert found[0].frequency_hz == pytest.approx(hz, abs=0.5)
    assert found[0].size == pytest.approx(5e-6, rel=0.05)
    part = np.concatenate([data.value[block.part] - added[block.part] for block in data.blocks if block.kind == 1])
    assert part.std() == pytest.approx(NOISE_M, rel=0.05)


def test_two_lines_in_two_signals_are_both_found():
    def add(number, rng):
        first, second = rng.uniform(0.0, 6.28, 2)
        return 5e-6 * np.sin(2.0 * np.pi * 50.0 * T_S + first), 0.4 * np.sin(2.0 * np.pi * 150.0 * T_S + second)

    (found, _), _ = find(build_runs(add))
    assert {(item.signal, round(item.frequency_hz, -1)) for item in found} == {
        ("displacement_m", 50.0),
        ("absorber_temperature_K", 150.0),
    }


def test_what_rings_with_the_pulse_is_no_line_of_the_instrument():
    def add(number, rng):
        power_w = POWERS_W[number % len(POWERS_W)]
        after = np.maximum(T_S - 0.04, 0.0)
        return 5e-6 * power_w * np.exp(-after / 0.5) * np.sin(2.0 * np.pi * 90.0 * after), 0.0

    (found, _), _ = find(build_runs(add))
    assert found == ()


def test_hops_of_one_signal_are_found_and_removed():
    times_s = {2: 0.11, 5: 0.15, 11: 0.03}

    def add(number, rng):
        return (1e-5 * (times_s[number] <= T_S) if number in times_s else 0.0 * T_S), 0.0

    (found, added), data = find(build_runs(add))
    assert [(item.signal, item.form, item.runs) for item in found] == [("displacement_m", "hops", 3)]
    assert found[0].size == pytest.approx(1e-5, rel=0.15)
    for block in data.blocks:
        expected = 1e-5 * (times_s[block.run] <= block.t_s) if block.kind == 1 and block.run in times_s else 0.0
        assert np.abs(added[block.part] - expected).mean() < 1.5e-6


def test_what_a_mean_makes_of_a_missing_sample_is_no_hop():
    averaged = replace(COLOURED[0], windows=(NoiseWindow(float(np.diff(T_S).mean()), 16),))

    def add(number, rng):
        return 0.0, 5.0 * ((T_S >= 0.11) & (T_S < 0.125)) * (number == 5)

    data = build_dataset(build_runs(add))
    nothing = JitterSensitivity(*2 * [np.zeros(len(data.value))])
    for coloured, count in ((COLOURED[0], 1), (averaged, 0)):
        noise = replace(NOISE, coloured=COLOURED | {0: coloured})
        assert len(find_disturbances(data, data.value, nothing, noise)[0]) == count


def test_a_hop_of_the_power_which_both_signals_show_is_not_the_instruments():
    def add(number, rng):
        hop = (T_S >= 0.06) * (number == 5)
        return 1e-5 * hop, 2.0 * hop

    (found, _), _ = find(build_runs(add))
    assert found == ()


@pytest.mark.parametrize("form", [lambda x: x, lambda x: np.sin(5.0 * x)])
def test_a_drift_of_the_zero_is_found_and_removed(form):
    (found, added), data = find(build_runs(lambda number, rng: (2e-5 * form(number / 14.0) + 0.0 * T_S, 0.0)))
    assert [(item.signal, item.form) for item in found] == [("displacement_m", "drift")]
    assert found[0].size == pytest.approx(2e-5 * np.ptp(form(np.arange(15) / 14.0)), rel=0.15)
    left = [np.mean(data.value[block.part] - added[block.part]) for block in data.blocks if block.kind == 1]
    assert np.std(left) < 3e-6


@pytest.mark.parametrize("tau_s", [0.0, 0.003, 0.05])
def test_noise_of_any_colour_is_no_disturbance(tau_s):
    for seed in range(5):
        (found, added), _ = find(build_runs(lambda number, rng: (0.0 * T_S, 0.0), seed, tau_s=tau_s))
        assert found == ()
        assert not added.any()


def test_noise_that_oscillates_is_no_line():
    def add(number, rng):
        share, turn = np.exp(-0.0004 / 0.02), 2.0 * np.pi * 60.0 * 0.0004
        state, out = complex(*rng.standard_normal(2)), np.zeros(len(T_S))
        for row in range(len(T_S)):
            out[row] = state.real
            state = share * state * np.exp(1j * turn) + np.sqrt(1.0 - share**2) * complex(*rng.standard_normal(2))
        return 3e-6 * out, 0.0

    assert all(find(build_runs(add, seed))[0][0] == () for seed in range(5))


def test_data_without_noise_has_no_disturbance():
    quiet = build_runs(lambda number, rng: (0.0 * T_S, 0.0))
    runs = [
        replace(
            run,
            signals={name: replace(item, value=np.round(0.0 * item.value, 9)) for name, item in run.signals.items()},
        )
        for run in quiet.runs
    ]
    (found, _), _ = find(Measurement(tuple(runs)))
    assert found == ()


@pytest.mark.parametrize(("spread_m", "found"), [(0.0, set()), (4.0 * NOISE_M, {"displacement"})])
def test_zeros_that_differ_by_more_than_a_sample_show_that_no_input_is_ac_coupled(spread_m, found):
    def add(number, rng):
        # An amplifier that is AC coupled begins at zero with its first sample, noise included.
        return (spread_m or NOISE_M) * rng.standard_normal(), 0.0

    data = build_dataset(build_runs(add))
    assert find_dc_coupled(data, data.value, NOISE) == found
