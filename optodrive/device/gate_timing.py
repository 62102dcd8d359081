"""When a mirror that a servo moves is near enough for the light, in closed form.

The servo's own target runs to the command in move / slew; from then on the error swings freely, as Re(A exp(λ t)) with
λ = −ζω + iω√(1 − ζ²).
"""

from cmath import exp as cexp
from cmath import phase
from math import asin, cos, exp, pi, sqrt

from optodrive.device.config import ScannerSection
from optodrive.device.servo import Servo

BISECTION_STEPS = 50


def build_servo(scanner: ScannerSection) -> Servo:
    """The servo of either mirror as configured."""
    return Servo(scanner.bandwidth_hz, scanner.damping, scanner.delay_s, scanner.slew_rad_per_s)


def pole_per_s(servo: Servo) -> complex:
    """λ of the servo's free swing, 1/s; its damping lies below 1."""
    omega = 2.0 * pi * servo.frequency
    return complex(-servo.damping * omega, omega * sqrt(1.0 - servo.damping**2))


def settling_s(servo: Servo, move_rad: float, tolerance_rad: float) -> float:
    """From a move's command until its error is within tolerance_rad for good and its ramp is over, s. All above 0."""
    pole, ramp_s = pole_per_s(servo), move_rad / servo.slew
    swing = -1j * servo.slew * pole.conjugate() / (pole * pole.imag) * (1.0 - cexp(pole * ramp_s))

    def beyond(at_s: float) -> bool:
        return abs((swing * cexp(pole * at_s)).real) > tolerance_rad

    # From one turn of the swing to the next the error only falls or only rises, so the last crossing is easily found.
    outside_s, turn_s = 0.0, ((0.5 * pi - phase(pole * swing)) % pi) / pole.imag
    while beyond(turn_s):
        outside_s, turn_s = turn_s, turn_s + pi / pole.imag
    inside_s = turn_s
    if not beyond(outside_s):
        return servo.delay + ramp_s
    for _ in range(BISECTION_STEPS):
        middle_s = 0.5 * (outside_s + inside_s)
        if beyond(middle_s):
            outside_s = middle_s
        else:
            inside_s = middle_s
    return servo.delay + ramp_s + inside_s


def envelope_factor(servo: Servo) -> float:
    """What is left of a swing that keeps within a tolerance: t later at most this × exp(−ζω t) of the tolerance.

    From phase φ on, exp(−ζω t) |cos(ω_d t + φ)| reaches at most 1, and at least the larger of cos φ and of its next
    turn, wherever in φ the larger of both is least.
    """
    turn, decay = pi - asin(servo.damping), servo.damping / sqrt(1.0 - servo.damping**2)
    low, high = 0.0, 0.5 * pi
    for _ in range(BISECTION_STEPS):
        middle = 0.5 * (low + high)
        if cos(middle) > sqrt(1.0 - servo.damping**2) * exp(-decay * (turn - middle)):
            low = middle
        else:
            high = middle
    return 1.0 / cos(high)
