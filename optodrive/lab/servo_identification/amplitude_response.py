"""Whether coupled axes respond linearly, and by which law their response changes with the rms amplitude of the drive.

One model of all amplitudes is a `ModalResponse`.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.types.arrays import BoolArray, FloatArray, IntArray
from optodrive.lab.inference.claim import HeldOutChange
from optodrive.lab.inference.sentences import describe_sufficiency
from optodrive.lab.servo_identification.effect_fit import (
    LINEAR,
    OTHER,
    SYSTEMATIC_WEIGHT,
    build_probabilities,
    claim_effect,
    name_probabilities,
)
from optodrive.lab.servo_identification.effects import FRICTION, HYSTERESIS, LABELS, STIFFNESS
from optodrive.lab.servo_identification.modal_response import (
    LINES_MAX,
    ModalResponse,
    choose_pairs,
    find_exponent,
    fit_modes,
)
from optodrive.lab.servo_identification.periodic_responses import PeriodicResponses, find_excited_lines, fit_response

EXPONENTS = {LINEAR: 0.0, STIFFNESS: 2.0, FRICTION: -1.0}
"""Of the amplitude in the response's change. That of a hysteresis follows from its lag."""
LAGS = {HYSTERESIS: (-0.42, 0.25), STIFFNESS: (0.0, 0.08), FRICTION: (1.0, 0.4)}
"""Imaginary part of the relative change below resonance, divided by its real part, with a deviation: −4/(3π) by
Rayleigh's law of hysteresis; none of a spring; at least 1 of friction, whose lag falls as 1/A and whose loss of gain
falls faster."""
STATIC_SHARE = 0.3
"""Part of the frequency of the largest response below which a response is quasi-static."""
LINEAR_ODDS, OTHER_ODDS, OTHER_SHARE = 50.0, 0.05, 0.5
LEVEL_TOLERANCE = 0.05
SEPARATE, FITTED_WITHOUT = "one_response_each", "fitted_without"
"""Errors of one linear response per amplitude, and of the model that was fitted without an amplitude."""
RESONANCES_SHOWN = 6
Predict = Callable[[FloatArray], FloatArray]


def errors_by_level(responses: PeriodicResponses, predict: Predict, rows: BoolArray) -> dict[float, float]:
    """Return the rms error of the realisations in rows by amplitude, over all samples and outputs."""
    error2 = ((responses.y[:, :, rows] - predict(responses.u[:, :, rows])) ** 2).mean(axis=(0, 1))
    return {float(level): float(np.sqrt(each)) for level, each in zip(responses.level[rows], error2, strict=True)}


def _predict_by(response: Any, u: FloatArray) -> FloatArray:
    """Return the prediction [n, o, r] from drives [n, i, r] of one linear response."""
    return np.asarray(np.fft.irfft(response @ np.fft.rfft(u, axis=0), len(u), axis=0))


@dataclass(frozen=True, eq=False)
class AmplitudeData:
    """Linear responses [all lines, o, i] of each amplitude, and of the odd and even realisations that they come from.

    rate_hz: samples per second; lines: [l] excited; levels: [a] ascending
    """

    rate_hz: float
    lines: IntArray
    levels: FloatArray
    responses: Any
    halves: tuple[Any, Any]

    def without(self, row: int) -> "AmplitudeData":
        """Return the data without an amplitude."""
        kept = np.arange(len(self.levels)) != row
        halves = self.halves[0][kept], self.halves[1][kept]
        return replace(self, levels=self.levels[kept], responses=self.responses[kept], halves=halves)

    def measure_static_change(self) -> tuple[complex, float]:
        """Return the relative change of the quasi-static response from the smallest to the largest amplitude.

        The second value is the deviation of its imaginary part relative to its real part, from eight bands of lines.
        """
        first, last = self.responses[0], self.responses[-1]
        size = np.linalg.norm(self.responses.mean(axis=0), axis=(1, 2))
        static = self.lines[self.lines < STATIC_SHARE * int(np.argmax(size))]
        if len(static) < 16:
            static = self.lines[:16]
        parts = ((first[each], last[each]) for each in np.array_split(static, 8))
        bands = [complex((b * np.conj(a)).sum() / (np.abs(a) ** 2).sum()) - 1.0 for a, b in parts]
        ratios = [each.imag / each.real for each in bands]
        return complex(np.mean(bands)), float(np.std(ratios) / np.sqrt(len(bands)))

    @cached_property
    def fitted_lines(self) -> IntArray:
        """The lines that modes are fitted to."""
        return self.lines[:: max(1, len(self.lines) // LINES_MAX)]

    @cached_property
    def pairs(self) -> int:
        """Number of pole pairs of the linear response."""
        z = np.exp(1j * np.pi * self.fitted_lines / (self.responses.shape[1] - 1))
        first, second = (each[:, self.fitted_lines].mean(axis=0) for each in self.halves)
        return choose_pairs(z, first, second)

    def fit(self, law: str) -> ModalResponse:
        """Fit the modes by a law of LAGS, or LINEAR. The lag of the static change tells a hysteresis' exponent."""
        change = self.measure_static_change()[0]
        exponent = find_exponent(-change.imag / change.real) if law == HYSTERESIS else EXPONENTS[law]
        frequency_hz = self.fitted_lines * self.rate_hz / (2.0 * (self.responses.shape[1] - 1))
        by_level = dict(zip(self.levels.tolist(), self.responses[:, self.fitted_lines], strict=True))
        return fit_modes(self.rate_hz, frequency_hz, by_level, self.pairs, exponent)


def group_levels(level: FloatArray) -> IntArray:
    """Return the number of each realisation's amplitude, ascending, [r]."""
    order, group = np.argsort(level), np.empty(len(level), dtype=np.int64)
    group[order] = np.cumsum(np.diff(np.log(level[order]), prepend=-np.inf) > LEVEL_TOLERANCE) - 1
    return group


def build_amplitude_data(responses: PeriodicResponses) -> AmplitudeData:
    """Estimate the response of every amplitude. Raise InputError for too few amplitudes or realisations."""
    group, train = group_levels(responses.level), ~responses.held_out
    count = int(group.max()) + 1
    if count < 3:
        raise InputError("amplitudes", count, "at least 3, to tell how coupled axes depend on them")
    rows = [np.flatnonzero(train & (group == each)) for each in range(count)]
    if min(map(len, rows)) < 2:
        raise InputError("realisations", min(map(len, rows)) + 1, "at least 3 of each amplitude of coupled axes")
    number = np.arange(len(group))
    whole, first, second = (
        np.stack([fit_response(responses, np.isin(number, each[begin::step])) for each in rows])
        for begin, step in ((0, 1), (0, 2), (1, 2))
    )
    levels = np.array([float(responses.level[each].mean()) for each in rows])
    return AmplitudeData(responses.sample_rate_hz, find_excited_lines(responses), levels, whole, (first, second))


@dataclass(frozen=True, eq=False)
class CoupledAxes:
    """Answer for coupled axes.

    law: of LAGS, with the least error; levels: [a] ascending; error_between: largest error of the model at an amplitude
    that it was fitted without, between others, as a share of the outputs' rms
    """

    report: dict[str, Any]
    law: str
    model: ModalResponse
    levels: FloatArray
    error_between: float


def assess_coupled(responses: PeriodicResponses) -> CoupledAxes:
    """Return errors, probabilities and the changes of gain and modes of coupled axes."""
    data, held_out = build_amplitude_data(responses), responses.held_out
    group = group_levels(responses.level)
    models = {law: data.fit(law) for law in (LINEAR, *LAGS)}
    errors = {law: errors_by_level(responses, model.predict, held_out) for law, model in models.items()}
    errors[SEPARATE], errors[FITTED_WITHOUT], between = {}, {}, [0.0]
    change, deviation = data.measure_static_change()
    mean2 = {name: _mean_share2(of) for name, of in errors.items() if of}
    law = min(LAGS, key=lambda each: mean2[each])
    for row in range(len(data.levels)):
        rows = held_out & (group == row)
        errors[SEPARATE] |= errors_by_level(responses, partial(_predict_by, data.responses[row]), rows)
        without = errors_by_level(responses, data.without(row).fit(law).predict, rows)
        errors[FITTED_WITHOUT] |= without
        if 0 < row < len(data.levels) - 1:
            error2 = max(max(without.values()) ** 2 - responses.noise**2, 0.0)
            between.append(float(np.sqrt(error2 / (responses.y[:, :, rows] ** 2).mean())))
    errors["model"] = errors[law]
    score = {LINEAR: -SYSTEMATIC_WEIGHT * np.log(mean2[LINEAR]) + np.log(LINEAR_ODDS)}
    for name, (lag, spread) in LAGS.items():
        wide = float(np.hypot(spread, deviation))
        phase = -0.5 * ((change.imag / change.real - lag) / wide) ** 2 - np.log(wide)
        score[name] = -SYSTEMATIC_WEIGHT * np.log(mean2[name]) + phase
    separate = _mean_share2(errors[SEPARATE])
    unknown = separate + OTHER_SHARE * max(mean2[LINEAR] - separate, 0.0)
    score[OTHER] = -SYSTEMATIC_WEIGHT * np.log(unknown) + np.log(OTHER_ODDS)
    probabilities = build_probabilities(score)
    changes = {name: _list_changes(responses, errors[name], errors[LINEAR]) for name in LAGS}
    found = claim_effect(probabilities, mean2, min(separate, *mean2.values()), changes, {})
    report = {
        "verdict": found.verdict,
        "sentences": describe_sufficiency(found, probabilities, "One linear servo", LABELS),
        "law": law,
        "exponent": models[law].exponent,
        "number_count": models[law].number_count,
        "probability": name_probabilities(probabilities),
        "noise": responses.noise,
        "error": {name: {f"{level:.4g}": each for level, each in of.items()} for name, of in errors.items()},
        "gain": 1.0 - float(np.sqrt(mean2[law] / mean2[LINEAR])),
        "static_gain_change": change.real,
        "static_phase_change_rad": change.imag,
        "resonances": _list_resonances(models[law], data.levels),
        "position_error_share": 0.5 * abs(change),
        "error_between_share": max(between),
        "consequence": f"a linear servo misses a target by up to {0.5 * abs(change):.2%} of the move after any "
        "settling time: gates need a tolerance above that, or a position sensor",
    }
    return CoupledAxes(report, law, models[law], data.levels, max(between))


def _mean_share2(errors: dict[float, float]) -> float:
    """Return the mean square of errors relative to their amplitudes."""
    return float(np.mean([(each / level) ** 2 for level, each in errors.items()]))


def _list_changes(
    responses: PeriodicResponses, found: dict[float, float], linear: dict[float, float]
) -> tuple[HeldOutChange, ...]:
    """Return the change of χ² by a law in each held-out realisation.

    The errors are systematic, so what counts as noise is that of their mean square over the lines of a realisation.
    """
    size = responses.y[:, :, 0].size
    changes = []
    for level, error in found.items():
        chi2 = size * (error**2 - linear[level] ** 2) / responses.noise**2
        noise = np.sqrt(2.0 * size) * (error / responses.noise) ** 2
        changes.append(HeldOutChange(f"{level:.3g} rms", "the output", chi2, noise))
    return tuple(changes)


def _list_resonances(model: ModalResponse, levels: FloatArray) -> list[dict[str, float]]:
    """Return the strongest resonances at the smallest amplitude, and their changes to the greatest one."""
    first, last = (model.poles_at(float(level)) for level in (levels.min(), levels.max()))
    residues = model.residues[: 2 * len(first)].reshape(len(first), -1)
    strongest = np.argsort(np.linalg.norm(residues, axis=1) / first.real)[:RESONANCES_SHOWN]
    return [
        {
            "frequency_hz": float(abs(first[row]) / (2.0 * np.pi)),
            "damping": float(-first[row].real / abs(first[row])),
            "shift": float(abs(last[row] / first[row]) - 1.0),
            "damping_change": float(first[row].real / abs(first[row]) - last[row].real / abs(last[row])),
        }
        for row in sorted(strongest, key=lambda each: abs(first[each]))
    ]


def describe_coupled(report: dict[str, Any]) -> list[str]:
    """Describe the answer for coupled axes as text lines."""
    headline, *reasons = report["sentences"]
    lines = [
        f"coupled axes     {headline}",
        *(f"                 {line}" for line in reasons),
        f"model            modes that move with (drive rms)^{report['exponent']:.3g}: {report['number_count']} numbers "
        "beside one linear response",
        f"noise            {report['noise']:.3g} rms",
    ]
    error = report["error"]
    for level, each in error["model"].items():
        lines.append(
            f"drive {level:>8}   held-out error {each:.4g} with the model, {error[FITTED_WITHOUT][level]:.4g} fitted "
            f"without this amplitude; {error[LINEAR][level]:.4g} linear, {error[SEPARATE][level]:.4g} one response each"
        )
    between = f"{report['error_between_share']:.2%} of the output"
    lines.append(f"between          error at an amplitude between measured ones {between}")
    change, lag = report["static_gain_change"], -report["static_phase_change_rad"]
    ends = "from the smallest to the largest amplitude"
    lines.append(f"below resonance  gain {change:+.2%} and lag {lag:+.4f} rad {ends}")
    for each in report["resonances"]:
        lines.append(
            f"resonance        {each['frequency_hz']:.1f} Hz, damping {each['damping']:.4f}; {each['shift']:+.2%} and "
            f"{each['damping_change']:+.4f} at the largest amplitude"
        )
    lines.append(f"note             {report['consequence']}")
    return lines
