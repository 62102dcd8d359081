"""Smooth moves keep the light on the absorbers of every servo within the declared uncertainty."""

import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from displays import DISPLAYS
from optodrive.core.errors import InputError
from optodrive.device.gate_timing import build_servo
from smooth_judge import TrueServo, judge

sys.path.append(str(Path(__file__).parents[2] / "scripts"))

import smooth_moves
from smooth_moves import MIN_DWELL_S, ServoRange, SmoothTable, compute_move

CONFIG = DISPLAYS["display-1511"].config
SERVO = build_servo(CONFIG.scanner)
DECLARED = ServoRange(SERVO, 0.1, 0.1, 1)
IDENTIFIED = ServoRange(SERVO, 0.05, 0.05, 1)
PITCH_RAD = CONFIG.display.pitch_m / (2.0 * CONFIG.scanner.focal_length_m)
CODE_RAD = CONFIG.scanner.rad_per_code
TOLERANCE_RAD = min(CONFIG.tolerance_rad) - CODE_RAD
DARK_SAMPLES = {DECLARED: (27, 38), IDENTIFIED: (20, 30)}
PITCHES_MAX = 2
FAST_PULSES, SLOW_PULSES = 10_000, 250_000
PULSES_OF_A_SERVO = 500


@cache
def build_table(servos, tolerance=1.0):
    """Return the moves of one and two pitches. tolerance: times that of the absorbers."""
    moves = (
        compute_move(servos, pitches * PITCH_RAD + CODE_RAD, tolerance * TOLERANCE_RAD, dark_samples)
        for pitches, dark_samples in enumerate(DARK_SAMPLES[servos], 1)
    )
    return SmoothTable(servos, PITCH_RAD, CODE_RAD, tuple(moves))


def sample_servo(random, servos):
    """Return a servo within the uncertainty, every other one at a corner of it."""
    frequency, damping, delay = random.choice([-1.0, 1.0], 3) if random.random() < 0.5 else random.uniform(-1.0, 1.0, 3)
    servo = servos.servo_at(frequency, damping, delay)
    return TrueServo(servo.frequency, servo.damping, servo.delay, servo.slew)


def sample_plan(random, table, count):
    """Return the light of a plan, on_s, off_s [n] and places_rad [n, 2]. Most pulses follow as soon as they may."""
    steps = random.integers(-PITCHES_MAX, PITCHES_MAX + 1, (count, 2))
    steps[random.random(count) < 0.5, random.integers(2)] = 0
    steps[(steps == 0).all(axis=1)] = (1, 0)
    places_rad = np.cumsum(steps, axis=0) * table.pitch_rad
    places_rad = np.round(places_rad / CODE_RAD) * CODE_RAD
    longer = random.random((2, count)) < 0.3
    dwell_s = MIN_DWELL_S + np.where(longer[0], np.round(random.uniform(0.0, 3e-3, count), 6), 0.0)
    dark_s = (
        table.dark_s(np.diff(places_rad, axis=0))
        + np.where(longer[1], np.round(random.uniform(0.0, 1e-3, count), 6), 0.0)[1:]
    )
    on_s = 0.01 + np.concatenate([[0.0], np.cumsum(dwell_s[:-1] + dark_s)])
    return on_s, on_s + dwell_s, places_rad


def measure_excursion(random, table, servos, pulses):
    """Return the largest distance of light from its pixel's centre, times the tolerance, over random plans."""
    worst = 0.0
    for _ in range(pulses // PULSES_OF_A_SERVO):
        on_s, off_s, places_rad = sample_plan(random, table, PULSES_OF_A_SERVO)
        times_s, command_rad = table.build_command(off_s[:-1], places_rad[:-1], places_rad[1:])
        command_rad = np.round(command_rad / CODE_RAD) * CODE_RAD
        found = judge(times_s, command_rad, on_s, off_s, places_rad, sample_servo(random, servos))
        worst = max(worst, *(found[0] / CONFIG.tolerance_rad))
    return worst


@pytest.mark.parametrize("servos", [DECLARED, IDENTIFIED], ids=["declared", "identified"])
def test_light_stays_on_the_absorber(servos):
    excursion = measure_excursion(np.random.default_rng(1), build_table(servos), servos, FAST_PULSES)
    assert 0.9 < excursion <= 1.0


@pytest.mark.slow
@pytest.mark.parametrize("seed", [21, 22])
@pytest.mark.parametrize("servos", [DECLARED, IDENTIFIED], ids=["declared", "identified"])
def test_light_stays_on_the_absorber_in_a_million_pulses(servos, seed):
    assert measure_excursion(np.random.default_rng(seed), build_table(servos), servos, SLOW_PULSES) <= 1.0


def test_an_uncertainty_of_half_the_true_one_is_caught():
    assert measure_excursion(np.random.default_rng(3), build_table(IDENTIFIED), DECLARED, FAST_PULSES) > 1.0


def test_a_forgotten_delay_is_caught():
    table = build_table(DECLARED)
    forgetful = replace(table, servos=replace(DECLARED, servo=replace(SERVO, delay=0.0)))
    assert measure_excursion(np.random.default_rng(4), forgetful, DECLARED, FAST_PULSES) > 1.0


def test_a_window_that_is_too_wide_is_caught():
    assert measure_excursion(np.random.default_rng(5), build_table(DECLARED, 1.5), DECLARED, FAST_PULSES) > 1.0


def test_a_gate_that_opens_early_is_caught():
    table = build_table(DECLARED)
    early = replace(table, moves=tuple(replace(move, dark_samples=move.dark_samples - 2) for move in table.moves))
    assert measure_excursion(np.random.default_rng(7), early, DECLARED, FAST_PULSES) > 1.0


def test_a_dwell_that_is_too_short_is_caught(monkeypatch):
    monkeypatch.setattr(sys.modules[__name__], "MIN_DWELL_S", 0.25 * MIN_DWELL_S)
    assert measure_excursion(np.random.default_rng(6), build_table(DECLARED), DECLARED, FAST_PULSES) > 1.0


def test_the_stated_heat_is_that_of_the_judge():
    table = build_table(DECLARED)
    (move,) = table.moves[:1]
    on_s, places_rad = np.array([0.01, 0.011 + move.dark_s]), np.array([[0.0, 0.0], [table.pitch_rad, 0.0]])
    command = table.build_command(on_s[:1] + 1e-3, places_rad[:1], places_rad[1:])
    found = judge(*command, on_s, on_s + 1e-3, places_rad, TrueServo(*vars(SERVO).values()))
    assert found[1][0] == pytest.approx(move.heat, rel=0.01)
    assert found[1][1] == 0.0


def test_a_heat_without_a_move_is_refused(monkeypatch):
    monkeypatch.setattr(smooth_moves, "DARK_SAMPLES_MAX", 18)
    with pytest.raises(InputError, match="distance_rad"):
        smooth_moves.find_fastest_move(DECLARED, 9e-3, 9e-4, 1.0)
