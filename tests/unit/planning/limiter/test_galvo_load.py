"""The bound on the mirrors' acceleration against servos stepped apart from it."""

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
)
AT_REST = GalvoState(0.0, 0.0, 0.0, 0.0, 0.0)


def impulse(mirrors, t_s):
    root = np.sqrt(1 - mirrors.damping**2)
    turn = mirrors.omega_rad_per_s * root
    decay = np.exp(-mirrors.damping * mirrors.omega_rad_per_s * t_s)
    return np.where(t_s > 0, mirrors.omega_rad_per_s / root * decay * np.sin(turn * t_s), 0.0)


@pytest.mark.parametrize("damping", [0.3, 0.7, 0.9])
@pytest.mark.parametrize("move_rad", [1e-4, 9e-3, 0.02, 0.3])
def test_energy_of_a_move_is_the_integral_or_a_little_more(damping, move_rad):
    mirrors = SERVO._replace(damping=damping)
    ramp_s = move_rad / mirrors.slew_rad_per_s
    t_s = np.linspace(0.0, ramp_s + 20 / (damping * mirrors.omega_rad_per_s), 400_001)
    a = mirrors.slew_rad_per_s * (impulse(mirrors, t_s) - impulse(mirrors, t_s - ramp_s))
    exact, counted = np.sum(a**2) * t_s[1], move_energy(mirrors, move_rad)
    turned = mirrors.omega_rad_per_s * np.sqrt(1 - damping**2) * ramp_s
    assert counted >= exact * (1 - 1e-4)
    if turned < np.pi:
        assert counted == pytest.approx(exact, rel=1e-3)
    assert counted <= 1.4 * exact


@pytest.mark.parametrize("damping", [0.3, 0.7, 0.9])
def test_what_is_left_of_a_swing_is_bounded_over_all_phases_and_tightly(damping):
    mirrors = SERVO._replace(damping=damping)
    pole = mirrors.omega_rad_per_s * complex(-damping, np.sqrt(1 - damping**2))
    t_s = np.linspace(0.0, 15 / (damping * mirrors.omega_rad_per_s), 4001)
    shares = []
    for phase in np.linspace(0, np.pi, 181):
        to_come = np.cumsum(((np.exp(1j * phase + pole * t_s)).real ** 2)[::-1])[::-1]
        left = np.sqrt(to_come / to_come[0])[: len(t_s) // 2]
        bound = np.array([ringing_envelope_factor(mirrors, at_s) for at_s in t_s[: len(t_s) // 2]])
        shares.append((left / bound).max())
        assert np.all(left <= bound * (1 + 1e-2))
    assert max(shares) > 0.98


def bound(mirrors, rows, forget=lambda motion: motion):
    """Largest mean-square acceleration that the limiter counts with, of moves on x at (start_s, width_s, x_rad)."""
    motion, end_s, at_rad, most = AT_REST, 0.0, 0.0, 0.0
    for start_s, width_s, x_rad in rows:
        motion = apply_move(mirrors, forget(motion), x_rad - at_rad, 0.0, end_s, start_s)
        end_s, at_rad = start_s + width_s, x_rad
        most = max(most, mean_square_bound(mirrors, motion, end_s))
    return most


def real(mirrors, rows):
    """The same of a servo that is sent on when a pulse ends."""
    ends_s = np.array([0.0] + [start_s + width_s for start_s, width_s, _ in rows])
    numbers = (mirrors.omega_rad_per_s, mirrors.damping, mirrors.delay_s, mirrors.slew_rad_per_s, mirrors.averaging_s)
    return _coil(ends_s[:-1].copy(), np.array([x_rad for *_, x_rad in rows]), ends_s[-1] + 0.1, *numbers)


@st.composite
def motions(draw):
    mirrors = GalvoModel(
        omega_rad_per_s=draw(st.floats(1e3, 3e4)),
        damping=draw(st.floats(0.3, 0.9)),
        delay_s=draw(st.sampled_from([0.0, 3e-5, 2e-4])),
        slew_rad_per_s=draw(st.floats(50, 500)),
        lead_in_s=draw(st.sampled_from([1e-3, 5e-3])),
        averaging_s=draw(st.sampled_from([0.05, 0.3, 1.0])),
        rad_per_code=0.0,
        timing_slack_s=0.0,
    )
    now_s, at_rad, rows = 0.0, 0.0, []
    for _ in range(draw(st.integers(1, 30))):
        to_rad = draw(st.sampled_from([-0.03, -0.01, 0.0, 0.005, 0.03]))
        ramp_s = abs(to_rad - at_rad) / mirrors.slew_rad_per_s
        now_s += ramp_s + mirrors.delay_s + draw(st.sampled_from([0.0, 1e-4, 1e-3, 0.1]))
        width_s = draw(st.sampled_from([1e-5, 2e-4, 5e-3]))
        rows.append((now_s, width_s, to_rad))
        now_s, at_rad = now_s + width_s, to_rad
    return mirrors, rows


@settings(max_examples=400)
@given(motions())
def test_no_servo_accelerates_more_than_counted(case):
    mirrors, rows = case
    assert real(mirrors, rows) <= bound(mirrors, rows) * (1 + 1e-4)


def swinging(mirrors, count=200):
    """There and back in time with the servo's own swing, so that each move adds to what is left of the last."""
    half_s = np.pi / (mirrors.omega_rad_per_s * np.sqrt(1 - mirrors.damping**2))
    move_rad = 0.2 * half_s * mirrors.slew_rad_per_s
    return [(k * half_s + 0.5 * half_s, 0.5 * half_s, move_rad * (-1) ** k) for k in range(count)]


def test_moves_that_add_up_are_counted_and_forgetting_the_former_is_caught():
    mirrors = SERVO._replace(damping=0.3, delay_s=0.0)
    rows = swinging(mirrors)
    truth = real(mirrors, rows)
    assert truth <= bound(mirrors, rows)
    assert truth > bound(mirrors, rows, forget=lambda motion: motion._replace(x_ringing=0.0, y_ringing=0.0))


def test_a_move_long_before_its_pulse_is_counted():
    """The mirrors move when a pulse ends, though the next one is far off; what is counted allows for that."""
    there_and_back = [(0.002 * k + 0.001, 2e-4, 0.03 * (-1) ** k) for k in range(200)]
    counted = bound(SERVO, there_and_back)
    then = [*there_and_back, (5.0, 2e-4, 0.15)]
    assert real(SERVO, then) > real(SERVO, there_and_back)
    assert bound(SERVO, then) == counted >= real(SERVO, then)


def test_late_parts_of_a_move_are_counted_at_a_time_that_covers_them():
    """exp((t − late) / mean) over a² as a weight is 1 at the most, also for a mean as short as there may be."""
    mirrors = SERVO._replace(averaging_s=0.05, omega_rad_per_s=2 * np.pi * 100, damping=0.3, delay_s=0.0)
    t_s = np.linspace(0.0, 0.2, 400_001)
    a2 = impulse(mirrors, t_s) ** 2
    assert np.sum(a2 * np.exp((t_s - effective_delay_s(mirrors)) / mirrors.averaging_s)) <= np.sum(a2)
