"""Smooth moves for servos that were identified from a recording: light stays on the absorber, or there are none."""

import sys
from pathlib import Path

import numpy as np
import pytest

from hidden_servo import commands
from optodrive.core.types.measurements import Measurement, Run, Signal
from optodrive.device.servo import ServoRange
from optodrive.lab.servo_identification.identify import identify
from optodrive.lab.servo_identification.records import extract_trace
from smooth_judge import TrueServo, follow, judge
from smooth_plans import CODE_RAD, CONFIG, PITCH_RAD, TOLERANCE_RAD, sample_plan

sys.path.append(str(Path(__file__).parents[2] / "scripts"))

import smooth_moves
from smooth_moves import MIN_DWELL_S, SmoothTable, compute_move

SIZES_RAD = (0.005, 0.03, 0.1)
SAMPLE_S = 2e-5
DARK_SAMPLES = (27, 38)
PULSES = 500
LINEAR = TrueServo(1700.0, 0.7, 3e-5, 100.0)
HIDDEN = {
    "linear": (LINEAR, 0.0),
    "another": (TrueServo(1900.0, 0.6, 4.2e-5, 120.0), 0.0),
    "third order": (TrueServo(1700.0, 0.7, 3e-5, 100.0, lag_s=3e-5), 0.0),
    "slow third pole": (TrueServo(1700.0, 0.7, 3e-5, 100.0, lag_s=9e-5), 0.0),
    "friction": (TrueServo(1700.0, 0.7, 3e-5, 100.0, friction=2e4), 0.0),
    "little friction": (TrueServo(1700.0, 0.7, 3e-5, 100.0, friction=5e3), 0.0),
    "coupled": (LINEAR, 0.02),
    "hardly coupled": (LINEAR, 0.002),
}
"""Servo of both mirrors, and the share of the other axis' command that each receives."""


def couple(angles_rad, coupling):
    """Return angles [n, 2] with a share of each other."""
    return angles_rad + coupling * angles_rad[:, ::-1]


def record(servo, coupling, random, noise):
    """Return a recording of steps of both mirrors. noise: relative to the step."""
    runs = []
    for number, size_rad in enumerate(SIZES_RAD):
        table = commands(random, size_rad)
        t_s = np.arange(0.0, table[-1, 0] + 0.015, SAMPLE_S)
        times_s = np.append(table[0, 0], np.repeat(table[1:, 0], 2) - np.tile([1e-9, 0.0], len(table) - 1))
        held_rad = couple(np.concatenate([np.repeat(table[:-1, 1:], 2, axis=0), table[-1:, 1:]]), coupling)
        signals = {}
        for axis, name in enumerate(("mirror_x_rad", "mirror_y_rad")):
            angle_rad = follow(times_s, held_rad[:, axis], t_s, servo)
            signals[name] = Signal(0, t_s, angle_rad + noise * size_rad * random.standard_normal(len(t_s)))
        runs.append(Run(f"run{number}", 295.0, np.zeros((0, 4)), signals, {}, table))
    return Measurement(tuple(runs))


def measure_excursion(name, noise):
    """Return the largest distance of light from its pixel's centre, times the tolerance, None without smooth moves."""
    (servo, coupling), random = HIDDEN[name], np.random.default_rng(3)
    trace = extract_trace("recording.h5", record(servo, coupling, random, noise), 0)
    servos = smooth_moves.find_range(
        identify("recording.h5", trace, CONFIG.scanner.slew_rad_per_s), min(CONFIG.tolerance_rad)
    )
    if servos is None:
        return None
    moves = (
        compute_move(servos, pitches * PITCH_RAD + CODE_RAD, TOLERANCE_RAD, dark_samples)
        for pitches, dark_samples in enumerate(DARK_SAMPLES, 1)
    )
    table = SmoothTable(servos, PITCH_RAD, CODE_RAD, tuple(moves))
    on_s, off_s, places_rad = sample_plan(random, table, PULSES, MIN_DWELL_S)
    times_s, command_rad = table.build_command(off_s[:-1], places_rad[:-1], places_rad[1:])
    # A calibrated field holds what the axes have in common at rest.
    found = judge(times_s, couple(command_rad, coupling), on_s, off_s, couple(places_rad, coupling), [servo] * 2)
    return float((found[0] / CONFIG.tolerance_rad).max())


@pytest.mark.parametrize("name", ["another", "third order"])
def test_light_of_an_identified_servo_stays_on_the_absorber(name):
    assert 0.5 < measure_excursion(name, 0.003) <= 1.0


@pytest.mark.parametrize("name", ["friction", "coupled"])
def test_another_servo_than_the_model_has_no_smooth_moves(name):
    assert measure_excursion(name, 0.003) is None


def test_a_recording_whose_noise_could_hide_an_effect_has_no_smooth_moves():
    assert measure_excursion("friction", 0.01) is None


def test_without_the_check_of_the_noise_light_would_leave_the_absorber(monkeypatch):
    unchecked = lambda found, _tolerance_rad: ServoRange(found.servo, 0.02, 0.02, 0.0, smooth_moves.SAMPLE_S)  # noqa: E731
    monkeypatch.setattr(smooth_moves, "find_range", unchecked)
    assert measure_excursion("friction", 0.01) > 1.0


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.001, 0.003, 0.01])
@pytest.mark.parametrize("name", HIDDEN)
def test_light_of_hidden_servos_stays_on_the_absorber_or_there_are_no_smooth_moves(name, noise):
    excursion = measure_excursion(name, noise)
    assert excursion is None or excursion <= 1.0
