"""Faults of instruments of many sizes and places are found and left out; of a clean recording nothing is."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from labs import lab
from optodrive.core.errors import InputError
from optodrive.core.types.measurements import Measurement, Signal
from optodrive.lab.inspection.inspection import inspect_recording

HEIGHT, HEAT = "displacement_m", "absorber_temperature_K"
EXAMPLES = settings(max_examples=6, deadline=None, suppress_health_check=[HealthCheck.too_slow])


@cache
def build_clean(seed=1, rate=1000.0, noise=1.0):
    return lab(seed, {}, rate=rate, noise=noise)


def change(measurement, name, function, runs=None):
    """Return the recording with `function(t_s, value)` in place of a signal's values, or of its times and values."""
    out = []
    for number, run in enumerate(measurement.runs):
        signals = dict(run.signals)
        if runs is None or number in runs:
            signal = signals[name]
            new = function(signal.t_s, signal.value.copy())
            t_s, value = new if isinstance(new, tuple) else (signal.t_s, new)
            signals[name] = Signal(signal.pixel, t_s, value, signal.sigma)
        out.append(replace(run, signals=signals))
    return Measurement(tuple(out))


def find(measurement, use=()):
    """Return kinds and actions of what is not merely a fact, and the inspection."""
    inspection = inspect_recording(measurement, use)
    assert inspection.failures == ()
    return {item.kind for item in inspection.findings if item.action != "noted"}, inspection


def list_missing(before, after, name):
    """Return run number and sample of what was left out."""
    out = []
    for number, (old, new) in enumerate(zip(before.runs, after.runs, strict=True)):
        lost = np.isfinite(old.signals[name].value) & ~np.isfinite(new.signals[name].value)
        out += [(number, int(row)) for row in np.flatnonzero(lost)]
    return out


@pytest.mark.parametrize("rate", [500.0, 2000.0])
@pytest.mark.parametrize("noise", [0.0, 0.3, 3.0])
def test_of_a_clean_recording_nothing_is_left_out(rate, noise):
    assert find(build_clean(3, rate, noise))[0] == set()


@pytest.mark.parametrize("quantum", [0.1, 1.0, 4.0])
@pytest.mark.parametrize("noise", [0.0, 0.2, 1.0])
def test_a_converters_steps_are_noted_and_nothing_is_left_out(quantum, noise):
    step_m = quantum * 2e-6
    measurement = change(build_clean(4, 1000.0, noise), HEIGHT, lambda _, value: step_m * np.round(value / step_m))
    kinds, inspection = find(measurement)
    assert kinds == set()
    (noted,) = (item for item in inspection.findings if item.kind == "noise" and item.signal == HEIGHT)
    assert noted.numbers["resolution"][0] == pytest.approx(step_m)


@EXAMPLES
@given(
    seed=st.integers(0, 10**6),
    size=st.floats(25.0, 1e4),
    width=st.integers(1, 3),
    count=st.integers(1, 5),
    name=st.sampled_from([HEIGHT, HEAT]),
)
@example(seed=8679, size=4195.0, width=3, count=5, name=HEAT)
def test_outliers_are_left_out_and_nothing_else(seed, size, width, count, name):
    clean, rng = build_clean(), np.random.default_rng(seed)
    sigma = {HEIGHT: 2e-6, HEAT: 0.3}[name]
    hit = {}
    for run in (3 * rng.choice(5, count, replace=False) + rng.integers(0, 3, count)).tolist():  # one of the repeats
        value = clean.runs[run].signals[name].value
        first = int(rng.integers(12, len(value) - 16))
        if np.isfinite(value[first - 8 : first + 12]).all():
            hit[run] = range(first, first + width)

    def add(run):
        def change_values(t_s, value):
            value[list(hit[run])] += rng.choice([-1.0, 1.0]) * size * sigma
            return value

        return change_values

    measurement = clean
    for run in hit:
        measurement = change(measurement, name, add(run), {run})
    kinds, inspection = find(measurement)
    expected = [(run, row) for run in sorted(hit) for row in hit[run]]
    lost = list_missing(measurement, inspection.measurement, name)
    assert set(lost) == set(expected)
    assert kinds == ({"outlier"} if expected else set())
    assert list_missing(measurement, find(measurement, ["outlier"])[1].measurement, name) == []


@pytest.mark.parametrize("row", [0, 1, 4, -5, -2, -1])
@pytest.mark.parametrize(("name", "sigma"), [(HEIGHT, 2e-6), (HEAT, 0.3)])
def test_an_outlier_near_an_end_is_left_out_with_at_most_the_samples_beside_it(row, name, sigma):
    clean = build_clean()
    count = len(clean.runs[6].signals[name].value)

    def add(_, value):
        value[row] = np.nanmedian(value[:8] if row >= 0 else value[-8:]) + 25.0 * sigma
        return value

    lost = list_missing(clean, find(change(clean, name, add, {6}))[1].measurement, name)
    assert (6, row % count) in lost
    assert all(run == 6 and abs(other - row % count) <= 5 for run, other in lost)


def test_a_glitch_that_repeats_share_is_no_outlier():
    clean = build_clean()

    def add(t_s, value):
        value[40] += 1e-4
        return value

    group = [number for number, run in enumerate(clean.runs) if run.attributes["group"] == "strong"]
    assert find(change(clean, HEIGHT, add, group))[0] == set()


@EXAMPLES
@given(share=st.floats(0.5, 0.95), quantum=st.sampled_from([0.0, 1e-7, 1e-6]), noise=st.sampled_from([0.05, 1.0]))
@example(share=0.94, quantum=1e-6, noise=0.05)
@example(share=0.95, quantum=1e-6, noise=0.05)
def test_a_ceiling_is_left_out_with_what_is_near(share, quantum, noise):
    clean = build_clean(5, 1000.0, noise)
    top = max(float(np.nanmax(run.signals[HEIGHT].value)) for run in clean.runs)
    ceiling = share * top

    def clip(_, value):
        value = np.minimum(value, ceiling)
        return quantum * np.round(value / quantum) if quantum else value

    kinds, inspection = find(change(clean, HEIGHT, clip))
    assert kinds == {"clipped"}
    (found,) = inspection.omitted
    assert found.numbers["highest"][0] == pytest.approx(ceiling, abs=max(quantum, 1e-12))
    for old, new in zip(clean.runs, inspection.measurement.runs, strict=True):
        kept = np.isfinite(new.signals[HEIGHT].value)
        assert np.nanmax(old.signals[HEIGHT].value[kept]) < ceiling
        far = old.signals[HEIGHT].value < ceiling - 12.0 * 2e-6 * noise - 3.0 * quantum - 0.02 * top
        assert (kept & far).sum() > 0.9 * (far & np.isfinite(old.signals[HEIGHT].value)).sum()


def test_a_clipped_signal_that_is_used_all_the_same_stays_whole():
    clean = build_clean(5)
    ceiling = 0.7 * max(float(np.nanmax(run.signals[HEIGHT].value)) for run in clean.runs)
    clipped = change(clean, HEIGHT, lambda _, value: np.minimum(value, ceiling))
    assert list_missing(clipped, find(clipped)[1].measurement, HEIGHT)
    assert list_missing(clipped, find(clipped, ["clipped"])[1].measurement, HEIGHT) == []


@pytest.mark.parametrize(("share", "side", "width"), [(0.6, 1.0, 0.05), (0.85, 1.0, 0.0), (0.3, -1.0, 0.0)])
@pytest.mark.parametrize("name", [HEIGHT, HEAT])
def test_a_sensor_that_saturates_before_the_noise_is_left_out_there(name, share, side, width):
    clean, rng = build_clean(5, 1000.0, 0.0), np.random.default_rng(8)
    values = np.concatenate([run.signals[name].value for run in clean.runs])
    range_, sigma = float(np.nanmax(values) - np.nanmin(values)), {HEIGHT: 2e-6, HEAT: 0.3}[name]
    level = float(np.nanmin(values)) + share * range_

    def saturate(_, value):
        over = side * (value - level)
        over = -width * range_ * np.logaddexp(0.0, -over / (width * range_)) if width else np.minimum(over, 0.0)
        return level + side * over + sigma * rng.standard_normal(len(value))

    kinds, inspection = find(change(clean, name, saturate))
    assert kinds == {"clipped"}
    kept_far, far = 0, 0
    for old, new in zip(clean.runs, inspection.measurement.runs, strict=True):
        kept = np.isfinite(new.signals[name].value)
        true = side * (old.signals[name].value - level)
        assert np.all(true[kept] < 0.02 * range_)
        is_far = true < -0.25 * range_
        kept_far, far = kept_far + int((kept & is_far).sum()), far + int(is_far.sum())
    assert kept_far > 0.9 * far > 0


@pytest.mark.parametrize("share", [0.05, 0.2])
def test_a_slack_membrane_is_no_floor_of_its_sensor(share):
    clean, rng = build_clean(5, 1000.0, 0.0), np.random.default_rng(8)
    slack = share * max(np.nanmax(run.signals[HEIGHT].value) for run in clean.runs)

    def loosen(_, value):
        return np.maximum(value - slack, 0.0) + 2e-6 * rng.standard_normal(len(value))

    assert "clipped" not in find(change(clean, HEIGHT, loosen))[0]


@pytest.mark.parametrize("tau_s", [0.004, 0.02])
def test_what_settles_is_no_ceiling(tau_s):
    """Long pulses end in equal samples, exact or in steps of a converter; a settled membrane is none either."""
    runs = []
    for run in lab(1, {}, groups=("weak", "strong"), noise=0.0).runs:
        t_s = np.arange(4000) / 1000.0
        signals = {
            name: Signal(
                0,
                t_s,
                scale
                * run.pulses[0, 2]
                * np.where(
                    t_s < 0.02,
                    0.0,
                    np.where(
                        t_s < 3.0,
                        -np.expm1(-np.maximum(t_s - 0.02, 0.0) / tau_s),
                        np.exp(-np.maximum(t_s - 3.0, 0.0) / tau_s),
                    ),
                ),
            )
            for name, scale in ((HEIGHT, 1e-4), (HEAT, 100.0))
        }
        signals[HEAT] = replace(signals[HEAT], value=signals[HEAT].value + 293.15)
        pulses = run.pulses.copy()
        pulses[0, :2] = 0.02, 2.98
        runs.append(replace(run, signals=signals, pulses=pulses))
    for step_m in (0.0, 1e-7, 1e-6, 2e-6):
        measurement = change(
            Measurement(tuple(runs)), HEIGHT, lambda _, value, q=step_m: q * np.round(value / q) if q else value
        )
        assert find(measurement)[0] == set()


@pytest.mark.parametrize("start", [0, 3, 7])
@pytest.mark.parametrize("period", [2, 5, 10, 25])
def test_held_samples_leave_the_fresh_ones(period, start):
    clean = lab(6, {}, rate=1000.0, groups=("weak", "middle", "strong"))
    fresh = {}

    def hold(t_s, value):
        finite = np.isfinite(value)
        value = np.interp(t_s, t_s[finite], value[finite])
        rows = np.maximum((np.arange(len(value)) - start) // period * period + start, 0)
        fresh[len(fresh)] = rows == np.arange(len(value))
        return value[rows]

    measurement = change(clean, HEAT, hold)
    kinds, inspection = find(measurement)
    assert kinds == {"held"}
    for number, (old, new) in enumerate(zip(clean.runs, inspection.measurement.runs, strict=True)):
        own_s = old.signals[HEAT].t_s[fresh[number]]
        assert np.isin(new.signals[HEAT].t_s, own_s).all()
        assert len(new.signals[HEAT].t_s) >= len(own_s) - 1


@pytest.mark.parametrize("phase", [0.0, 0.37])
@pytest.mark.parametrize("period_s", [0.005, 0.01, 0.02])
@pytest.mark.parametrize("kind", ["float64", "float32"])
def test_interpolated_samples_leave_the_points_between_which_they_lie(period_s, phase, kind):
    clean = lab(7, {}, rate=2000.0, groups=("weak", "middle", "strong"))
    points = {}

    def interpolate(t_s, value):
        finite = np.isfinite(value)
        every_s = np.arange(phase * period_s, t_s[-1] + period_s, period_s)
        known = np.interp(every_s, t_s[finite], value[finite])
        points[len(points)] = every_s, known
        return np.interp(t_s, every_s, known).astype(kind).astype(np.float64)

    kinds, inspection = find(change(clean, HEAT, interpolate))
    assert kinds == {"interpolated"}
    for number, run in enumerate(inspection.measurement.runs):
        signal, (every_s, known) = run.signals[HEAT], points[number]
        rows = np.argmin(np.abs(every_s[:, None] - signal.t_s), axis=0)
        assert len(signal.t_s) > 0.85 * (signal.t_s[-1] - signal.t_s[0]) / period_s
        assert np.abs(every_s[rows] - signal.t_s).max() < 2e-5
        assert np.abs(known[rows] - signal.value).max() < 0.02


@pytest.mark.parametrize("kind", ["held", "interpolated"])
def test_a_slower_channel_is_slow_in_runs_too_short_to_show_it(kind):
    clean = lab(7, {}, rate=2000.0, groups=("weak", "middle", "strong"))

    def slow(t_s, value):
        finite = np.isfinite(value)
        every_s = np.arange(t_s[0] - 0.005, t_s[-1] + 0.02, 1.0 / 60.0)
        known = np.interp(every_s, t_s[finite], value[finite])
        return np.interp(t_s, every_s, known) if kind == "interpolated" else known[np.searchsorted(every_s, t_s) - 1]

    measurement = change(change(clean, HEAT, slow), HEAT, lambda t_s, value: (t_s[:140], value[:140]), (2,))
    kinds, inspection = find(measurement)
    assert kinds == {kind}
    # Of 70 ms at 60 Hz.
    assert 3 <= len(inspection.measurement.runs[2].signals[HEAT].t_s) <= 5


@EXAMPLES
@given(
    marker=st.sampled_from([-9999.0, 9999.0, 0.0, 9.9e37, -1.0, 1e30, 3.4028234663852886e38, 65535.0]),
    seed=st.integers(0, 100),
    share=st.floats(0.005, 0.2),
)
def test_sentinels_are_left_out(marker, seed, share):
    rng = np.random.default_rng(seed)

    def lose(_, value):
        lost = rng.random(len(value)) < share
        lost[[30, 50]] = True
        value[lost] = marker
        return value

    measurement = change(build_clean(), HEAT, lose, {2, 3})
    kinds, inspection = find(measurement)
    assert "sentinel" in kinds
    for run in inspection.measurement.runs:
        assert np.nanmin(run.signals[HEAT].value) > 200.0
        assert np.nanmax(run.signals[HEAT].value) < 1000.0
    inspection.check()


def test_a_possible_value_is_a_sentinel_only_far_from_the_signal():
    def lose(_, value):
        value[::40] = 999.0
        return value

    kinds, _ = find(change(build_clean(), HEAT, lose, {4}))
    assert kinds == {"sentinel"}


@pytest.mark.parametrize("runs", [{3}, {0, 7}, {9, 10, 11}])
@pytest.mark.parametrize("level", [0.0, 2e-6])
@pytest.mark.parametrize("name", [HEIGHT, HEAT])
def test_a_dead_signal_is_left_out_of_its_runs(runs, level, name):
    rng, scale = np.random.default_rng(1), {HEIGHT: 1.0, HEAT: 1e5}[name]
    rest = {HEIGHT: 1e-5, HEAT: 293.15}[name]

    def silence(t_s, value):
        return rest + level * scale * rng.standard_normal(len(t_s))

    kinds, inspection = find(change(build_clean(), name, silence, runs))
    assert kinds == {"dead"}
    assert {n for n, run in enumerate(inspection.measurement.runs) if name not in run.signals} == runs


@pytest.mark.parametrize("name", [HEIGHT, HEAT])
def test_a_loud_run_is_left_out(name):
    rng, sigma = np.random.default_rng(3), {HEIGHT: 2e-6, HEAT: 0.3}[name]

    def add(t_s, value):
        return value + 10.0 * sigma * rng.standard_normal(len(t_s))

    kinds, inspection = find(change(build_clean(), name, add, {5}))
    assert kinds == {"noisy"}
    assert {n for n, run in enumerate(inspection.measurement.runs) if name not in run.signals} == {5}


@pytest.mark.parametrize(("run", "first", "lost"), [(4, 40, 5), (7, 5, 5), (10, 60, 15), (13, 300, 12)])
def test_a_run_that_lost_samples_is_left_out(run, first, lost):
    def lose(t_s, value):
        return t_s[:-lost], np.delete(value, np.s_[first : first + lost])

    kinds, inspection = find(change(build_clean(), HEIGHT, lose, {run}))
    assert kinds == {"lost"}
    assert {n for n, item in enumerate(inspection.measurement.runs) if HEIGHT not in item.signals} == {run}


def test_a_trigger_that_two_signals_show_is_off_for_all_signals_of_the_run():
    rng, runs = np.random.default_rng(4), []
    for number, run in enumerate(build_clean().runs):
        height = run.signals[HEIGHT]
        noisy = replace(height, value=57.0 * height.value + 0.02 * rng.standard_normal(len(height.t_s)))
        late_s = -0.038 if number == 13 else 0.0  # more than half a period of the train
        signals = {name: replace(s, t_s=s.t_s + late_s) for name, s in (run.signals | {"force_N": noisy}).items()}
        runs.append(replace(run, signals=signals))
    kinds, inspection = find(Measurement(tuple(runs)))
    assert kinds == {"lost"}
    assert not inspection.measurement.runs[13].signals


def test_drift_within_runs_and_a_high_pass_are_stated():
    rng = np.random.default_rng(5)

    def drift(t_s, value):
        return value + 1e-5 * rng.standard_normal() * t_s / t_s[-1]

    def pass_high(t_s, value):  # 2 Hz
        filled = np.interp(t_s, t_s[np.isfinite(value)], value[np.isfinite(value)])
        slow = np.zeros(len(value))
        for row in range(1, len(value)):
            slow[row] = slow[row - 1] + 2.0 * np.pi * 2.0 * (t_s[row] - t_s[row - 1]) * (filled[row] - slow[row - 1])
        return np.where(np.isfinite(value), filled - slow, np.nan)

    clean = build_clean()
    changed = {"": clean, "drift": change(clean, HEIGHT, drift), "high-pass": change(clean, HEIGHT, pass_high)}
    for word, measurement in changed.items():
        kinds, inspection = find(measurement)
        assert kinds == set()
        (noted,) = (item for item in inspection.findings if item.kind == "noise" and item.signal == HEIGHT)
        assert [known for known in ("drift", "high-pass") if known in noted.text] == [word] * bool(word)


def test_a_run_beside_one_with_a_gap_has_lost_nothing():
    def lose(t_s, value):
        kept = np.ones(len(t_s), dtype=bool)
        kept[30:90] = False
        return t_s[kept], value[kept]

    assert find(change(build_clean(), HEAT, lose, {6}))[0] == set()


@pytest.mark.parametrize(("run", "gain"), [(4, 0.9), (9, 1.1)])
@pytest.mark.parametrize("name", [HEIGHT, HEAT])
def test_a_run_of_another_gain_is_left_out(name, run, gain):
    rest = {HEIGHT: 0.0, HEAT: 293.15}[name]
    measurement = change(build_clean(), name, lambda _, value: rest + gain * (value - rest), {run})
    kinds, inspection = find(measurement)
    assert kinds == {"gain"}
    assert {n for n, item in enumerate(inspection.measurement.runs) if name not in item.signals} == {run}


def test_what_changes_in_order_of_time_is_no_gain():
    runs = [
        replace(run, signals={HEIGHT: replace(run.signals[HEIGHT], value=run.signals[HEIGHT].value * (1.0 - 0.02 * n))})
        for n, run in enumerate(build_clean().runs)
    ]
    assert find(Measurement(tuple(runs)))[0] == set()


def test_a_signal_that_responds_in_no_run_is_left_out():
    rng = np.random.default_rng(2)
    kinds, inspection = find(change(build_clean(), HEIGHT, lambda t_s, _: 2e-6 * rng.standard_normal(len(t_s))))
    assert kinds == {"dead"}
    assert all(HEIGHT not in run.signals for run in inspection.measurement.runs)


def test_stuck_samples_are_left_out():
    def stick(_, value):
        value[60:120] = value[60]
        return value

    measurement = change(build_clean(), HEIGHT, stick, {6})
    kinds, inspection = find(measurement)
    assert kinds == {"stuck"}
    assert {row for run, row in list_missing(measurement, inspection.measurement, HEIGHT)} >= set(range(61, 119))


def test_a_turned_sign_is_left_out_with_its_remedy():
    kinds, inspection = find(change(build_clean(), HEIGHT, lambda _, value: -value))
    assert kinds == {"sign"}
    assert "multiply it by −1" in inspection.omitted[0].text


@pytest.mark.parametrize("shift_s", [-0.02, 0.008, 0.05])
def test_a_trigger_that_is_off_is_told(shift_s):
    def shift(t_s, value):
        return t_s + shift_s, value

    one = change(change(build_clean(), HEIGHT, shift, {6}), HEAT, shift, {6})
    kinds, inspection = find(one)
    assert kinds == {"trigger"}
    assert not inspection.measurement.runs[6].signals
    every = change(change(build_clean(), HEIGHT, shift), HEAT, shift)
    kinds, inspection = find(every)
    assert kinds == {"trigger"}
    with pytest.raises(InputError, match="correct t_s or start_s"):
        inspection.check()


@pytest.mark.parametrize(("one", "other"), [(3, 9), (0, 12), (6, 10), (2, 7)])
@pytest.mark.parametrize("names", [[HEIGHT], [HEIGHT, HEAT]])
def test_exchanged_files_are_named(one, other, names):
    runs = list(build_clean().runs)
    first, second = runs[one], runs[other]
    for name in names:
        a, b = first.signals[name], second.signals[name]
        runs[one] = replace(runs[one], signals={**runs[one].signals, name: b})
        runs[other] = replace(runs[other], signals={**runs[other].signals, name: a})
    kinds, inspection = find(Measurement(tuple(runs)))
    assert kinds == {"exchanged"}
    assert {run for item in inspection.omitted for run in item.runs} == {first.name, second.name}


def test_a_step_that_fails_takes_nothing_along(monkeypatch):
    def fail(t_s, value):
        raise ZeroDivisionError("no")

    monkeypatch.setattr("optodrive.lab.inspection.inspection.find_hold", fail)
    inspection = inspect_recording(change(build_clean(), HEIGHT, lambda _, value: -value))
    assert [item.partition(":")[0] for item in inspection.failures] == [f"held of {name}" for name in (HEAT, HEIGHT)]
    assert {item.kind for item in inspection.omitted} == {"sign"}


def test_nothing_left_is_refused():
    measurement = Measurement(
        tuple(
            replace(run, signals={HEIGHT: replace(run.signals[HEIGHT], value=-run.signals[HEIGHT].value)})
            for run in build_clean().runs
        )
    )
    with pytest.raises(InputError, match="multiply it by"):
        inspect_recording(measurement).check()
