"""Settling time of a mirror's servo in closed form, after which the gate may open.

The servo's internal target slews to the command in move / slew; from then on the error rings freely as Re(A exp(λ t))
with λ = −ζω + iω√(1 − ζ²).
"""

from cmath import exp as cexp
from cmath import phase
from math import asin, cos, exp, pi, sqrt

from optodrive.core.kernels import kernel
from optodrive.device.config_sections import ScannerSection
from optodrive.device.servo import Servo, ServoRange

BISECTION_STEPS = 50
CROSSING_STEPS = 20
"""Bisections of a crossing, to a millionth of half a period of the ringing."""


def build_servo(scanner: ScannerSection) -> Servo:
    """Return the configured servo of both mirrors."""
    return Servo(scanner.bandwidth_hz, scanner.damping, scanner.delay_s, scanner.slew_rad_per_s)


def build_servo_range(scanner: ScannerSection) -> ServoRange:
    """Return the configured servo with its declared uncertainty."""
    return ServoRange(
        build_servo(scanner),
        scanner.bandwidth_uncertainty,
        scanner.damping_uncertainty,
        scanner.slew_uncertainty,
        scanner.delay_uncertainty_s,
    )


def pole_per_s(servo: Servo) -> complex:
    """Return the pole λ of the servo's free ringing, 1/s. Its damping ratio is below 1."""
    omega = 2.0 * pi * servo.frequency
    return complex(-servo.damping * omega, omega * sqrt(1.0 - servo.damping**2))


def settling_s(servo: Servo, move_rad: float, tolerance_rad: float) -> float:
    """Return the time from a move's command until its ramp is over and its error stays within tolerance_rad, s.

    move_rad and tolerance_rad are positive.
    """
    ramp_s = move_rad / servo.slew
    return (
        servo.delay + ramp_s + ringing_s(2.0 * pi * servo.frequency, servo.damping, servo.slew, ramp_s, tolerance_rad)
    )


@kernel
def ringing_s(omega: float, damping: float, slew: float, ramp_s: float, tolerance_rad: float) -> float:
    """Return the time from the end of a ramp until the error stays within tolerance_rad, s.

    omega: natural frequency, rad/s
    """
    pole = complex(-damping * omega, omega * sqrt(1.0 - damping**2))
    amplitude = -1j * slew * pole.conjugate() / (pole * pole.imag) * (1.0 - cexp(pole * ramp_s))
    size_rad, start_rad = abs(amplitude), phase(amplitude)
    # Between two extrema of the ringing the error is monotone, so bisection finds the last crossing.
    outside_s, extremum_s = 0.0, ((0.5 * pi - phase(pole * amplitude)) % pi) / pole.imag
    # From extremum to extremum: the last one beyond the tolerance has the crossing behind it.
    while size_rad * exp(pole.real * extremum_s) * abs(cos(pole.imag * extremum_s + start_rad)) > tolerance_rad:
        outside_s, extremum_s = extremum_s, extremum_s + pi / pole.imag
    inside_s = extremum_s
    if size_rad * exp(pole.real * outside_s) * abs(cos(pole.imag * outside_s + start_rad)) <= tolerance_rad:
        # The ramp itself ends within the tolerance.
        return 0.0
    for _ in range(CROSSING_STEPS):
        middle_s = 0.5 * (outside_s + inside_s)
        if size_rad * exp(pole.real * middle_s) * abs(cos(pole.imag * middle_s + start_rad)) > tolerance_rad:
            outside_s = middle_s
        else:
            inside_s = middle_s
    # The end of the last interval that is inside: never too early.
    return inside_s


def envelope_factor(servo: Servo) -> float:
    """Return the factor k such that ringing within a tolerance is within k exp(−ζω t) of it a time t later.

    From phase φ on, exp(−ζω t) |cos(ω_d t + φ)| is at most 1 and reaches at least the larger of cos φ and of its next
    extremum. k is the inverse of the minimum of that larger value over φ.
    """
    extremum, decay = pi - asin(servo.damping), servo.damping / sqrt(1.0 - servo.damping**2)
    low, high = 0.0, 0.5 * pi
    for _ in range(BISECTION_STEPS):
        middle = 0.5 * (low + high)
        if cos(middle) > sqrt(1.0 - servo.damping**2) * exp(-decay * (extremum - middle)):
            low = middle
        else:
            high = middle
    return 1.0 / cos(high)
