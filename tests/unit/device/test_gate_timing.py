import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from optodrive.device.gate_timing import envelope_factor, pole_per_s, settling_s
from optodrive.device.servo import Servo, simulate_servo

SERVO = Servo(frequency=1700.0, damping=0.7, delay=3e-5, slew=100.0)
servos = st.builds(
    Servo,
    frequency=st.floats(200, 5000),
    damping=st.floats(0.3, 0.9),
    delay=st.floats(0, 1e-4),
    slew=st.floats(20, 1000),
)


@settings(max_examples=3 * settings.default.max_examples // 2)
@given(servo=servos, move_rad=st.floats(2e-3, 0.3), share=st.floats(0.01, 0.45))
def test_settled_is_when_the_stepped_servo_last_comes_inside(servo, move_rad, share):
    """The diagnosis integrates the servo with an error of about 2e-4 of a step."""
    tolerance_rad = share * min(move_rad, 0.02)
    done_s = settling_s(servo, move_rad, tolerance_rad)
    t_s = np.linspace(0.0, done_s + 8 / (servo.damping * 2 * np.pi * servo.frequency), 20_001)
    angle = simulate_servo(np.array([-1.0, 0.0]), np.array([0.0, move_rad]), t_s, servo)
    error_rad = np.abs(angle - move_rad)
    rough_rad = 2e-3 * min(move_rad, servo.slew / servo.frequency)
    assert error_rad[t_s >= done_s].max() <= tolerance_rad + rough_rad
    if done_s > servo.delay + move_rad / servo.slew:
        assert error_rad[t_s >= done_s - 2 * t_s[1]].max() >= tolerance_rad - rough_rad


def test_never_before_the_ramp_is_over():
    assert settling_s(SERVO, 1e-4, 1e-3) == pytest.approx(3e-5 + 1e-6)
    assert settling_s(SERVO, 0.1, 0.09) >= 3e-5 + 1e-3


def test_the_servo_of_the_shipped_scanners_settles_as_its_class():
    step_rad = 1e-6  # so small that the slew limit takes no time
    assert settling_s(SERVO, step_rad, 0.05 * step_rad) - 3e-5 == pytest.approx(0.28e-3, abs=1e-5)
    assert settling_s(SERVO, step_rad, 0.02 * step_rad) - 3e-5 == pytest.approx(0.55e-3, abs=2e-5)


def peak_from_phase(pole, phases):
    """Return the sampled maximum of |Re exp(λ t)| from each phase on, [phases]."""
    t_s = np.linspace(0.0, 3 * np.pi / pole.imag, 3001)
    return np.abs(np.outer(np.exp(1j * phases), np.exp(pole * t_s)).real).max(axis=1)


@pytest.mark.parametrize("damping", [0.3, 0.5, 0.7, 0.9])
def test_what_outlasts_a_tolerance_is_bounded_over_all_phases_and_tightly(damping):
    servo = Servo(1000.0, damping, 0.0, 100.0)
    now = peak_from_phase(pole_per_s(servo), np.linspace(0, np.pi, 720, endpoint=False))
    # From a later phase on, without the decay itself: |Re| has the period π.
    max_ratio = max((np.roll(now, -shift) / now).max() for shift in range(720))
    assert max_ratio <= envelope_factor(servo) * (1 + 1e-6)
    assert max_ratio >= 0.99 * envelope_factor(servo)
