"""Servo identification by least squares from the best of a grid of starting points, with covariance.

The response to steps is in closed form. The slew-limited target is piecewise linear; between its breakpoints the error
is the ramp lag −2ζ slope / ω plus the free oscillation Re(2 A exp(λ t)).
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import product

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.quantity import format_quantity
from optodrive.core.types.arrays import BoolArray, FloatArray, ReadOnlyArrays
from optodrive.device.gate_timing import pole_per_s, settling_s
from optodrive.device.servo import Servo
from optodrive.lab.inference.fit import fit_residuals
from optodrive.lab.servo_identification.effect_fit import Linearity, ServoData, ServoRecord
from optodrive.lab.servo_identification.effects import (
    FORMS,
    LINEAR_FORM,
    SLEW,
    SLEW_LIMIT,
    NonlinearServo,
    change_command,
)
from optodrive.lab.servo_identification.records import AXES, GAIN_TOLERANCE, Steps, StepTrace

LOWER_BOUNDS = np.array([np.log(50.0), 0.05, 0.0, 1e-6])
UPPER_BOUNDS = np.array([np.log(3e4), 0.999, 0.01, 1.0])
"""Of the fitted parameters: logarithm of the frequency, damping, delay in s, 1 / slew in s/rad."""
DERIVATIVE_STEPS = np.array([1e-5, 1e-5, 1e-9, 1e-7])
START_SAMPLES_MAX = 3000
"""Maximum number of samples for the comparison of starting points."""
FIT_SAMPLES_MAX = 100_000
STARTS_REFINED = 4
SLEW_SIGMAS_MIN = 5.0
"""Minimum distance of 1 / slew from 0 in sigmas; below it the steps were too small to identify the slew."""
SAMPLE_SPACING_MAX = 0.4
"""Maximum sample spacing in periods of the servo."""
FREQUENCY_UNCERTAINTY_MAX = 0.1
SERVO_SAMPLES = 60
CONFIDENCE = 0.95

FREQUENCIES_HZ = np.geomspace(150.0, 8000.0, 16)
DAMPINGS = (0.35, 0.6, 0.9)
SLEWS = (1e6, 1000.0, 400.0, 160.0, 70.0, 30.0, 10.0)
DELAY_SHARES = (0.0, 0.3, 0.6, 0.9)


Solved = tuple[FloatArray, float, float]
"""Residual in units of the noise, gain and offset."""
Solve = Callable[[FloatArray], Solved]
"""Function of the packed parameters."""


@dataclass(frozen=True, eq=False)
class IdentifiedServo(ReadOnlyArrays):
    """The identified servo of a mirror.

    covariance: [4, 4] of log frequency, damping, delay (s), 1/slew (s/rad)
    gain, offset_rad: of the measured angle; misfit: rms residual in units of the noise
    slew_identified: if not, servo.slew is assumed
    """

    trace: StepTrace
    servo: Servo
    covariance: FloatArray
    gain: float
    offset_rad: float
    misfit: float
    slew_identified: bool

    @property
    def residual_rad(self) -> float:
        """Rms residual of the angles, weighted by their noise, rad."""
        return self.misfit * self.trace.noise_rad

    @property
    def sigma(self) -> FloatArray:
        """Standard deviation of each parameter, [4]."""
        return np.asarray(np.sqrt(np.diag(self.covariance)), dtype=np.float64)

    def sample_servos(self) -> list[Servo]:
        """Return SERVO_SAMPLES servos sampled from the covariance."""
        random = np.random.default_rng(0)
        packed = random.multivariate_normal(_pack(self.servo), self.covariance, SERVO_SAMPLES, method="eigh")
        return [_unpack(each) for each in np.clip(packed, LOWER_BOUNDS, UPPER_BOUNDS)]

    def settling_s(self, step_rad: float, tolerance_rad: float) -> tuple[float, float, float]:
        """Return the settling time by the gate's definition, and its 95 % interval, s."""
        times_s = [settling_s(servo, step_rad, tolerance_rad) for servo in self.sample_servos()]
        best_s = settling_s(self.servo, step_rad, tolerance_rad)
        low, high = np.quantile(times_s, [0.5 - CONFIDENCE / 2, 0.5 + CONFIDENCE / 2]).tolist()
        return best_s, min(low, best_s), max(high, best_s)


def identify(where: str, trace: StepTrace, assumed_slew_rad_per_s: float) -> IdentifiedServo:
    """Fit a servo to a trace. Keep the assumed slew if the steps do not identify it.

    Raise InputError, naming `where`, if sampling or noise do not permit an identification.
    """
    start_trace, fit_trace = _decimate(trace, START_SAMPLES_MAX), _decimate(trace, FIT_SAMPLES_MAX)
    free, solve_start, solve = np.full(4, True), partial(_residual, start_trace), partial(_residual, fit_trace)
    starts = sorted(_generate_starts(trace), key=lambda start: float((solve_start(start)[0] ** 2).sum()))
    initial = min((_fit(solve_start, start, free) for start in starts[:STARTS_REFINED]), key=lambda found: found[1])[0]
    best, _, covariance = _fit(solve, initial, free)
    slew_identified = bool(best[3] > SLEW_SIGMAS_MIN * np.sqrt(covariance[3, 3]))
    if not slew_identified and abs(1.0 / assumed_slew_rad_per_s - best[3]) < 3.0 * np.sqrt(covariance[3, 3]):
        free[3] = False
        best[3] = 1.0 / assumed_slew_rad_per_s
        best, _, covariance = _fit(solve, best, free)
    return _build(where, trace, solve, best, covariance, slew_identified)


def identify_excitation(
    where: str, records: list[ServoRecord], axis: int, found: Linearity, assumed_slew_rad_per_s: float
) -> IdentifiedServo:
    """Fit a servo to records of any excitation, with a slew limit if that is the effect found.

    Raise InputError like `identify`.
    """
    limited = found.probability[SLEW_LIMIT] > 0.5
    start = found.fits[SLEW_LIMIT]
    base = start.servo.base if limited else found.linear
    data = ServoData(records, float(np.exp(base[0])))
    stride = max(1, len(data.target) // FIT_SAMPLES_MAX)
    form = next(each for each in FORMS if each.kind == SLEW) if limited else LINEAR_FORM

    def solve(packed: FloatArray) -> Solved:
        servo = _unpack(packed)
        core = np.array([np.log(2.0 * np.pi * servo.frequency), servo.damping, servo.delay])
        return data.compare(NonlinearServo(form, core, (servo.slew, 1.0)), stride)

    frequency = float(np.exp(base[0])) / (2.0 * np.pi)
    slew = start.servo.effect[0] if limited else assumed_slew_rad_per_s
    packed = _pack(Servo(frequency, float(base[1]), float(base[2]), slew))
    free = np.array([True, True, True, limited])
    best, _, covariance = _fit(solve, packed, free)
    gain = solve(best)[1]
    if abs(gain - 1.0) > GAIN_TOLERANCE:
        angle = "the mirror's mechanical angle in rad, axes not exchanged or inverted"
        expected = f"within {GAIN_TOLERANCE:.0%} of 1: {angle}"
        raise InputError(f"{where}: mirror_{AXES[axis]}_rad", f"{gain:.2g} times the {AXES[axis]} commands", expected)
    return _build(where, StepTrace(axis, tuple(records)), solve, best, covariance, limited)


def _build(
    where: str, trace: StepTrace, solve: Solve, best: FloatArray, covariance: FloatArray, slew_identified: bool
) -> IdentifiedServo:
    """Return the servo of the best parameters. Raise InputError if it is not identifiable."""
    residual, gain, offset_rad = solve(best)
    misfit = float(np.sqrt((residual**2).mean()))
    found = IdentifiedServo(trace, _unpack(best), covariance, gain, offset_rad, misfit, slew_identified)
    spacing_s, servo = trace.spacing_s, found.servo
    if servo.frequency * spacing_s > SAMPLE_SPACING_MAX or 2.0 * found.sigma[0] > FREQUENCY_UNCERTAINTY_MAX:
        spacing, frequency = format_quantity(spacing_s, "s"), format_quantity(servo.frequency, "Hz")
        sampled = f"{spacing} a sample, {frequency} ± {2 * found.sigma[0]:.1%}"
        expected = "finer sampling or more steps: the sampling is too coarse, or the noise too high, for this servo"
        raise InputError(f"{where}: mirror_{AXES[trace.axis]}_rad", sampled, expected)
    return found


def _unpack(packed: FloatArray) -> Servo:
    return Servo(float(np.exp(packed[0])), float(packed[1]), float(packed[2]), float(1.0 / packed[3]))


def _pack(servo: Servo) -> FloatArray:
    return np.array([np.log(servo.frequency), servo.damping, servo.delay, 1.0 / servo.slew])


def _residual(trace: StepTrace, packed: FloatArray) -> Solved:
    """Return the residual in units of the noise, with the gain and offset that minimise it."""
    servo, value = _unpack(packed), trace.value
    model = np.concatenate([step_response_rad(servo, Steps(run.at_s, run.command), run.t_s) for run in trace.runs])
    weight = trace.noise**-2.0 / (trace.noise**-2.0).sum()
    model_mean, mean = float(weight @ model), float(weight @ value)
    around = model - model_mean
    gain = float((weight * around) @ (value - mean) / max(float((weight * around) @ around), 1e-300))
    return (value - mean - gain * around) / trace.noise, gain, mean - gain * model_mean


def _fit(solve: Solve, start: FloatArray, free: BoolArray) -> tuple[FloatArray, float, FloatArray]:
    """Fit from a starting point. Return parameters, cost, and covariance with zeros for fixed parameters."""
    bounds = LOWER_BOUNDS, UPPER_BOUNDS
    found = fit_residuals(lambda x: solve(x)[0], start, bounds, DERIVATIVE_STEPS, free=free, evaluations=80)
    degrees_of_freedom = max(1, len(found.residual) - int(free.sum()) - 2)
    return found.x, 0.5 * found.chi2, found.covariance * (found.chi2 / degrees_of_freedom)


def _generate_starts(trace: StepTrace) -> Iterator[FloatArray]:
    rise_s = _rise_s(trace)
    for frequency, damping, slew, share in product(FREQUENCIES_HZ, DAMPINGS, SLEWS, DELAY_SHARES):
        yield _pack(Servo(frequency, damping, min(share * rise_s, 0.009), slew))


def _rise_s(trace: StepTrace) -> float:
    """Return the median time in which the mirror covers a tenth of a step, s, an upper bound of the delay."""
    shortest_s = []
    for run in trace.runs:
        for row in range(1, len(run.at_s)):
            step_rad = run.command[row] - run.command[row - 1]
            begin, end = np.searchsorted(run.t_s, [run.at_s[row], run.at_s[row] + 0.01])
            progress = (run.value[begin:end] - run.command[row - 1]) / step_rad
            reached = np.flatnonzero(progress > 0.1)
            if len(reached):
                shortest_s.append(run.t_s[begin + reached[0]] - run.at_s[row])
    return float(np.median(shortest_s)) if shortest_s else 1e-4


def _decimate(trace: StepTrace, max_samples: int) -> StepTrace:
    """Decimate a trace evenly to about max_samples."""
    part = slice(None, None, -(-len(trace.value) // max_samples))
    runs = (replace(run, t_s=run.t_s[part], value=run.value[part], use=run.use[part]) for run in trace.runs)
    return replace(trace, runs=tuple(runs))


def step_response_rad(servo: Servo, steps: Steps, t_s: FloatArray) -> FloatArray:
    """Return the angle at t_s, rad, from steady state at the first command. The damping must be below 1."""
    pole = pole_per_s(servo)
    ramp_lag_s = -2.0 * servo.damping / (2.0 * np.pi * servo.frequency)
    begin_s, target, slope = change_command(SLEW, (servo.slew, 1.0), steps.at_s + servo.delay, steps.command_rad)
    modes = np.empty(len(target), dtype=np.complex128)
    angle, speed = target[0], 0.0
    for row in range(len(target)):
        error, rate = angle - target[row] - ramp_lag_s * slope[row], speed - slope[row]
        # e = 2 Re(A), e' = 2 Re(λ A)
        modes[row] = mode = 0.5 * complex(error, (pole.real * error - rate) / pole.imag)
        if row + 1 < len(target):
            later_s = begin_s[row + 1] - begin_s[row]
            transient = 2.0 * mode * np.exp(pole * later_s)
            angle = target[row] + slope[row] * (later_s + ramp_lag_s) + transient.real
            speed = slope[row] + (pole * transient).real
    row_of = np.clip(np.searchsorted(begin_s, t_s, side="right") - 1, 0, None)
    since_s = np.maximum(t_s - begin_s[row_of], 0.0)
    transient = 2.0 * (modes[row_of] * np.exp(pole * since_s)).real
    return np.asarray(target[row_of] + slope[row_of] * (since_s + ramp_lag_s) + transient, dtype=np.float64)
