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
from optodrive.device.servo import ServoRange
from optodrive.planning.scheduler.visiting_path import compute_visiting_order
from smooth_judge import TrueServo, judge
from smooth_plans import CODE_RAD, CONFIG, PITCH_RAD, TOLERANCE_RAD, sample_plan

sys.path.append(str(Path(__file__).parents[2] / "scripts"))

import smooth_moves
from smooth_moves import MIN_DWELL_S, SAMPLE_S, SmoothTable, compute_move

SERVO = build_servo(CONFIG.scanner)
DECLARED = ServoRange(SERVO, 0.1, 0.1, 0.0, SAMPLE_S)
IDENTIFIED = ServoRange(SERVO, 0.05, 0.05, 0.0, SAMPLE_S)
DARK_SAMPLES = {DECLARED: (27, 38), IDENTIFIED: (20, 30)}
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
    servo = servos.servo_at(frequency, damping, 0.0, delay)
    return TrueServo(servo.frequency, servo.damping, servo.delay, servo.slew)


def measure_excursion(random, table, servos, pulses, min_dwell_s=MIN_DWELL_S):
    """Return the largest distance of light from its pixel's centre, times the tolerance, over random plans."""
    worst = 0.0
    for _ in range(pulses // PULSES_OF_A_SERVO):
        on_s, off_s, places_rad = sample_plan(random, table, PULSES_OF_A_SERVO, min_dwell_s)
        times_s, command_rad = table.build_command(off_s[:-1], places_rad[:-1], places_rad[1:])
        command_rad = np.round(command_rad / CODE_RAD) * CODE_RAD
        found = judge(times_s, command_rad, on_s, off_s, places_rad, [sample_servo(random, servos)] * 2)
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


def test_a_dwell_that_is_too_short_is_caught():
    assert measure_excursion(np.random.default_rng(6), build_table(DECLARED), DECLARED, FAST_PULSES, 2e-4) > 1.0


@pytest.mark.parametrize("servos", [DECLARED, IDENTIFIED], ids=["declared", "identified"])
def test_light_of_a_full_frame_stays_on_the_absorbers(servos):
    head, table, random = DISPLAYS["display-1511"].scan_head, build_table(servos), np.random.default_rng(8)
    layout, places_rad = head.layout, np.column_stack([head.moves.x_rad, head.moves.y_rad])
    order = compute_visiting_order(np.arange(len(layout)), layout.row, layout.column, *places_rad.T, None)
    places_rad = np.round(places_rad[order] / CODE_RAD) * CODE_RAD
    assert len(places_rad) == 1511
    on_s = 0.01 + np.concatenate([[0.0], np.cumsum(2e-3 + table.dark_s(np.diff(places_rad, axis=0)))])
    times_s, command_rad = table.build_command(on_s[:-1] + 2e-3, places_rad[:-1], places_rad[1:])
    for _ in range(5):
        servo = sample_servo(random, servos)
        distance_rad, _heat = judge(times_s, command_rad, on_s, on_s + 2e-3, places_rad, [servo] * 2)
        assert (distance_rad <= CONFIG.tolerance_rad).all()


def test_the_stated_heat_is_that_of_the_judge():
    table = build_table(DECLARED)
    (move,) = table.moves[:1]
    on_s, places_rad = np.array([0.01, 0.011 + move.dark_s]), np.array([[0.0, 0.0], [table.pitch_rad, 0.0]])
    command = table.build_command(on_s[:1] + 1e-3, places_rad[:1], places_rad[1:])
    found = judge(*command, on_s, on_s + 1e-3, places_rad, [TrueServo(*vars(SERVO).values())] * 2)
    assert found[1][0] == pytest.approx(move.heat, rel=0.01)
    assert found[1][1] == 0.0


def test_a_heat_without_a_move_is_refused(monkeypatch):
    monkeypatch.setattr(smooth_moves, "DARK_SAMPLES_MAX", 18)
    with pytest.raises(InputError, match="distance_rad"):
        smooth_moves.find_fastest_move(DECLARED, 9e-3, 9e-4, 1.0)
