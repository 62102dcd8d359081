"""The bound on the mirrors' acceleration against an independent simulation of the servos."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from optodrive.planning.limiter.budget import GalvoModel
from optodrive.planning.limiter.galvo_load import (
    GalvoState,
    apply_move,
    effective_delay_s,
    mean_square_bound,
    move_energy,
    ringing_envelope_factor,
)
from reference_models.thermal_display import _coil

SERVO = GalvoModel(
    omega_rad_per_s=2 * np.pi * 1700,
    damping=0.7,
    delay_s=3e-5,
    slew_rad_per_s=100.0,
    lead_in_s=5e-3,
    averaging_s=1.0,
    rad_per_code=0.0,
    timing_slack_s=0.0,
    early_s=0.0,
)
STANDING_STILL = GalvoState(0.0, 0.0, 0.0, 0.0, 0.0)


def impulse(galvo, t_s):
    root = np.sqrt(1 - galvo.damping**2)
    turn = galvo.omega_rad_per_s * root
    decay = np.exp(-galvo.damping * galvo.omega_rad_per_s * t_s)
    return np.where(t_s > 0, galvo.omega_rad_per_s / root * decay * np.sin(turn * t_s), 0.0)


@pytest.mark.parametrize("damping", [0.3, 0.7, 0.9])
@pytest.mark.parametrize("move_rad", [1e-4, 9e-3, 0.02, 0.3])
def test_move_energy_bounds_the_integral_closely(damping, move_rad):
    galvo = SERVO._replace(damping=damping)
    ramp_s = move_rad / galvo.slew_rad_per_s
    t_s = np.linspace(0.0, ramp_s + 20 / (damping * galvo.omega_rad_per_s), 400_001)
    a = galvo.slew_rad_per_s * (impulse(galvo, t_s) - impulse(galvo, t_s - ramp_s))
    exact, bound = np.sum(a**2) * t_s[1], move_energy(galvo, move_rad)
    phase_rad = galvo.omega_rad_per_s * np.sqrt(1 - damping**2) * ramp_s
    assert bound >= exact * (1 - 1e-4)
    if phase_rad < np.pi:
        assert bound == pytest.approx(exact, rel=1e-3)
    assert bound <= 1.4 * exact


@pytest.mark.parametrize("damping", [0.3, pytest.param(0.7, marks=pytest.mark.slow), 0.9])
def test_the_ringing_envelope_bounds_all_phases_tightly(damping):
    galvo = SERVO._replace(damping=damping)
    pole = galvo.omega_rad_per_s * complex(-damping, np.sqrt(1 - damping**2))
    t_s = np.linspace(0.0, 15 / (damping * galvo.omega_rad_per_s), 4001)
    ratios = []
    for phase in np.linspace(0, np.pi, 181):
        remaining = np.cumsum(((np.exp(1j * phase + pole * t_s)).real ** 2)[::-1])[::-1]
        fraction = np.sqrt(remaining / remaining[0])[: len(t_s) // 2]
        bound = np.array([ringing_envelope_factor(galvo, at_s) for at_s in t_s[: len(t_s) // 2]])
        ratios.append((fraction / bound).max())
        assert np.all(fraction <= bound * (1 + 1e-2))
    assert max(ratios) > 0.98


def compute_bound(galvo, rows, mutate=lambda state: state):
    """Compute the limiter's bound on the mean-square acceleration for moves on x at (start_s, width_s, x_rad)."""
    state, end_s, at_rad, peak = STANDING_STILL, 0.0, 0.0, 0.0
    for start_s, width_s, x_rad in rows:
        state = apply_move(galvo, mutate(state), x_rad - at_rad, 0.0, end_s, start_s)
        end_s, at_rad = start_s + width_s, x_rad
        peak = max(peak, mean_square_bound(galvo, state, end_s))
    return peak


def simulate_peak(galvo, rows):
    """Simulate the same for a servo that leaves when a pulse ends, or early where it is longer than that."""
    early_s = [galvo.early_s if width_s > galvo.early_s else 0.0 for _, width_s, _ in rows]
    ends_s = np.array([0.0] + [start_s + width_s for start_s, width_s, _ in rows])
    ends_s[1:-1] -= early_s[:-1]
    numbers = (galvo.omega_rad_per_s, galvo.damping, galvo.delay_s, galvo.slew_rad_per_s, galvo.averaging_s)
    return _coil(ends_s[:-1].copy(), np.array([x_rad for *_, x_rad in rows]), ends_s[-1] + 0.1, *numbers)


@st.composite
def move_sequences(draw):
    galvo = GalvoModel(
        omega_rad_per_s=draw(st.floats(1e3, 3e4)),
        damping=draw(st.floats(0.3, 0.9)),
        delay_s=draw(st.sampled_from([0.0, 3e-5, 2e-4])),
        slew_rad_per_s=draw(st.floats(50, 500)),
        lead_in_s=draw(st.sampled_from([1e-3, 5e-3])),
        averaging_s=draw(st.sampled_from([0.05, 0.3, 1.0])),
        rad_per_code=0.0,
        timing_slack_s=0.0,
        early_s=draw(st.sampled_from([0.0, 0.0, 8e-5])),
    )
    now_s, at_rad, rows = 0.0, 0.0, []
    for _ in range(draw(st.integers(1, 30))):
        to_rad = draw(st.sampled_from([-0.03, -0.01, 0.0, 0.005, 0.03]))
        ramp_s = abs(to_rad - at_rad) / galvo.slew_rad_per_s
        now_s += ramp_s + galvo.delay_s + draw(st.sampled_from([0.0, 1e-4, 1e-3, 0.1]))
        width_s = draw(st.sampled_from([1e-5, 2e-4, 5e-3]))
        rows.append((now_s, width_s, to_rad))
        now_s, at_rad = now_s + width_s, to_rad
    return galvo, rows


@given(move_sequences())
def test_no_servo_exceeds_the_bound(case):
    check_bound(case)


@pytest.mark.slow
@settings(max_examples=4 * settings.default.max_examples)
@given(move_sequences())
def test_no_servo_exceeds_the_bound_in_many_sequences(case):
    check_bound(case)


def check_bound(case):
    galvo, rows = case
    assert simulate_peak(galvo, rows) <= compute_bound(galvo, rows) * (1 + 1e-4)


def build_resonant_moves(galvo, count=200):
    """Build moves in phase with the servo's ringing, so that each move adds to the ringing of the last."""
    half_s = np.pi / (galvo.omega_rad_per_s * np.sqrt(1 - galvo.damping**2))
    move_rad = 0.2 * half_s * galvo.slew_rad_per_s
    return [(k * half_s + 0.5 * half_s, 0.5 * half_s, move_rad * (-1) ** k) for k in range(count)]


def test_resonant_moves_are_bounded_and_a_mutant_without_ringing_is_caught():
    galvo = SERVO._replace(damping=0.3, delay_s=0.0)
    rows = build_resonant_moves(galvo)
    truth = simulate_peak(galvo, rows)
    assert truth <= compute_bound(galvo, rows)
    assert truth > compute_bound(galvo, rows, mutate=lambda state: state._replace(x_ringing=0.0, y_ringing=0.0))


def test_a_move_long_before_its_pulse_is_bounded():
    """The mirrors move when a pulse ends, even if the next one is much later. The bound covers that."""
    there_and_back = [(0.002 * k + 0.001, 2e-4, 0.03 * (-1) ** k) for k in range(200)]
    bound = compute_bound(SERVO, there_and_back)
    then = [*there_and_back, (5.0, 2e-4, 0.15)]
    assert simulate_peak(SERVO, then) > simulate_peak(SERVO, there_and_back)
    assert compute_bound(SERVO, then) == bound >= simulate_peak(SERVO, then)


def test_the_effective_delay_covers_the_tail_of_a_move():
    """The mean of a² with weight exp((t − delay) / averaging time) is at peak that of a², also for short averaging."""
    galvo = SERVO._replace(averaging_s=0.05, omega_rad_per_s=2 * np.pi * 100, damping=0.3, delay_s=0.0)
    t_s = np.linspace(0.0, 0.2, 400_001)
    a2 = impulse(galvo, t_s) ** 2
    assert np.sum(a2 * np.exp((t_s - effective_delay_s(galvo)) / galvo.averaging_s)) <= np.sum(a2)
