"""Which effect a servo has beside its linear response: every form fitted, compared on runs that no fit has seen.

Every candidate, the linear one included, also has a free linear response, so that linear dynamics beyond the second
order are no effect.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.linalg import expm

from optodrive.core.types.arrays import BoolArray, FloatArray, freeze_arrays
from optodrive.lab.inference.fit import Prior, fit_residuals
from optodrive.lab.servo_identification.effects import (
    EFFECTS,
    FORMS,
    LINEAR_FORM,
    SATURATION,
    SLEW_LIMIT,
    Form,
    integrate,
)

LINEAR, OTHER = "linear", "none_of_these"
STEPS_PER_TIME_CONSTANT, STEPS_MAX = 7, 150_000
COMMAND_TAPS, ANGLE_TAPS, TAPS_PER_PERIOD = 16, 20, 8
"""Free linear response: its taps of the command and of the linear servo's angle, and their number per period."""
FORM_TAPS = 3
"""Taps of the angle of a servo with an effect, for dynamics beyond the second order."""
UNSTABLE = 1e9
"""Angle in units of the noise beyond which a simulation is unstable."""
FIT_SAMPLES_MAX = 3000
PRIOR = np.array([10.0, 10.0, 10.0])
"""Weak prior deviation of log ω, ζ and delay (s), which keeps near the linear fit what nothing identifies."""
FREQUENCY_SHIFTS = (0.0, 0.4, 0.8)
"""Starts of log ω above the linear fit's for effects that slow a servo down."""
START_FACTORS, STARTS_REFINED = (0.3, 0.5, 0.8, 1.25, 2.0, 3.3), 3
"""Starts of the linear fit's frequency relative to the expected one, and how many of them are refined."""
CONTENDER = 4.0
"""Forms within this factor of the least mean squares are fitted completely."""
MODEL_ERROR = 3e-4
"""Relative error of a model, rms, that says nothing against it."""
SYSTEMATIC_WEIGHT = 5.0
"""Odds between two candidates are the ratio of their mean squares to this power where both are far above the noise."""
OTHER_SHARE, OTHER_ODDS = 0.2, 0.05
"""An unknown effect would leave this share of the linear residual's excess; prior odds of one."""
LINEAR_ODDS = 1000.0


@dataclass(frozen=True, eq=False)
class ServoRecord:
    """One run of one axis: commands [k] that hold from at_s on, angles [m] at t_s, rms noise of a sample.

    use: [m], False where a sample is not compared; held_out: the run is for comparison only
    """

    at_s: FloatArray
    command: FloatArray
    t_s: FloatArray
    value: FloatArray
    use: BoolArray
    held_out: bool
    noise: float

    def __post_init__(self) -> None:
        freeze_arrays(self)


@dataclass(frozen=True)
class FormFit:
    """A fitted form.

    base: log ω, ζ, delay in s; effect, scale: parameters of `integrate`; misfit2: mean squares of held-out
    samples in units of the noise
    """

    form: Form
    base: tuple[float, float, float]
    effect: tuple[float, float]
    scale: float
    misfit2: float


@dataclass(frozen=True)
class Linearity:
    """Answer.

    probability: of each effect, of LINEAR and of OTHER; fits: the best form of each; gain: share of the rms error of
    held-out samples that the best one removes; linear: log ω, ζ and delay (s) of the linear servo
    """

    probability: dict[str, float]
    fits: dict[str, FormFit]
    gain: float
    linear: FloatArray


class ServoData:
    """Records of one axis on the grids of the integration."""

    def __init__(self, records: list[ServoRecord], omega: float) -> None:
        self.records = records
        self.tap_s = 2.0 * np.pi / omega / TAPS_PER_PERIOD
        span_s = sum(float(each.t_s[-1] - each.at_s[0]) for each in records)
        self.h_s = max(1.0 / (STEPS_PER_TIME_CONSTANT * omega), span_s / STEPS_MAX)
        self.grids = [np.arange(each.at_s[0], each.t_s[-1] + self.h_s, self.h_s) for each in records]
        self.areas = [np.concatenate([[0.0], np.cumsum(np.diff(each.at_s) * each.command[:-1])]) for each in records]
        self.target = np.concatenate([(each.value / each.noise)[each.use] for each in records])
        self.drives = lru_cache(maxsize=6)(self._drives)
        self.sample_times_s = lru_cache(maxsize=2)(self._sample_times_s)

    def _area(self, row: int, t_s: FloatArray) -> FloatArray:
        """Return the integral of a record's command from its beginning, also before and after it."""
        each = self.records[row]
        before, after = np.minimum(t_s - each.at_s[0], 0.0), np.maximum(t_s - each.at_s[-1], 0.0)
        inside = np.interp(t_s, each.at_s, self.areas[row])
        area: FloatArray = inside + each.command[0] * before + each.command[-1] * after
        return area

    def _drives(self, delay_s: float) -> list[FloatArray]:
        edges = [np.append(grid - self.h_s, grid[-1]) - delay_s for grid in self.grids]
        return [np.diff(self._area(row, each)) / self.h_s for row, each in enumerate(edges)]

    def _sample_times_s(self, stride: int) -> list[FloatArray]:
        """Return the times of every stride-th of all used samples, by record."""
        used_s = [each.t_s[each.use] for each in self.records]
        begins = np.cumsum([0, *map(len, used_s)]).tolist()
        return [t_s[-begin % stride :: stride] for begin, t_s in zip(begins, used_s, strict=False)]

    def integrate(self, form: Form, base: FloatArray, effect: tuple[float, float], scale: float) -> list[FloatArray]:
        """Return the angle on the grid of each record."""
        omega, zeta = float(np.exp(base[0])), float(base[1])
        system = np.array([[0.0, 1.0, 0.0], [-omega * omega, -2.0 * zeta * omega, 1.0], [0.0, 0.0, 0.0]])
        step = np.ascontiguousarray(expm(system * self.h_s)[:2])
        angles = []
        for drive in self.drives(float(base[2])):
            angles.append(np.empty(len(drive)))
            integrate(form.kind, *effect, omega, zeta, step, drive, self.h_s, scale, angles[-1])
        return angles

    def simulate(
        self,
        form: Form,
        base: FloatArray,
        effect: tuple[float, float],
        scale: float,
        taps: int = FORM_TAPS,
        stride: int = 1,
    ) -> FloatArray:
        """Return the angles at every stride-th used sample, and each tap earlier, in units of noise, [m, taps]."""
        parts = []
        angles, times_s = self.integrate(form, base, effect, scale), self.sample_times_s(stride)
        for each, grid, angle, t_s in zip(self.records, self.grids, angles, times_s, strict=True):
            shifted = [np.interp(t_s - at * self.tap_s, grid, angle) for at in range(taps)]
            parts.append(np.column_stack(shifted) / each.noise)
        return np.concatenate(parts)

    def free_response(self, base: FloatArray) -> FloatArray:
        """Return the columns of a free linear response, [m, …]: offset, taps of command and of linear angle."""
        blocks = []
        for row, each in enumerate(self.records):
            t_s = each.t_s[each.use]
            area = np.column_stack([self._area(row, t_s - at * self.tap_s) for at in range(COMMAND_TAPS + 1)])
            blocks.append(np.column_stack([np.ones(len(t_s)), -np.diff(area, axis=1) / self.tap_s]) / each.noise)
        return np.column_stack([np.concatenate(blocks), self.simulate(LINEAR_FORM, base, (1.0, 1.0), 1.0, ANGLE_TAPS)])


def fit_linear(records: list[ServoRecord], omega: float) -> FloatArray:
    """Fit a linear second-order servo with delay, gain and offset from about omega: log ω, ζ, delay in s."""
    data = ServoData(records, omega)
    stride = max(1, len(data.target) // FIT_SAMPLES_MAX)
    constant = np.concatenate([np.full(each.use.sum(), 1.0 / each.noise) for each in records])[::stride]
    target = data.target[::stride]

    def residual(base: FloatArray) -> FloatArray:
        model = np.column_stack([constant, data.simulate(LINEAR_FORM, base, (1.0, 1.0), 1.0, 1, stride)])
        return np.asarray(target - model @ np.linalg.lstsq(model, target, rcond=None)[0])

    period_s = 2.0 * np.pi / omega
    low, high = np.array([np.log(omega / 6.0), 0.02, 0.0]), np.array([np.log(omega * 6.0), 3.0, period_s])
    starts = [np.array([np.log(omega * factor), 0.6, 0.03 * period_s]) for factor in START_FACTORS]
    starts.sort(key=lambda each: float((residual(each) ** 2).sum()))
    found = [
        fit_residuals(residual, each, (low, high), np.array([1e-4, 1e-4, 1e-4 * period_s]), evaluations=30)
        for each in starts[:STARTS_REFINED]
    ]
    return min(found, key=lambda each: each.chi2).x


def find_effect(records: list[ServoRecord], omega: float) -> Linearity:
    """Fit every form to the runs that are not held out, and weigh them on those that are.

    omega: rad/s, roughly the servo's
    """
    train, test = ([each for each in records if each.held_out is held_out] for held_out in (False, True))
    base = fit_linear(train, omega)
    fits = EffectFits(train, test, base)
    screened = {form: fits.fit(form, completely=False) for form in FORMS}
    best = min(each.misfit2 for each in screened.values())
    firsts = [
        min((form for form in FORMS if form.effect == effect), key=lambda each: screened[each].misfit2)
        for effect in EFFECTS
    ]
    refined = {
        form: fits.fit(form, True, found) if form in firsts or found.misfit2 <= CONTENDER * best else found
        for form, found in screened.items()
    }
    named = {LINEAR: fits.fit(LINEAR_FORM, completely=True)}
    for effect in EFFECTS:
        named[effect] = min(
            (each for form, each in refined.items() if form.effect == effect), key=lambda each: each.misfit2
        )
    return _weigh(named, test, base)


def _weigh(fits: dict[str, FormFit], test: list[ServoRecord], base: FloatArray) -> Linearity:
    linear, winner = fits[LINEAR].misfit2, min(each.misfit2 for each in fits.values())
    error2 = float(np.mean([MODEL_ERROR**2 * np.var(each.value[each.use]) / each.noise**2 for each in test]))
    count = float(sum(each.use.sum() for each in test))
    # What exceeds the noise is systematic: more samples do not make it more certain.
    systematic = (max(winner - 1.0, 0.0) + error2) / (winner + error2)
    count /= 1.0 + count / (2.0 * SYSTEMATIC_WEIGHT) * systematic
    score = {name: -0.5 * count * np.log(each.misfit2 + error2) for name, each in fits.items()}
    floor = min(1.0, winner)
    unknown = floor + OTHER_SHARE * max(linear - floor, 0.0)
    score[OTHER] = -0.5 * count * np.log(unknown + error2) + np.log(OTHER_ODDS)
    score[LINEAR] += np.log(LINEAR_ODDS)
    return Linearity(normalise(score), fits, 1.0 - float(np.sqrt(winner / linear)), base)


def normalise(score: dict[str, float]) -> dict[str, float]:
    """Return probabilities from logarithms of weights."""
    peak = max(score.values())
    weight = {name: float(np.exp(value - peak)) for name, value in score.items()}
    return {name: value / sum(weight.values()) for name, value in weight.items()}


class EffectFits:
    """Fits of forms to training runs, each with a free linear response, and their errors on the others."""

    def __init__(self, train: list[ServoRecord], test: list[ServoRecord], base: FloatArray) -> None:
        self.base, omega = base, float(np.exp(base[0]))
        self.train, self.test = ServoData(train, omega), ServoData(test, omega)
        self.columns, self.test_columns = self.train.free_response(base), self.test.free_response(base)
        self.scales = self._measure_scales()
        self.stride = max(1, len(self.columns) // FIT_SAMPLES_MAX)
        u, singular, _ = np.linalg.svd(self.columns[:: self.stride], full_matrices=False)
        self.q = u[:, singular > 1e-7 * singular[0]]
        y = self.train.target[:: self.stride]
        self.y = y - self.q @ (self.q.T @ y)

    def _measure_scales(self) -> dict[str, float]:
        omega, zeta, h_s = float(np.exp(self.base[0])), float(self.base[1]), self.train.h_s
        command = np.concatenate(self.train.drives(float(self.base[2])))
        angle = np.concatenate(self.train.integrate(LINEAR_FORM, self.base, (1.0, 1.0), 1.0))
        speed, largest = np.gradient(angle, h_s), float(np.abs(command).max())
        return {
            "one": 1.0,
            "command": largest,
            "slope": min(float(np.abs(np.diff(command)).max() / h_s), largest * omega),
            "angle": float(np.abs(angle).max()),
            "speed": float(np.abs(speed).max()),
            "error": float(np.abs(command - angle).max()),
            "acceleration": float(np.abs(command - angle - 2.0 * zeta / omega * speed).max()),
        }

    def fit(self, form: Form, completely: bool, start: FormFit | None = None) -> FormFit:
        """Fit a form: the effect's parameters alone, or all of them."""
        period_s = 2.0 * np.pi / float(np.exp(self.base[0]))
        unit = np.array([1.0, 1.0, period_s])
        spans = (form.first, form.second)
        size = np.array([self.scales[each.scale] for each in spans])
        free = np.array([True] * 3 + [each.low < each.high for each in spans])
        free[:3] &= completely
        is_log = np.array([each.low > 0.0 for each in spans])

        def pack(pair: Sequence[float] | FloatArray) -> FloatArray:
            packed: FloatArray = np.where(is_log, np.log(np.where(is_log, pair, 1.0)), pair)
            return packed

        low = np.concatenate(
            [[-0.7, 0.02 - self.base[1], -self.base[2] / period_s], pack([each.low for each in spans])]
        )
        high = np.concatenate([[1.2, 1.0, 0.5], pack([each.high for each in spans])])
        shifts = FREQUENCY_SHIFTS if form.effect in (LINEAR, SLEW_LIMIT, SATURATION) else (0.0,)
        starts = [np.array([at, 0.0, 0.0, *pack(pair)]) for pair in form.starts for at in shifts]
        if start is not None:
            starts = [np.array([*((np.array(start.base) - self.base) / unit), *pack(np.array(start.effect) / size)])]

        def unpack(x: FloatArray) -> tuple[FloatArray, tuple[float, float]]:
            first, second = np.where(is_log, np.exp(np.where(is_log, x[3:], 0.0)), x[3:]) * size
            return self.base + x[:3] * unit, (float(first), float(second))

        def residual(x: FloatArray) -> FloatArray:
            simulated = self.train.simulate(form, *unpack(x), self.scales["angle"], stride=self.stride)
            if not np.abs(simulated).max() < UNSTABLE:
                return np.asarray(self.y * UNSTABLE)
            simulated = simulated - self.q @ (self.q.T @ simulated)
            left = self.y - simulated @ np.linalg.lstsq(simulated, self.y, rcond=1e-8)[0]
            return np.asarray(left)

        prior = Prior(np.zeros(5), np.append(PRIOR / np.sqrt(len(self.y)), [np.inf, np.inf]))
        best = min(starts, key=lambda each: float((residual(each) ** 2).sum()))
        found = fit_residuals(
            residual, best, (low, high), 1e-3, free=free, prior=prior, evaluations=25 if completely else 6
        )
        best = found.x
        base, effect = unpack(best)
        core = float(base[0]), float(base[1]), float(base[2])
        return FormFit(form, core, effect, self.scales["angle"], self._misfit2(form, base, effect))

    def _misfit2(self, form: Form, base: FloatArray, effect: tuple[float, float]) -> float:
        scale = self.scales["angle"]
        model = np.column_stack([self.columns, self.train.simulate(form, base, effect, scale)])
        if not np.abs(model).max() < UNSTABLE:
            return np.inf
        weights = np.linalg.lstsq(model, self.train.target, rcond=1e-8)[0]
        model = np.column_stack([self.test_columns, self.test.simulate(form, base, effect, scale)])
        if not np.abs(model).max() < UNSTABLE:
            return np.inf
        return float(((self.test.target - model @ weights) ** 2).mean())
