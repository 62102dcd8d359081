"""Filters of what instruments record, against scipy's and against closed forms."""

import numpy as np
import pytest
from scipy.ndimage import uniform_filter1d
from scipy.signal import butter, cont2discrete, filtfilt, lfilter

from optodrive.physics.term import RecordedRun
from optodrive.physics.terms import discover_terms
from optodrive.physics.terms.sensor import low_pass, low_pass_both_ways, mean_of_samples, moving_mean

T_S = np.arange(0.0, 0.5, 1e-3)
SIGNAL = np.where(T_S > 0.1, 1.0 - np.exp(-(T_S - 0.1) / 0.03), 0.0)


def test_a_low_pass_answers_a_ramp_exactly_at_any_times():
    t_s = np.sort(np.random.default_rng(0).uniform(0.0, 0.5, 200))
    t_s[0] = 0.0
    expected = t_s - 0.02 * (1.0 - np.exp(-t_s / 0.02))
    assert low_pass(t_s, t_s, 0.02) == pytest.approx(expected, abs=1e-12)


def test_a_high_pass_is_that_of_a_circuit():
    cutoff_hz = 1.0
    b, a, _ = cont2discrete(([1.0, 0.0], [1.0, 2 * np.pi * cutoff_hz]), 1e-3, "foh")
    values = dict.fromkeys(("temperature", "displacement", "force"), 0.0) | {"displacement": cutoff_hz}
    term = discover_terms()["high_pass"]
    assert term.record(values, "displacement", T_S, SIGNAL, RecordedRun()) == pytest.approx(
        lfilter(b[0], a, SIGNAL), abs=1e-9
    )
    assert term.record(values, "temperature", T_S, SIGNAL, RecordedRun()) is SIGNAL


def test_smoothing_is_a_moving_mean():
    term, width_s = discover_terms()["smoothing"], 0.015
    values = {"temperature": 0.0, "displacement": width_s, "force": 0.0, "order": 0.0, "late": 0.0, "by_samples": 0.0}
    mean = np.convolve(SIGNAL, np.ones(15) / 15, "same")
    inside = slice(20, -20)
    assert term.record(values, "displacement", T_S, SIGNAL, RecordedRun())[inside] == pytest.approx(
        mean[inside], abs=4e-4
    )
    assert low_pass_both_ways(T_S, SIGNAL, 1e-7) == pytest.approx(SIGNAL, abs=1e-4)


@pytest.mark.parametrize("order", [1, 2, 3, 4])
def test_smoothing_is_a_filter_run_both_ways(order):
    cutoff_hz = 40.0
    expected = filtfilt(*butter(order, cutoff_hz, fs=1e3), SIGNAL)
    forms = {"displacement": np.sqrt(24.0) / (2.0 * np.pi * cutoff_hz), "order": order, "late": 0.0, "by_samples": 0.0}
    smooth = discover_terms()["smoothing"].record(forms, "displacement", T_S, SIGNAL, RecordedRun())
    assert smooth[:-60] == pytest.approx(expected[:-60], abs=1e-3)


@pytest.mark.parametrize("interval_s", [1e-3, 4e-3])
def test_a_mean_of_samples_is_as_wide_as_its_samples_and_late_if_of_past_ones(interval_s):
    t_s = np.arange(0.0, 0.5, interval_s)
    signal = np.sin(5.0 * t_s)
    forms = {"order": 0.0, "late": 0.0, "by_samples": 1.0}
    values = {"temperature": 0.0, "displacement": 0.015, "force": 0.0} | forms
    mean = np.convolve(signal, np.ones(15) / 15, "valid")
    term, inside = discover_terms()["smoothing"], slice(20, -20)
    centred = term.record(values, "displacement", t_s, signal, RecordedRun())
    assert centred[inside] == pytest.approx(mean[13 : 13 + len(t_s) - 40], abs=4e-4)
    past = term.record(values | {"late": 7.0 / 15.0}, "displacement", t_s, signal, RecordedRun())
    assert past[inside] == pytest.approx(centred[13 : 13 + len(t_s) - 40], abs=4e-4)
    assert np.isfinite(past).all()


@pytest.mark.parametrize(("count", "late"), [(7, 0), (15, 0), (15, 7), (29, 14)])
def test_a_mean_of_samples_is_a_programs_exactly_with_missing_samples_on_a_line(count, late):
    there = np.delete(np.arange(len(T_S)), [40, 101, 102, 103, 104, 105, 106, 250])
    whole = np.interp(T_S, T_S[there], SIGNAL[there])
    expected = uniform_filter1d(whole, count, origin=late)[there]
    inside = slice(count, -count)
    mean = mean_of_samples(T_S[there], SIGNAL[there], count, late)
    assert mean[inside] == pytest.approx(expected[inside], abs=1e-12)
    assert mean_of_samples(T_S[there], SIGNAL[there], 1.0) == pytest.approx(SIGNAL[there], abs=1e-12)


def test_a_moving_mean_of_what_is_linear_is_itself():
    t_s = np.sort(np.random.default_rng(1).uniform(0.0, 1.0, 300))
    inside = (t_s > t_s[0] + 0.05) & (t_s < t_s[-1] - 0.05)
    assert moving_mean(t_s, 3.0 * t_s, 0.1)[inside] == pytest.approx(3.0 * t_s[inside], abs=1e-9)
