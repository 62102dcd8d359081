"""The noise model agrees with dense matrices and recovers known noise from repeats."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import uniform_filter1d
from scipy.signal import butter, filtfilt

from labs import AMBIENT_K, PIXEL, lab
from optodrive.core.types.measurements import Measurement, Run, Signal
from optodrive.device.servo import simulate_servo
from optodrive.lab.diagnosis.dataset import build_dataset
from optodrive.lab.diagnosis.fitting import compute_jitter_sensitivity, compute_normal_equations, project_out, solve
from optodrive.lab.diagnosis.model_selection import MAX_INTRA_PULSE_POWER_EXCESS, MAX_REPLICATE_EXCESS
from optodrive.lab.diagnosis.noise_model import ColouredNoise, NoiseModel, drop_averaged_ends, whiten
from optodrive.lab.diagnosis.nominal_fit import fit_nominal
from optodrive.lab.diagnosis.replicate_contrasts import (
    Contrast,
    JitterSensitivity,
    average_windows,
    compute_contrasts,
    find_windows,
)

NOISE = ColouredNoise(white=0.3, sigma=(0.2, 0.4), tau_s=(0.01, 0.05), omega_rad_per_s=300.0)


def dense(t_s, noise):
    gap = np.abs(t_s[:, None] - t_s)
    first = noise.sigma[0] ** 2 * np.exp(-gap / noise.tau_s[0])
    second = noise.sigma[1] ** 2 * np.exp(-gap / noise.tau_s[1]) * np.cos(noise.omega_rad_per_s * gap)
    return first + second + noise.white**2 * np.eye(len(t_s))


def test_whitening_is_the_inverse_of_the_covariance_on_any_times():
    rng = np.random.default_rng(1)
    t_s = np.sort(rng.uniform(0, 0.3, 80))
    columns = rng.standard_normal((80, 3))
    whitened, logdet = whiten(t_s, columns, NOISE)
    covariance = dense(t_s, NOISE)
    assert whitened.T @ whitened == pytest.approx(columns.T @ np.linalg.solve(covariance, columns), rel=1e-9)
    assert logdet == pytest.approx(np.linalg.slogdet(covariance)[1], rel=1e-9)


def test_normal_equations_with_shared_jitters_are_those_of_the_dense_covariance():
    data = build_dataset(lab(3, {}, groups=("short",), rate=400.0))
    rng = np.random.default_rng(2)
    columns = rng.standard_normal((len(data.value), 2))
    power, timing = rng.standard_normal(len(data.value)), rng.standard_normal(len(data.value))
    noise = NoiseModel(dict.fromkeys(data.kinds, NOISE), 0.7, 0.5, dict.fromkeys(data.kinds, 0.4), True)
    ours = compute_normal_equations(data, columns, noise, JitterSensitivity(power, timing))
    expected = np.zeros((2, 2))
    for run in range(len(data.runs)):
        rows = [block for block in data.blocks if block.run == run]
        at = np.concatenate([np.arange(block.part.start, block.part.stop) for block in rows])
        covariance = np.zeros((len(at), len(at)))
        low = 0
        for block in rows:
            part = slice(low, low + len(block.t_s))
            covariance[part, part] = dense(block.t_s, NOISE) + 0.16
            low = part.stop
        covariance += 0.49 * np.outer(power[at], power[at]) + 0.25 * np.outer(timing[at], timing[at])
        expected += columns[at].T @ np.linalg.solve(covariance, columns[at])
    assert ours == pytest.approx(expected, rel=1e-8)


def test_projecting_out_leaves_what_least_squares_leaves():
    rng = np.random.default_rng(3)
    known, other = rng.standard_normal((50, 3)), rng.standard_normal((50, 2))
    gram = np.column_stack([known, other]).T @ np.column_stack([known, other])
    left = other - known @ np.linalg.lstsq(known, other, rcond=None)[0]
    assert project_out(gram, [0, 1, 2], [3, 4]) == pytest.approx(left.T @ left)
    assert solve(gram, gram @ np.ones(5)) == pytest.approx(np.ones(5))


def test_noise_and_base_are_recovered_from_repeats():
    problem, base = fit_nominal(build_dataset(lab(5, {})))
    assert problem.noise.from_replicates
    for kind, white in ((0, 0.3), (1, 2e-6)):
        assert problem.noise.coloured[kind].white == pytest.approx(white, rel=0.1)
    assert 0.002 < problem.noise.power_sigma < 0.01
    assert problem.noise.replicate_excess < 5.0
    r, c, tau_g = np.exp(base.point.base[:3])
    assert r == pytest.approx(PIXEL.r_k_per_w, rel=0.01)
    assert c == pytest.approx(PIXEL.c_j_per_k, rel=0.01)
    assert tau_g == pytest.approx(PIXEL.tau_g_s, rel=0.03)


def test_a_rate_of_all_clocks_is_that_of_the_mirrors():
    rng, runs, t_s = np.random.default_rng(4), [], np.arange(0.0, 0.4, 2e-4)
    commands = np.column_stack([0.02 * np.arange(20), rng.uniform(-0.1, 0.1, (20, 2))])
    for number in range(3):
        angle = simulate_servo(commands[:, 0], commands[:, 1], t_s / 1.01, None) + 1e-5 * rng.standard_normal(len(t_s))
        signals = {"mirror_x_rad": Signal(0, t_s, angle)}
        runs.append(Run(f"run{number}", 293.15, np.zeros((0, 4)), signals, {"group": "steps"}, commands))
    data = build_dataset(Measurement(tuple(runs)))
    rates = {"time_rate": dict.fromkeys(("temperature", "displacement", "force", "mirrors"), 0.01)}
    residuals = [data.value - fit_nominal(data, shared=shared)[1].prediction for shared in (None, rates)]
    assert np.std(residuals[1]) < 2e-5 < 1e-3 < np.std(residuals[0])


def test_without_repeats_the_noise_is_a_guess():
    assert not fit_nominal(build_dataset(lab(5, {}, repeats=1)))[0].noise.from_replicates


@pytest.mark.parametrize("repeats", [2, 3])
@pytest.mark.parametrize("terms", [{}, {"laser_droop": {"share": 0.34, "time": 0.033, "spread": 1.0}}])
def test_noise_and_jitter_never_exceed_what_repeats_show(terms, repeats):
    data = build_dataset(lab(6, terms, repeats=repeats))
    problem, base = fit_nominal(data)
    sensitivity = compute_jitter_sensitivity(data, base.point, base.prediction)
    contrasts = compute_contrasts(data, data.value - base.prediction, sensitivity)
    noise, powers = problem.noise, []
    for kind in data.kinds:
        spread = []
        for item in (item for item in contrasts if item.kind == kind):
            jitter = item.jitter / np.abs(item.jitter).max(axis=0)
            solved = np.linalg.lstsq(jitter, item.value, rcond=None)[0]
            spread.append(np.mean((item.value - jitter @ solved) ** 2))
            powers.append(solved[0] / np.abs(item.jitter[:, 0]).max())
        coloured = noise.coloured[kind]
        modelled = coloured.white**2 + coloured.sigma[0] ** 2 + coloured.sigma[1] ** 2
        assert modelled < 1.15 * np.mean(spread)
    shown, count = np.sqrt(np.mean(np.square(powers))), len({item.pair for item in contrasts})
    assert noise.power_sigma < shown * (1.0 + 3.0 / np.sqrt(2.0 * count))


def test_an_effect_that_repeats_share_leaves_the_noise_as_it_is():
    plain, drooping = (
        fit_nominal(build_dataset(lab(7, terms)))[0].noise
        for terms in ({}, {"laser_droop": {"share": 0.34, "time": 0.033, "spread": 1.0}})
    )
    assert drooping.power_sigma < 1.2 * plain.power_sigma
    assert drooping.timing_sigma_s < 1.2 * plain.timing_sigma_s
    for kind, item in plain.coloured.items():
        assert drooping.coloured[kind].white == pytest.approx(item.white, rel=0.02)
        assert sum(np.square(drooping.coloured[kind].sigma)) < 1.2 * sum(np.square(item.sigma))


def smooth_twice(value, rate=1000.0):
    return filtfilt(*butter(3, 31.0, fs=rate), value)


def relax(noise, step, share=3.0):
    """Add noise that relaxes within 1 / step samples."""
    slow = np.zeros(len(noise))
    kick = share * np.sqrt(1.0 - np.exp(-2.0 * step)) * np.random.default_rng(8).standard_normal(len(noise))
    for row in range(1, len(noise)):
        slow[row] = np.exp(-step) * slow[row - 1] + kick[row]
    return noise + slow


@pytest.mark.parametrize(
    ("change", "low", "high"),
    [
        (lambda value: value, 1, 1),
        (lambda value: relax(value, 0.4), 1, 1),
        (lambda value: relax(value, 0.005), 1, 1),
        (lambda value: uniform_filter1d(value, 7), 4, 16),
        (lambda value: uniform_filter1d(value, 21, origin=10), 8, 32),
        (smooth_twice, 8, 64),
    ],
)
def test_only_smooth_noise_is_averaged_over_its_length_for_each_interval(change, low, high):
    rng, contrasts = np.random.default_rng(6), []
    for number, interval_s in enumerate([5e-4, 5e-4, 2e-3]):
        t_s = interval_s * np.arange(1500)
        jitter = np.stack([t_s, np.sin(30.0 * t_s), np.ones(1500)], axis=1)
        value = change(rng.standard_normal(1500)) + jitter @ [50.0, 20.0, 3.0]
        contrasts.append(Contrast(number, 0, number, t_s, value, jitter))
    windows = find_windows(contrasts)
    assert sorted(item.interval_s for item in windows) == pytest.approx([5e-4, 2e-3])
    assert all(low <= item.count <= high for item in windows)
    columns = rng.standard_normal((1500, 2))
    columns[700:720] = columns[700]
    kept = np.delete(np.arange(1500), [3, 40, 41, 42, 700])
    t_s, means = average_windows(contrasts[0].t_s[kept], columns[kept], windows)
    count = next(item.count for item in windows if item.interval_s < 1e-3)
    if count == 1:
        assert means == pytest.approx(columns[kept])
    else:
        assert len(t_s) == -(-1500 // count)
        assert means[5] == pytest.approx(columns[kept][kept // count == 5].mean(axis=0))
        assert (np.diff(t_s) > 0.0).all()


def test_repeats_at_other_phases_differ_by_no_more_than_the_noise_of_a_signal_that_the_model_misses():
    rng, interval_s, runs = np.random.default_rng(4), 1e-3, []
    for number in range(5):
        t_s = interval_s * (np.arange(600) + (0.1, 0.36)[number % 2])
        value = uniform_filter1d(rng.standard_normal(600), 29)
        signal = Signal(0, t_s, AMBIENT_K + 120.0 * np.clip((t_s - 0.2) / 0.008, 0.0, 1.0) + value)
        runs.append(
            Run(f"r{number}", AMBIENT_K, np.zeros((0, 4)), {"absorber_temperature_K": signal}, {"group": "one"})
        )
    data = build_dataset(Measurement(tuple(runs)))
    nothing = JitterSensitivity(*2 * [np.zeros(len(data.value))])
    contrasts = compute_contrasts(data, data.value, nothing)
    assert [item.count for item in find_windows(contrasts)] == [32]
    for item in contrasts:  # beside the kinks of the ramp, where the slope is not that of its neighbours
        assert np.abs(item.value[(item.t_s > 0.2025) & (item.t_s < 0.2055)]).max() < 1.0


@pytest.mark.parametrize("change", [lambda value, rate: uniform_filter1d(value, 21, origin=10), smooth_twice])
@pytest.mark.parametrize("terms", [{}, {"bridge_conductivity": {"exponent": 0.6}}])
def test_a_smoothed_signal_does_not_let_repeats_differ(change, terms):
    runs = []
    for rate, group in ((5000.0, ("weak", "middle", "strong")), (400.0, ("train",))):
        for run in lab(9, terms, groups=group, rate=rate).runs:
            signal = run.signals["displacement_m"]
            there = np.isfinite(signal.value)
            value = change(np.interp(signal.t_s, signal.t_s[there], signal.value[there]), rate)
            signals = {**run.signals, "displacement_m": replace(signal, value=value)}
            runs.append(replace(run, signals=signals))
    noise = fit_nominal(build_dataset(Measurement(tuple(runs))))[0].noise
    assert noise.replicate_excess < MAX_REPLICATE_EXCESS
    assert noise.intra_pulse_power_excess < MAX_INTRA_PULSE_POWER_EXCESS


@pytest.mark.parametrize("late", [False, True])
@pytest.mark.parametrize("count", [9, 15, 21, 25, 31])
def test_what_is_kept_of_averaged_signals_does_not_depend_on_how_a_program_continues_them(count, late):
    rng, t_s = np.random.default_rng(count), 1e-3 * np.arange(600)
    values = [120.0 * np.clip((t_s - 0.2) / 0.008, 0.0, 1.0) + rng.standard_normal(600) for _ in range(6)]
    kept, windows = [], ()
    for mode in ("nearest", "constant", "mirror"):
        runs = []
        for number, value in enumerate(values):
            mean = uniform_filter1d(value, count, mode=mode, origin=count // 2 if late else 0)
            signals = {"displacement_m": Signal(0, t_s, mean)}
            runs.append(Run(f"r{number}", AMBIENT_K, np.zeros((0, 4)), signals, {"group": "one"}))
        data = build_dataset(Measurement(tuple(runs)))
        nothing = JitterSensitivity(*2 * [np.zeros(len(data.value))])
        windows = windows or find_windows(compute_contrasts(data, data.value, nothing))
        noise = NoiseModel({1: replace(NOISE, windows=windows)}, 0.0, 0.0, {1: 0.0}, True)
        kept.append(drop_averaged_ends(data, noise))
        assert drop_averaged_ends(data, replace(noise, coloured={1: NOISE})) is data
    assert [len(block.sampled_s) for block in kept[0].blocks] == [600] * 6
    assert 2 * count <= 600 - len(kept[0].blocks[0].t_s) <= 6 * count
    for other in kept[1:]:
        assert other.value == pytest.approx(kept[0].value, abs=1e-9)
