"""The bound of settling times holds for every servo within the declared uncertainty, and wastes little."""

from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from focus_judge import ExactServo
from optodrive.device.config_file import load_config
from optodrive.device.gate_timing import settling_s
from optodrive.device.servo import Servo, ServoRange
from optodrive.device.settling_bound import bound_departure_s, bound_settling_s

PITCH_RAD, TOLERANCE_RAD = 4e-3 / 0.44, 8.8e-4
SHIPPED = ServoRange(Servo(1700.0, 0.7, 3e-5, 100.0), 0.1, 0.1, 0.1, 1e-5)
RINGING = ServoRange(Servo(400.0, 0.3, 3e-5, 300.0), 0.1, 0.1, 0.1, 1e-5)
RESONANT = ServoRange(Servo(400.0, 0.3, 3e-5, 30.0), 0.1, 0.1, 0.1, 1e-5)
places = st.one_of(st.sampled_from([-1.0, 0.0, 1.0]), st.floats(-1.0, 1.0))


@settings(max_examples=20 * settings.default.max_examples)
@given(
    servo=st.builds(
        Servo,
        frequency=st.floats(200, 5000),
        damping=st.floats(0.3, 0.9),
        delay=st.floats(1e-5, 1e-4),
        slew=st.floats(20, 1000),
    ),
    half_widths=st.tuples(*[st.sampled_from([0.0, 0.02, 0.1])] * 3),
    distances_rad=st.tuples(st.floats(2e-3, 0.3), st.floats(2e-3, 0.3)).map(sorted),
    share=st.floats(0.01, 0.45),
    place=st.tuples(*[places] * 5),
)
def test_no_servo_within_the_range_takes_longer(servo, half_widths, distances_rad, share, place):
    servos = ServoRange(servo, *half_widths, 1e-5)
    tolerance_rad = share * min(distances_rad[0], 0.02)
    bound_s = bound_settling_s(servos, *distances_rad, tolerance_rad)
    move_rad = distances_rad[0] + 0.5 * (1.0 + place[4]) * (distances_rad[1] - distances_rad[0])
    assert settling_s(servos.servo_at(*place[:4]), move_rad, tolerance_rad) <= bound_s * (1.0 + 1e-9)


def follow_step(servo, move_rad, t_s):
    """Return the angle after a step at 0, by the exact servo of the judges."""
    scanner = SimpleNamespace(
        bandwidth_hz=servo.frequency, damping=servo.damping, delay_s=servo.delay, slew_rad_per_s=servo.slew
    )
    return ExactServo(scanner).angles(np.array([0.0]), np.array([move_rad]), t_s)


@settings(max_examples=5 * settings.default.max_examples)
@given(place=st.tuples(*[places] * 4), move_rad=st.floats(1e-4, 0.3), share=st.floats(0.2, 1.0))
def test_no_servo_within_the_range_leaves_earlier(place, move_rad, share):
    tolerance_rad = share * TOLERANCE_RAD
    servo, leaves_s = SHIPPED.servo_at(*place), bound_departure_s(SHIPPED, tolerance_rad)
    angle_rad = follow_step(servo, move_rad, np.linspace(0.0, leaves_s, 200))
    assert np.abs(angle_rad).max() <= tolerance_rad * (1.0 + 1e-9)


def test_the_fastest_servo_leaves_then():
    leaves_s = bound_departure_s(SHIPPED, TOLERANCE_RAD)
    angle_rad = follow_step(SHIPPED.servo_at(1.0, -1.0, 1.0, -1.0), 0.1, np.array([0.5 * leaves_s, leaves_s]))
    assert angle_rad[-1] == pytest.approx(TOLERANCE_RAD, rel=1e-6)


def sample_times_s(servos, move_rad, count, tolerance_rad=TOLERANCE_RAD):
    random = np.random.default_rng(3)
    return [settling_s(servos.servo_at(*each), move_rad, tolerance_rad) for each in random.uniform(-1, 1, (count, 4))]


def corner_times_s(servos, move_rad, tolerance_rad=TOLERANCE_RAD):
    return [settling_s(servos.servo_at(*each), move_rad, tolerance_rad) for each in product((-1.0, 1.0), repeat=4)]


@pytest.mark.parametrize("pitches", [1, 2, 5, 38])
@pytest.mark.parametrize(
    ("servos", "excess"), [(SHIPPED, 0.01), (RINGING, 0.02), (RESONANT, 0.15)], ids=["shipped", "ringing", "resonant"]
)
def test_the_bound_is_near_the_slowest_servo(servos, excess, pitches):
    move_rad = pitches * PITCH_RAD
    slowest_s = max(*corner_times_s(servos, move_rad), *sample_times_s(servos, move_rad, 3000))
    assert slowest_s <= bound_settling_s(servos, move_rad, move_rad, TOLERANCE_RAD) <= (1.0 + excess) * slowest_s


def test_of_a_servo_that_is_known_exactly_it_is_the_settling_time():
    exact = ServoRange(SHIPPED.servo, 0.0, 0.0, 0.0, 0.0)
    bound_s = bound_settling_s(exact, PITCH_RAD, PITCH_RAD, TOLERANCE_RAD)
    assert bound_s == pytest.approx(settling_s(exact.servo, PITCH_RAD, TOLERANCE_RAD), abs=1e-9)


def test_corners_alone_would_open_the_gate_early():
    """Mutant: the slowest of the sixteen corners, for a servo whose ringing just exceeds the tolerance between them."""
    servos, move_rad = ServoRange(Servo(1713.0, 0.387, 3e-5, 79.5), 0.1, 0.1, 0.1, 0.0), 0.0854
    slowest_s = max(sample_times_s(servos, move_rad, 3000, tolerance_rad=3.85e-3))
    assert slowest_s > 1.03 * max(corner_times_s(servos, move_rad, tolerance_rad=3.85e-3))
    assert slowest_s <= bound_settling_s(servos, move_rad, move_rad, 3.85e-3)


DISPLAY_437 = load_config("display-437")


def follow_ramp(half_width):
    """Return the time before which no command brings the slowest servo of a range one pitch on, s.

    The target of a step without end moves at the slew limit; that of any commands is behind it. The servo's impulse
    response is positive until then, so the angle of any commands is behind, too.
    """
    servos, (_, tolerance_rad) = ServoRange(SHIPPED.servo, *[half_width] * 3, 1e-5), DISPLAY_437.tolerance_rad
    pitch_rad = DISPLAY_437.display.pitch_m / (2.0 * DISPLAY_437.scanner.focal_length_m)
    slowest = servos.servo_at(-1.0, 1.0, -1.0, 1.0)
    t_s = np.arange(0.0, 4e-4, 1e-6)
    root = np.sqrt(1.0 - slowest.damping**2)
    assert t_s[-1] - slowest.delay < 1.0 / (2.0 * slowest.frequency * root)  # half an oscillation
    return (
        slowest,
        pitch_rad - tolerance_rad,
        t_s[np.argmax(follow_step(slowest, 1.0, t_s) >= pitch_rad - tolerance_rad)],
    )


@pytest.mark.parametrize(("half_width", "bound_us"), [(0.1, 271), (0.02, 249)])
@given(
    steps=st.lists(st.tuples(st.floats(0.0, 2.5e-4), st.floats(-0.03, 0.03)), min_size=1, max_size=4),
)
def test_no_steps_settle_a_move_of_one_pitch_before_the_slew_limit_allows(half_width, bound_us, steps):
    """Several steps in place of one cannot bring the dark time of a pitch below this, however they are shaped."""
    slowest, enough_rad, reached_s = follow_ramp(half_width)
    assert 1e6 * reached_s == pytest.approx(bound_us, abs=2.0)
    at_s = np.cumsum([0.0] + [gap_s for gap_s, _ in steps[1:]])
    scanner = SimpleNamespace(
        bandwidth_hz=slowest.frequency,
        damping=slowest.damping,
        delay_s=slowest.delay,
        slew_rad_per_s=slowest.slew,
    )
    t_s = np.arange(0.0, 4e-4, 1e-6)
    angles_rad = ExactServo(scanner).angles(at_s, np.array([level_rad for _, level_rad in steps]), t_s)
    assert (angles_rad[t_s < reached_s - 2e-6] < enough_rad).all()


def follow_shapes(servos, at_s, level_rad, pitch_rad, tolerance_rad):
    """Return settling times [k] over the corners of a range, and the nominal servo's mean square of acceleration [k].

    Each of k shapes is a step to a level at 0 and one to the pitch at a time.
    """
    step_s, times = 2e-6, 220
    settled_s, square = np.zeros(len(at_s)), None
    for place in ((0.0, 0.0, 0.0), *product((-1.0, 0.0, 1.0), repeat=3)):
        servo = servos.servo_at(*place, 1.0)
        target, angle, speed, total = (np.zeros(len(at_s)) for _ in range(4))
        last_s = np.zeros(len(at_s))
        for k in range(times):
            command_rad = np.where(k * step_s < at_s, level_rad, pitch_rad)
            target += np.clip(command_rad - target, -servo.slew * step_s, servo.slew * step_s)
            omega = 2.0 * np.pi * servo.frequency
            acceleration = omega**2 * (target - angle) - 2.0 * servo.damping * omega * speed
            speed = speed + acceleration * step_s
            angle = angle + speed * step_s
            total += acceleration**2
            last_s[np.abs(angle - pitch_rad) > tolerance_rad] = (k + 1) * step_s
        square = total if square is None else square
        settled_s = np.maximum(settled_s, servo.delay + last_s)
    return settled_s, square


@pytest.mark.parametrize(("half_width", "plain_us", "shaped_us"), [(0.1, 378, 351), (0.02, 333, 278)])
def test_two_steps_settle_sooner_only_where_they_heat_the_coils_more(half_width, plain_us, shaped_us):
    """A shape that brings the pitch on sooner costs mean square of acceleration, which is what binds standing pages."""
    servos, (_, tolerance_rad) = ServoRange(SHIPPED.servo, *[half_width] * 3, 1e-5), DISPLAY_437.tolerance_rad
    pitch_rad = DISPLAY_437.display.pitch_m / (2.0 * DISPLAY_437.scanner.focal_length_m)
    at_s, level = (each.ravel() for each in np.meshgrid(np.arange(2e-5, 2.5e-4, 1e-5), np.arange(0.0, 2.2, 0.05)))
    settled_s, square = follow_shapes(servos, at_s, level * pitch_rad, pitch_rad, tolerance_rad)
    plain = np.argmin(np.abs(level - 1.0) + at_s)
    assert 1e6 * settled_s[plain] == pytest.approx(plain_us, abs=4.0)
    assert 1e6 * settled_s.min() == pytest.approx(shaped_us, abs=6.0)
    no_hotter = square <= (1.0 + 1e-9) * square[plain]
    assert settled_s[no_hotter].min() >= settled_s[plain] - 4e-6
