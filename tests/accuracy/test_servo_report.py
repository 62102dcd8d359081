"""Remarks on mirrors outside the configuration's range or the servo model."""

from dataclasses import replace

import numpy as np
import pytest

from hidden_servo import HiddenServo, recording
from optodrive.core.types.measurements import Measurement, Signal
from optodrive.device.config_file import load_config
from optodrive.lab.servo_identification.effect_fit import find_effect
from optodrive.lab.servo_identification.gate import DAMPING_MAX, assess, find_common_servo
from optodrive.lab.servo_identification.identify import identify
from optodrive.lab.servo_identification.records import extract_records, extract_trace
from optodrive.lab.servo_identification.report import build_report, format_report_lines

CONFIG = load_config()
SLOW, QUICK = HiddenServo(700.0, 0.99, 6e-5, 90.0), HiddenServo(1500.0, 0.6, 2e-5, 90.0)


def reported(measurement):
    slew = CONFIG.scanner.slew_rad_per_s
    mirrors = tuple(identify("r.h5", extract_trace("r.h5", measurement, axis), slew) for axis in range(2))
    common = find_common_servo(mirrors, CONFIG)
    effects = tuple(
        assess(
            find_effect(extract_records("r.h5", measurement, axis), 2.0 * np.pi * mirror.servo.frequency),
            mirror.residual_rad,
            CONFIG,
            axis,
        )
        for axis, mirror in enumerate(mirrors)
    )
    return build_report(mirrors, common, CONFIG, effects), common


@pytest.fixture(scope="module")
def unlike():
    return recording((SLOW, QUICK), np.random.default_rng(7))


def test_a_mirror_damped_critically_is_said_and_planned_slower_by_what_may_be_stated(unlike):
    found, common = reported(unlike)
    assert any(remark.startswith("x: critically damped") for remark in found["remarks"])
    assert common.servo.damping <= DAMPING_MAX
    assert common.servo.frequency < SLOW.hz
    assert common.settling_excess[1] > common.settling_excess[0] >= -0.005


@pytest.mark.slow
def test_the_quicker_mirrors_acceleration_lowers_the_galvo_cap(unlike):
    found, common = reported(unlike)
    assert common.galvo_share < 0.8
    assert any("the galvo cap is multiplied by" in line for line in format_report_lines(found))


@pytest.mark.slow
def test_a_mirror_that_does_more_than_a_servo_is_said(unlike):
    def ringing(run):
        signal = run.signals["mirror_y_rad"]
        size_rad = np.ptp(signal.value)
        value = signal.value + 0.02 * size_rad * np.sin(2 * np.pi * 180.0 * signal.t_s)
        return replace(run, signals=run.signals | {"mirror_y_rad": Signal(0, signal.t_s.copy(), value)})

    found, _ = reported(Measurement(tuple(ringing(run) for run in unlike.runs)))
    assert any(remark.startswith("y: the residual is") for remark in found["remarks"])


@pytest.mark.slow
def test_small_steps_say_that_the_slew_cannot_be_told():
    small = recording((SLOW, QUICK), np.random.default_rng(8), 1e5, 0.01, (2e-4,))
    found, common = reported(small)
    assert sum("the slew is not identified" in remark for remark in found["remarks"]) == 2
    assert common.servo.slew == pytest.approx(CONFIG.scanner.slew_rad_per_s)
    assert any("slew not identified" in line for line in format_report_lines(found))
