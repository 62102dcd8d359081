"""Which effect a servo has beside its linear response: every form fitted, compared on data that no fit has seen.

Every candidate, the linear one included, also has a free linear response, so that linear dynamics beyond the second
order are no effect. The verdict is `lab.inference`'s: this module states the evidence.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from optodrive.core.types.arrays import BoolArray, FloatArray, ReadOnlyArrays
from optodrive.core.types.discrepancy import Probabilities
from optodrive.device.servo import Servo
from optodrive.lab.inference.claim import Alternative, Claim, Evidence, HeldOutChange, claim
from optodrive.lab.inference.fit import Prior, fit_residuals
from optodrive.lab.servo_identification.effects import (
    EFFECTS,
    FORMS,
    LINEAR_FORM,
    NO_EFFECT,
    SATURATION,
    SLEW_LIMIT,
    NonlinearServo,
    Pair,
    ServoNonlinearity,
    build_drive,
    sample_angle,
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
"""Weak prior deviation of log ω, ζ and delay (in periods), which keeps near the linear fit what nothing identifies."""
FREQUENCY_SHIFTS = (0.0, 0.4, 0.8)
"""Starts of log ω above the linear fit's for effects that slow a servo down, beside the expected one."""
START_FACTORS, STARTS_REFINED = (0.3, 0.5, 0.8, 1.25, 2.0, 3.3), 3
"""Starts of the linear fit's frequency relative to the expected one, and how many of them are refined."""
CONTENDER, OUTSIDER = 4.0, 10.0
"""Forms within this factor of the least mean squares of their effect, or of this factor of all, are fitted completely.

The best form of each effect always is."""
MODEL_ERROR = 3e-4
"""Relative error of a model, rms, that says nothing against it."""
SYSTEMATIC_WEIGHT = 5.0
"""Odds between two candidates are the ratio of their mean squares to this power where both are far above the noise."""
OTHER_SHARE, OTHER_ODDS = 0.2, 0.05
"""An unknown effect would leave this share of the linear residual's excess; prior odds of one."""
LINEAR_ODDS = 1000.0
ROUNDING = 1e-6
"""Part of simulated columns below which nothing is left of them beside the free linear response."""
AT_END = 0.01
"""Part of a parameter's range beside an end within which a fit has ended there."""


@dataclass(frozen=True, eq=False)
class ServoRecord(ReadOnlyArrays):
    """One run of one axis: commands [k] that hold from at_s on, angles [m] at t_s, rms noise of a sample.

    use: [m], False where a sample is not compared; held_out: the run is for comparison only; level: rms of the commands
    """

    at_s: FloatArray
    command: FloatArray
    t_s: FloatArray
    value: FloatArray
    use: BoolArray
    held_out: bool
    noise: float
    level: float = 0.0


@dataclass(frozen=True, eq=False)
class FormFit:
    """A fitted form.

    residual: of the samples that are compared, in units of the noise; misfit2: its mean square; doubt: why the size of
    its effect is uncertain, or ""
    """

    servo: NonlinearServo
    residual: FloatArray
    misfit2: float
    doubt: str


@dataclass(frozen=True, eq=False)
class Linearity:
    """Answer.

    fits: the best form of each effect, and LINEAR; gain: share of the rms error that the best one removes; linear:
    log ω, ζ and delay (s) of the linear servo
    """

    claim: Claim
    probabilities: Probabilities
    fits: dict[str, FormFit]
    gain: float
    linear: FloatArray

    @property
    def probability(self) -> dict[str, float]:
        """Probability of each effect, of LINEAR and of OTHER."""
        return name_probabilities(self.probabilities)

    @property
    def effect(self) -> str | None:
        """The effect that the claim names, LINEAR if it names none, None if it is not certain."""
        return {"cause": self.claim.causes[:1], "none": (LINEAR,)}.get(self.claim.verdict, (None,))[0]


class ServoData:
    """Records of one axis on the grids of the integration."""

    def __init__(self, records: list[ServoRecord], omega: float, fastest: float = 0.0) -> None:
        """omega, fastest: rad/s of the linear response, and of a servo that an effect slows down to that."""
        self.records = records
        self.tap_s = 2.0 * np.pi / omega / TAPS_PER_PERIOD
        span_s = sum(float(each.t_s[-1] - each.at_s[0]) for each in records)
        self.h_s = max(1.0 / (STEPS_PER_TIME_CONSTANT * max(omega, fastest)), span_s / STEPS_MAX)
        self.cells = [int((each.t_s[-1] - each.at_s[0]) / self.h_s) + 2 for each in records]
        self.used_s = [each.t_s[each.use] for each in records]
        self.noise = np.concatenate([np.full(each.use.sum(), each.noise) for each in records])
        self.target = np.concatenate([(each.value / each.noise)[each.use] for each in records])
        self.drives = lru_cache(maxsize=6)(self._drives)

    def _drives(self, form: ServoNonlinearity, effect: Pair, delay_s: float, parts: int) -> list[FloatArray]:
        """Return mean and slope of each record's command in the parts of its cells, [n, 2]."""
        h_s = self.h_s / parts
        return [
            build_drive(form, effect, each.at_s, each.command, (each.at_s[0] - h_s - delay_s, h_s, parts * cells))
            for each, cells in zip(self.records, self.cells, strict=True)
        ]

    def integrate(self, servo: NonlinearServo) -> list[FloatArray]:
        """Return angle and speed on the grid of each record, [n, 2]."""
        form, base = servo.form, servo.base
        of_command = (form, servo.effect) if form.changes_command else (LINEAR_FORM, NO_EFFECT)
        drives = self.drives(*of_command, float(base[2]), form.substeps)
        return [servo.respond(drive, self.h_s / form.substeps) for drive in drives]

    def simulate(self, servo: NonlinearServo, taps: int = FORM_TAPS, stride: int = 1) -> FloatArray:
        """Return the angles at every stride-th used sample, and each tap earlier, in units of noise, [m, taps]."""
        columns, begin, row = np.empty((len(self.target[::stride]), taps)), 0, 0
        for each, states, t_s in zip(self.records, self.integrate(servo), self.used_s, strict=True):
            mine, angle = t_s[-begin % stride :: stride], np.empty(len(t_s[-begin % stride :: stride]))
            for tap in range(taps):
                sample_angle(states, each.at_s[0], self.h_s / servo.form.substeps, mine - tap * self.tap_s, angle)
                columns[row : row + len(mine), tap] = angle / each.noise
            begin, row = begin + len(t_s), row + len(mine)
        return columns

    def compare(self, servo: NonlinearServo, stride: int) -> tuple[FloatArray, float, float]:
        """Return the residual of a servo with free gain and offset at every stride-th used sample, and these two."""
        target = self.target[::stride]
        model = np.column_stack([1.0 / self.noise[::stride], self.simulate(servo, 1, stride)])
        offset, gain = np.linalg.lstsq(model, target, rcond=None)[0]
        return np.asarray(target - model @ [offset, gain]), float(gain), float(offset)

    def free_response(self, base: FloatArray) -> FloatArray:
        """Return the columns of a free linear response, [m, …]: offset, taps of command and of linear angle."""
        blocks = []
        for each, t_s in zip(self.records, self.used_s, strict=True):
            area = np.concatenate([[0.0], np.cumsum(np.diff(each.at_s) * each.command[:-1])])
            shifted_s = t_s[:, None] - np.arange(COMMAND_TAPS + 1) * self.tap_s
            before, after = np.minimum(shifted_s - each.at_s[0], 0.0), np.maximum(shifted_s - each.at_s[-1], 0.0)
            areas = np.interp(shifted_s, each.at_s, area) + each.command[0] * before + each.command[-1] * after
            blocks.append(np.column_stack([np.ones(len(t_s)), -np.diff(areas, axis=1) / self.tap_s]) / each.noise)
        return np.column_stack([np.concatenate(blocks), self.simulate(NonlinearServo(LINEAR_FORM, base), ANGLE_TAPS)])


def fit_linear(records: list[ServoRecord], omega: float) -> FloatArray:
    """Fit a linear second-order servo with delay, gain and offset from about omega: log ω, ζ, delay in s."""
    data = ServoData(records, omega)
    stride = max(1, len(data.target) // FIT_SAMPLES_MAX)

    def residual(base: FloatArray) -> FloatArray:
        return data.compare(NonlinearServo(LINEAR_FORM, base), stride)[0]

    period_s = 2.0 * np.pi / omega
    low, high = np.array([np.log(omega / 6.0), 0.02, 0.0]), np.array([np.log(omega * 6.0), 3.0, period_s])
    starts = [np.array([np.log(omega * factor), 0.6, 0.03 * period_s]) for factor in START_FACTORS]
    starts.sort(key=lambda each: float((residual(each) ** 2).sum()))
    step, best_starts = np.array([1e-4, 1e-4, 1e-4 * period_s]), starts[:STARTS_REFINED]
    found = [fit_residuals(residual, each, (low, high), step, evaluations=30) for each in best_starts]
    return min(found, key=lambda each: each.chi2).x


def find_effect(records: list[ServoRecord], omega: float, servo: Servo | None = None) -> Linearity:
    """Fit every form to the training runs, and make the claim that the held-out runs permit.

    omega: rad/s, roughly the servo's; servo: identified from steps, a further start of a servo with a slew limit
    """
    base = fit_linear([each for each in records if not each.held_out], omega)
    fits = EffectFits(records, base, omega)
    screened = {form: fits.fit(form, completely=False) for form in FORMS}
    best = min(each.misfit2 for each in screened.values())
    named = {LINEAR: fits.fit(LINEAR_FORM, completely=True)}
    for effect in EFFECTS:
        forms = sorted((each for each in FORMS if each.effect == effect), key=lambda each: screened[each].misfit2)
        limit = CONTENDER * min(screened[forms[0]].misfit2, OUTSIDER * best)
        contenders = [each for each in forms if each is forms[0] or screened[each].misfit2 <= limit]
        refined = [fits.fit(each, True, screened[each].servo) for each in contenders]
        if effect == SLEW_LIMIT and servo is not None:
            core = np.array([np.log(2.0 * np.pi * servo.frequency), servo.damping, servo.delay])
            refined.append(fits.fit(FORMS[0], True, NonlinearServo(FORMS[0], core, (servo.slew, 1.0))))
        named[effect] = min(refined, key=lambda each: each.misfit2)
    probabilities = fits.weigh(named)
    linear, winner = named[LINEAR], min(named.values(), key=lambda each: each.misfit2)
    misfit2 = {name: each.misfit2 for name, each in named.items()}
    changes = {name: fits.list_changes(each, linear) for name, each in named.items()}
    doubts = {name: each.doubt for name, each in named.items()}
    found = claim_effect(probabilities, misfit2, min(1.0, winner.misfit2), changes, doubts)
    gain = 1.0 - float(np.sqrt(winner.misfit2 / linear.misfit2))
    return Linearity(found, probabilities, named, gain, base)


def claim_effect(
    probabilities: Probabilities,
    error2: Mapping[str, float],
    floor2: float,
    changes: Mapping[str, tuple[HeldOutChange, ...]],
    doubts: Mapping[str, str],
) -> Claim:
    """Return the claim on effects.

    error2: mean squares by effect and of LINEAR; floor2: that without the excess; doubts: clauses, "" for none
    """
    excess = max(error2[LINEAR] - floor2, 1e-300)
    alternatives = []
    for (name,), _ in probabilities.ranked:
        share, doubt = (error2[LINEAR] - error2[name]) / excess, doubts.get(name, "")
        alternatives.append(Alternative((name,), (share, share), changes[name], {name: doubt} if doubt else {}))
    return claim(Evidence(probabilities, tuple(alternatives)))


def name_probabilities(probabilities: Probabilities) -> dict[str, float]:
    """Return the probability of each effect, of LINEAR and of OTHER."""
    effects = {keys[0]: each for keys, each in probabilities.causes.items()}
    return effects | {LINEAR: probabilities.no_effect, OTHER: probabilities.none_of_these}


def build_probabilities(score: Mapping[str, float]) -> Probabilities:
    """Return the probabilities of effects from logarithms of weights, those of LINEAR and OTHER among them."""
    peak = max(score.values())
    weight = {name: float(np.exp(value - peak)) for name, value in score.items()}
    probability = {name: value / sum(weight.values()) for name, value in weight.items()}
    no_effect, none_of_these = probability.pop(LINEAR), probability.pop(OTHER)
    return Probabilities(no_effect, none_of_these, {(name,): each for name, each in probability.items()})


def _weigh_columns(beside: FloatArray, simulated: FloatArray, y: FloatArray) -> FloatArray:
    """Return weights [taps] of the parts of simulated columns beside the free linear response.

    A linear servo has nothing beside it but rounding errors, which must not be scaled up to fit the noise.
    """
    share = ROUNDING * float(np.linalg.norm(simulated)) / max(float(np.linalg.norm(beside)), 1e-300)
    if share >= 1.0:
        return np.zeros(beside.shape[1])
    return np.asarray(np.linalg.lstsq(beside, y, rcond=share)[0], dtype=np.float64)


class EffectFits:
    """Fits of forms to training runs, each with a free linear response, and their errors in the runs compared.

    Where each amplitude was recorded again, the last run of each is held out, and compared alone. Where a whole
    amplitude is held out, all are compared: what shows at the largest one only would else remain unseen.
    """

    def __init__(self, records: list[ServoRecord], base: FloatArray, expected: float) -> None:
        self.base, omega = base, float(np.exp(base[0]))
        self.shift = float(np.log(expected / omega))
        train, test = ([each for each in records if each.held_out is held_out] for held_out in (False, True))
        self.sees_training = {each.level for each in test} != {each.level for each in records}
        self.judged = [*test, *(train if self.sees_training else [])]
        self.train, self.test = (ServoData(each, omega, expected) for each in (train, self.judged))
        self.scales = self._measure_scales()
        columns = self.train.free_response(base)
        u, singular, v = np.linalg.svd(columns, full_matrices=False)
        kept = singular > 1e-7 * singular[0]
        self.q = u[:, kept]
        """The free linear response to the training runs, orthonormal: [m, k]."""
        self.test_q = self.test.free_response(base) @ (v[kept].T / singular[kept])
        """The same response to what is compared."""
        self.stride = max(1, len(columns) // FIT_SAMPLES_MAX)
        self.part = np.linalg.qr(self.q[:: self.stride])[0]
        y = self.train.target[:: self.stride]
        self.y = y - self.part @ (self.part.T @ y)

    def _measure_scales(self) -> dict[str, float]:
        omega, zeta, h_s = float(np.exp(self.base[0])), float(self.base[1]), self.train.h_s
        command = np.concatenate(self.train.drives(LINEAR_FORM, NO_EFFECT, float(self.base[2]), 1))[:, 0]
        angle, speed = np.concatenate(self.train.integrate(NonlinearServo(LINEAR_FORM, self.base))).T
        largest = float(np.abs(command).max())
        return {
            "one": 1.0,
            "command": largest,
            "slope": min(float(np.abs(np.diff(command)).max() / h_s), float(np.ptp(command)) * omega),
            "angle": float(np.abs(angle).max()),
            "speed": float(np.abs(speed).max()),
            "error": float(np.abs(command - angle).max()),
            "acceleration": float(np.abs(command - angle - 2.0 * zeta / omega * speed).max()),
        }

    def fit(self, form: ServoNonlinearity, completely: bool, start: NonlinearServo | None = None) -> FormFit:
        """Fit a form: the effect's parameters alone, or all of them."""
        period_s = 2.0 * np.pi / float(np.exp(self.base[0]))
        unit, spans = np.array([1.0, 1.0, period_s]), (form.first, form.second)
        size = np.array([self.scales[each.scale] for each in spans])
        is_log = np.array([each.low > 0.0 for each in spans])

        def pack(pair: tuple[float, ...] | FloatArray) -> FloatArray:
            return np.asarray(np.where(is_log, np.log(np.where(is_log, pair, 1.0)), pair))

        def unpack(x: FloatArray) -> NonlinearServo:
            first, second = (np.where(is_log, np.exp(np.where(is_log, x[3:], 0.0)), x[3:]) * size).tolist()
            return NonlinearServo(form, self.base + x[:3] * unit, (first, second), self.scales["angle"])

        def residual(x: FloatArray) -> FloatArray:
            simulated = self.train.simulate(unpack(x), stride=self.stride)
            if not np.abs(simulated).max() < UNSTABLE:
                return np.asarray(self.y * UNSTABLE)
            beside = simulated - self.part @ (self.part.T @ simulated)
            return np.asarray(self.y - beside @ _weigh_columns(beside, simulated, self.y))

        low = np.array([-0.7, 0.02 - self.base[1], -self.base[2] / period_s, *pack(tuple(each.low for each in spans))])
        high = np.array([max(1.2, self.shift + 0.4), 1.0, 0.5, *pack(tuple(each.high for each in spans))])
        slows_down = form.effect in (LINEAR, SLEW_LIMIT, SATURATION)
        shifts = (*FREQUENCY_SHIFTS, max(self.shift, 0.0)) if slows_down else (0.0,)
        starts = [np.array([at, 0.0, 0.0, *pack(pair)]) for pair in form.starts for at in shifts]
        if start is not None:
            starts = [np.array([*((start.base - self.base) / unit), *pack(np.array(start.effect) / size)])]
        found = fit_residuals(
            residual,
            min(starts, key=lambda each: float((residual(each) ** 2).sum())),
            (low, high),
            1e-3,
            free=np.array([completely] * 3 + [True] * 2),
            prior=Prior(np.zeros(5), np.append(PRIOR / np.sqrt(len(self.y)), [np.inf, np.inf])),
            evaluations=25 if completely else 6,
        )
        servo = unpack(found.x)
        left = self._compare(servo)
        doubt, end = "", AT_END * (high[3] - low[3])
        # An interval that contains no effect needs no test of its own: the linear fit is the profile's end.
        if end > 0.0 and not low[3] + end < found.x[3] < high[3] - end:
            doubt = f"the fit of its {form.name} ended at a limit of its range"
        return FormFit(servo, left, float((left**2).mean()), doubt)

    def _compare(self, servo: NonlinearServo) -> FloatArray:
        """Return the residual in the runs compared, infinite if the model is unstable."""
        trained, tested = (each.simulate(servo) for each in (self.train, self.test))
        if not max(np.abs(trained).max(), np.abs(tested).max()) < UNSTABLE:
            return np.full(len(self.test.target), np.inf)
        y = self.train.target
        inside, y_inside = self.q.T @ trained, self.q.T @ y
        weights = _weigh_columns(trained - self.q @ inside, trained, y - self.q @ y_inside)
        return np.asarray(self.test.target - tested @ weights - self.test_q @ (y_inside - inside @ weights))

    def list_changes(self, found: FormFit, linear: FormFit) -> tuple[HeldOutChange, ...]:
        """Return the change of χ² by a form in each held-out run, and that by noise and by the form's error."""
        changes, begin = [], 0
        for each, t_s in zip(self.judged, self.test.used_s, strict=True):
            part = slice(begin, begin + len(t_s))
            begin = part.stop
            if each.held_out:
                mine, other = found.residual[part], linear.residual[part]
                error = max(1.0, float(np.sqrt((mine**2).mean())))
                noise = 2.0 * error * float(np.sqrt(((mine - other) ** 2).sum()))
                chi2 = float((mine**2).sum() - (other**2).sum())
                changes.append(HeldOutChange(f"{each.level:.3g} rms", "the angle", chi2, noise))
        return tuple(changes)

    def weigh(self, fits: dict[str, FormFit]) -> Probabilities:
        """Return the probabilities of all effects, of none and of an unknown one."""
        linear, winner = fits[LINEAR].misfit2, min(each.misfit2 for each in fits.values())
        error2 = float(np.mean([MODEL_ERROR**2 * np.var(each.value[each.use]) / each.noise**2 for each in self.judged]))
        samples = float(len(self.test.target))
        # What exceeds the noise is systematic: more samples do not make it more certain.
        systematic = (max(winner - 1.0, 0.0) + error2) / (winner + error2)
        count = samples / (1.0 + samples / (2.0 * SYSTEMATIC_WEIGHT) * systematic)
        score = {name: -0.5 * count * np.log(each.misfit2 + error2) for name, each in fits.items()}
        if self.sees_training:  # what was fitted to the samples that are compared follows their noise, too
            for effect in EFFECTS:
                score[effect] -= 0.5 * (FORM_TAPS + 2) * np.log(samples)
        floor = min(1.0, winner)
        unknown = floor + OTHER_SHARE * max(linear - floor, 0.0)
        score[OTHER] = -0.5 * count * np.log(unknown + error2) + np.log(OTHER_ODDS)
        score[LINEAR] += np.log(LINEAR_ODDS)
        return build_probabilities(score)
