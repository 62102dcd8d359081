"""Identification recovers ground-truth servos from noisy traces of an independent integrator, and names errors."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hidden_servo import SIZES_RAD, HiddenServo, commands, recording
from optodrive.core.errors import InputError
from optodrive.core.types.measurements import Measurement, Signal
from optodrive.device.config_file import load_config
from optodrive.device.servo import Servo
from optodrive.lab.servo_identification.identify import Steps, identify, step_response_rad
from optodrive.lab.servo_identification.records import extract_trace

CONFIG = load_config()
ONE, OTHER = HiddenServo(900.0, 0.6, 4e-5, 90.0), HiddenServo(1400.0, 0.45, 2e-5, 120.0)


@pytest.fixture(scope="module")
def measured():
    return recording((ONE, OTHER), np.random.default_rng(1))


def found(measurement, axis):
    return identify("r.h5", extract_trace("r.h5", measurement, axis), CONFIG.scanner.slew_rad_per_s)


def altered(measurement, change):
    return Measurement(tuple(change(run) for run in measurement.runs))


@settings(max_examples=3 * settings.default.max_examples // 20, deadline=None)
@given(st.floats(300, 3000), st.floats(0.3, 0.99), st.floats(0, 1e-4), st.floats(30, 300), st.integers(0, 99))
def test_the_closed_form_is_what_integration_gives_also_where_steps_overlap(hz, damping, delay_s, slew, seed):
    random = np.random.default_rng(seed)
    at_s = np.cumsum(random.uniform(1e-4, 4e-3, 8))
    command_rad = random.uniform(-0.1, 0.1, 8)
    t_s = np.linspace(0.0, at_s[-1] + 5e-3, 300)
    reported = step_response_rad(Servo(hz, damping, delay_s, slew), Steps(at_s, command_rad), t_s)
    assert reported == pytest.approx(HiddenServo(hz, damping, delay_s, slew).follow(at_s, command_rad, t_s), abs=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(900, 912))
def test_hidden_servos_are_found_on_both_axes(seed):
    random = np.random.default_rng(seed)
    servos = HiddenServo.sample(random), HiddenServo.sample(random)
    rate_hz, noise = (float(np.exp(random.uniform(*np.log(ends)))) for ends in ((1e4, 1e5), (1e-3, 1e-2)))
    measurement = recording(servos, random, rate_hz, noise)
    for axis, servo in enumerate(servos):
        reported = found(measurement, axis)
        assert reported.servo.delay == pytest.approx(servo.delay_s, abs=1e-5)
        assert reported.servo.frequency == pytest.approx(servo.hz, rel=0.03)
        assert reported.slew_identified
        assert reported.servo.slew == pytest.approx(servo.slew, rel=0.03)
        assert 0.7 < reported.misfit < 1.4
        for step_rad in SIZES_RAD:
            for tolerance_rad in (CONFIG.tolerance_rad[axis], 0.02 * step_rad):
                # The time is discontinuous where an overshoot touches the tolerance; neighbours are equally valid.
                ends_s = [servo.settled_s(step_rad, near * tolerance_rad) for near in (0.98, 1.0, 1.02)]
                reported_s = reported.settling_s(step_rad, tolerance_rad)[0]
                assert 0.95 * min(ends_s) < reported_s < 1.05 * max(ends_s)


@pytest.mark.slow
def test_intervals_hold_the_truth_about_as_often_as_they_say():
    within = []
    for seed in range(10):
        reported = found(recording((ONE, OTHER), np.random.default_rng(seed), 2e4, 0.01), 0)
        off = np.abs([np.log(reported.servo.frequency / ONE.hz), reported.servo.damping - ONE.damping])
        within += list(off < 1.96 * reported.sigma[:2])
    assert sum(within) >= 15  # of 20, nineteen expected


def test_without_a_large_step_the_slew_is_kept_as_configured_and_the_rest_is_found():
    random = np.random.default_rng(4)
    reported = found(recording((HiddenServo(1500.0, 0.7, 3e-5, 100.0), OTHER), random, 1e5, 0.01, (2e-4,)), 0)
    assert not reported.slew_identified
    assert reported.servo.slew == pytest.approx(CONFIG.scanner.slew_rad_per_s)
    assert reported.servo.delay == pytest.approx(3e-5, abs=1e-5)


def test_missing_samples_and_a_position_output_with_an_offset_do_no_harm(measured):
    def spoil(run):
        signal = run.signals["mirror_x_rad"]
        value = 1.02 * signal.value + 0.01
        value[::7] = np.nan
        return replace(run, signals=run.signals | {"mirror_x_rad": Signal(0, signal.t_s.copy(), value)})

    reported = found(altered(measured, spoil), 0)
    assert reported.servo.frequency == pytest.approx(ONE.hz, rel=0.01)
    assert reported.gain == pytest.approx(1.02, abs=1e-3)
    assert reported.offset_rad == pytest.approx(0.01, abs=1e-4)


def test_no_mirror_signal_is_named(measured):
    bare = altered(measured, lambda run: replace(run, signals={"mirror_y_rad": run.signals["mirror_y_rad"]}))
    with pytest.raises(InputError, match=r"r\.h5: mirror_x_rad: missing, expected a run with this signal"):
        found(bare, 0)


def test_too_few_steps_are_counted(measured):
    few = altered(measured, lambda run: replace(run, commands=run.commands[:2].copy()))
    with pytest.raises(InputError, match="1 steps of x in commands', expected at least 3"):
        found(Measurement(few.runs[:1]), 0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda x, y: (y, x), "axes exchanged"),
        (lambda x, y: (-x, y), "axis inverted"),
        (lambda x, y: (1e-6 * np.sin(np.arange(len(x))), y), "it is stuck"),
        (lambda x, y: (np.degrees(x), y), "degrees"),
        (lambda x, y: (2.0 * x, y), "optical angles"),
    ],
)
def test_what_is_wrong_with_a_mirror_is_named(measured, change, words):
    def wrong(run):
        x, y = (run.signals[f"mirror_{axis}_rad"] for axis in "xy")
        values = change(x.value, y.value)
        signals = {
            f"mirror_{axis}_rad": Signal(0, x.t_s.copy(), value.copy())
            for axis, value in zip("xy", values, strict=True)
        }
        return replace(run, signals=signals)

    with pytest.raises(InputError, match=words):
        found(altered(measured, wrong), 0)


def test_sampling_too_coarse_is_named():
    coarse = recording((HiddenServo(2500.0, 0.6, 4e-5, 200.0), OTHER), np.random.default_rng(5), 1.5e3)
    with pytest.raises(InputError, match="the sampling is too coarse"):
        found(coarse, 0)


def test_commands_are_steps_of_both_axes():
    table = commands(np.random.default_rng(0), 0.1)
    assert np.count_nonzero(np.diff(table[:, 1])) > np.count_nonzero(np.diff(table[:, 2])) > 3
