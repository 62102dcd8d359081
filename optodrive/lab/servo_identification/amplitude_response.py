"""Whether coupled axes respond linearly, and by which law their response changes with the rms amplitude of the drive.

Periodic excitations in steady state, several realisations at several amplitudes. Every line's matrix of a linear
response comes from the lines around it by local polynomials (Pintelon and Schoukens, System Identification, 2012,
chapter 7), weighted by 1/√A. One model of all amplitudes is a `ModalResponse`.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from optodrive.core.errors import MISSING, InputError
from optodrive.core.types.arrays import BoolArray, FloatArray, IntArray, freeze_arrays
from optodrive.lab.inference.claim import Alternative, Evidence, HeldOutChange, claim
from optodrive.lab.inference.sentences import describe_sufficiency
from optodrive.lab.servo_identification.effect_fit import (
    LINEAR,
    OTHER,
    SYSTEMATIC_WEIGHT,
    ServoRecord,
    build_probabilities,
)
from optodrive.lab.servo_identification.effects import FRICTION, HYSTERESIS, LABELS, STIFFNESS
from optodrive.lab.servo_identification.modal_response import (
    LINES_MAX,
    ModalResponse,
    choose_pairs,
    find_exponent,
    fit_modes,
)

HALF_WINDOW, DEGREE = 5, 2
"""Lines on either side of a local polynomial, and its degree."""
EXCITED_SHARE = 1e-3
"""Lines with less than this share of the largest mean power are not excited."""
EXPONENTS = {LINEAR: 0.0, STIFFNESS: 2.0, FRICTION: -1.0}
"""Of the amplitude in the response's change. That of a hysteresis follows from its lag."""
LAGS = {HYSTERESIS: (-0.42, 0.25), STIFFNESS: (0.0, 0.08), FRICTION: (1.0, 0.4)}
"""Imaginary part of the relative change below resonance, divided by its real part, with a deviation: −4/(3π) by
Rayleigh's law of hysteresis; none of a spring; at least 1 of friction, whose lag falls as 1/A and whose loss of gain
falls faster."""
STATIC_SHARE = 0.3
"""Part of the frequency of the largest response below which a response is quasi-static."""
LINEAR_ODDS, OTHER_ODDS, OTHER_SHARE = 50.0, 0.05, 0.5
DIAGONAL_SHARE = 0.95
"""Axes are decoupled if each output's own input explains this share of its power."""
LEVEL_TOLERANCE = 0.05
SEPARATE, FITTED_WITHOUT = "one_response_each", "fitted_without"
"""Errors of one linear response per amplitude, and of the model that was fitted without an amplitude."""
RESONANCES_SHOWN = 6


@dataclass(frozen=True, eq=False)
class PeriodicResponses:
    """Steady-state periods, averaged.

    u: [n, i, r]; y: [n, o, r]; level: [r] rms of the drive; held_out: [r]; noise: rms of a sample of y
    """

    sample_rate_hz: float
    u: FloatArray
    y: FloatArray
    level: FloatArray
    held_out: BoolArray
    noise: float

    def __post_init__(self) -> None:
        freeze_arrays(self)


def read_responses(path: Path, sample_rate_hz: float) -> PeriodicResponses:
    """Read u_NAME and y_NAME [n, channels, realisations, periods] of every NAME, the last realisation held out."""
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: np.asarray(file[name], dtype=np.float64) for name in file.files}
    except (OSError, ValueError) as error:
        raise InputError(str(path), type(error).__name__, "an .npz file of numbers") from None
    names = sorted(name[2:] for name in arrays if name.startswith("u_"))
    if not names:
        raise InputError(
            f"{path}: u_NAME", MISSING, "arrays u_NAME and y_NAME, [samples, channels, realisations, periods]"
        )
    u, y, held_out, differences = [], [], [], []
    for name in names:
        drive, answer = arrays[f"u_{name}"], arrays.get(f"y_{name}")
        if (
            answer is None
            or answer.ndim != 4
            or drive.ndim != 4
            or answer.shape[::2] != drive.shape[::2]
            or len(answer) < 64
        ):
            shape = MISSING if answer is None else answer.shape
            raise InputError(
                f"{path}: y_{name}", shape, f"the shape of u_{name} {drive.shape} but for channels: four axes"
            )
        if not np.isfinite(drive).all() or not np.isfinite(answer).all() or drive.shape[2] < 2 or answer.shape[3] < 2:
            raise InputError(
                f"{path}: u_{name}, y_{name}", drive.shape, "finite, at least 2 realisations and 2 periods"
            )
        u.append(drive.mean(axis=3))
        y.append(answer.mean(axis=3))
        held_out += [False] * (drive.shape[2] - 1) + [True]
        differences.append(np.var(answer - answer.mean(axis=3, keepdims=True), ddof=0) / (answer.shape[3] - 1))
    if len({(each.shape[0], each.shape[1]) for each in u}) > 1 or len({each.shape[1] for each in y}) > 1:
        raise InputError(
            f"{path}: u_NAME", [each.shape for each in u], "the same samples and channels at every amplitude"
        )
    drives = np.concatenate(u, axis=2)
    level = np.sqrt((drives**2).mean(axis=(0, 1)))
    noise = float(np.sqrt(np.mean(differences)))
    return PeriodicResponses(sample_rate_hz, drives, np.concatenate(y, axis=2), level, np.array(held_out), noise)


def fit_response(responses: PeriodicResponses, rows: BoolArray) -> Any:
    """Return one linear response to the realisations in rows, [lines, o, i], complex, 0 where nothing was excited."""
    weight = responses.level[rows] ** -0.5
    x, y = (np.fft.rfft(each[:, :, rows], axis=0) * weight for each in (responses.u, responses.y))
    lines = _find_excited_lines(responses)
    x_h = np.conj(x[lines].transpose(0, 2, 1))
    moments, products = x[lines] @ x_h, y[lines] @ x_h
    count, size = len(lines), x.shape[1]
    wide = size * (DEGREE + 1)
    left, right = np.zeros((count, wide, wide), complex), np.zeros((count, y.shape[1], wide), complex)
    for shift in range(-HALF_WINDOW, HALF_WINDOW + 1):
        inside = np.flatnonzero((np.arange(count) + shift >= 0) & (np.arange(count) + shift < count))
        share = 1.0 - abs(shift) / (HALF_WINDOW + 1)
        powers = (shift / HALF_WINDOW) ** np.arange(DEGREE + 1)
        block = (
            moments[inside + shift][:, None, :, None, :] * (share * np.outer(powers, powers))[None, :, None, :, None]
        )
        left[inside] += block.reshape(len(inside), wide, wide)
        right[inside] += np.concatenate([share * power * products[inside + shift] for power in powers], axis=2)
    ridge = 1e-12 * np.einsum("lii->l", left).real[:, None, None] * np.eye(wide)
    solved = np.linalg.solve((left + ridge).transpose(0, 2, 1), right.transpose(0, 2, 1)).transpose(0, 2, 1)
    response = np.zeros((len(x), y.shape[1], size), complex)
    response[lines] = solved[:, :, :size]
    return response


def _find_excited_lines(responses: PeriodicResponses) -> IntArray:
    power = (np.abs(np.fft.rfft(responses.u, axis=0)) ** 2).mean(axis=(1, 2))
    return np.flatnonzero(power > EXCITED_SHARE * power.max())


def errors_by_level(
    responses: PeriodicResponses, predict: Callable[[FloatArray], FloatArray], rows: BoolArray
) -> dict[float, float]:
    """Return the rms error of the realisations in rows by amplitude, over all samples and outputs."""
    error2 = ((responses.y[:, :, rows] - predict(responses.u[:, :, rows])) ** 2).mean(axis=(0, 1))
    return {float(level): float(np.sqrt(each)) for level, each in zip(responses.level[rows], error2, strict=True)}


def _predict_by(response: Any) -> Callable[[FloatArray], FloatArray]:
    """Return the prediction [n, o, r] from drives [n, i, r] of one linear response."""
    return lambda u: np.asarray(np.fft.irfft(response @ np.fft.rfft(u, axis=0), len(u), axis=0))


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
        bands = [
            complex((last[each] * np.conj(first[each])).sum() / (np.abs(first[each]) ** 2).sum()) - 1.0
            for each in np.array_split(static, 8)
        ]
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
    parts = [
        np.stack([fit_response(responses, np.isin(np.arange(len(group)), each[part])) for each in rows])
        for part in (slice(None), slice(0, None, 2), slice(1, None, 2))
    ]
    levels = np.array([float(responses.level[each].mean()) for each in rows])
    return AmplitudeData(
        responses.sample_rate_hz, _find_excited_lines(responses), levels, parts[0], (parts[1], parts[2])
    )


def is_coupled(responses: PeriodicResponses) -> bool:
    """Return whether an output depends on more than its own input."""
    if responses.u.shape[1] != responses.y.shape[1]:
        return True
    gains = np.abs(fit_response(responses, ~responses.held_out)) ** 2
    power = np.einsum("loi->oi", gains)
    return bool((np.diag(power) < DIAGONAL_SHARE * power.sum(axis=1)).any())


def build_records(responses: PeriodicResponses, axis: int) -> tuple[list[ServoRecord], float]:
    """Return the records of a decoupled axis, the second of two periods compared, and a rough bandwidth, rad/s."""
    n, rate_hz = len(responses.u), responses.sample_rate_hz
    t_s = np.arange(2 * n) / rate_hz
    records = []
    for row, held_out in enumerate(responses.held_out):
        u, y = (np.tile(each[:, axis, row], 2) for each in (responses.u, responses.y))
        use = (np.arange(2 * n) >= n) & (np.arange(2 * n) % max(1, n // 8000) == 0)
        level = float(responses.level[row])
        records.append(ServoRecord(t_s, u, t_s, y, use, bool(held_out), responses.noise, level))
    gain = np.abs(fit_response(responses, ~responses.held_out)[:, axis, axis])
    gain = np.convolve(gain, np.ones(9) / 9.0, "same")
    lines = np.flatnonzero(gain > 0.0)
    static = float(np.median(gain[lines[: max(3, len(lines) // 50)]]))
    below = lines[gain[lines] < 0.7 * static]
    line = int(below[0]) if len(below) else int(lines[-1])
    return records, 2.0 * np.pi * line * rate_hz / n


def assess_coupled(responses: PeriodicResponses) -> dict[str, Any]:
    """Return errors, probabilities and the changes of gain and modes of coupled axes."""
    data, held_out = build_amplitude_data(responses), responses.held_out
    group = group_levels(responses.level)
    models = {law: data.fit(law) for law in (LINEAR, *LAGS)}
    errors = {law: errors_by_level(responses, model.predict, held_out) for law, model in models.items()}
    errors[SEPARATE], errors[FITTED_WITHOUT] = {}, {}
    change, deviation = data.measure_static_change()
    mean2 = {name: _mean_share2(of) for name, of in errors.items() if of}
    law = min(LAGS, key=lambda each: mean2[each])
    for row in range(len(data.levels)):
        rows = held_out & (group == row)
        errors[SEPARATE] |= errors_by_level(responses, _predict_by(data.responses[row]), rows)
        errors[FITTED_WITHOUT] |= errors_by_level(responses, data.without(row).fit(law).predict, rows)
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
    excess = mean2[LINEAR] - min(separate, *mean2.values())
    alternatives = []
    for (name,), _ in probabilities.ranked:
        share = (mean2[LINEAR] - mean2[name]) / max(excess, 1e-300)
        alternatives.append(
            Alternative((name,), (share, share), _list_changes(responses, errors[name], errors[LINEAR]))
        )
    found = claim(Evidence(probabilities, tuple(alternatives)))
    return {
        "verdict": found.verdict,
        "sentences": describe_sufficiency(found, probabilities, "One linear servo", LABELS),
        "law": law,
        "exponent": models[law].exponent,
        "number_count": models[law].number_count,
        "probability": {keys[0]: each for keys, each in probabilities.causes.items()}
        | {LINEAR: probabilities.no_effect, OTHER: probabilities.none_of_these},
        "noise": responses.noise,
        "error": {name: {f"{level:.4g}": each for level, each in of.items()} for name, of in errors.items()},
        "gain": 1.0 - float(np.sqrt(mean2[law] / mean2[LINEAR])),
        "static_gain_change": change.real,
        "static_phase_change_rad": change.imag,
        "resonances": _list_resonances(models[law], data.levels),
        "position_error_share": 0.5 * abs(change),
        "consequence": f"a linear servo misses a target by up to {0.5 * abs(change):.2%} of the move after any "
        "settling time: gates need a tolerance above that, or a position sensor; plans cannot load this response",
    }


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
    return tuple(
        HeldOutChange(
            f"{level:.3g} rms",
            "the output",
            size * (error**2 - linear[level] ** 2) / responses.noise**2,
            np.sqrt(2.0 * size) * (error / responses.noise) ** 2,
        )
        for level, error in found.items()
    )


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
    change, lag = report["static_gain_change"], -report["static_phase_change_rad"]
    lines.append(
        f"below resonance  gain {change:+.2%} and lag {lag:+.4f} rad from the smallest to the largest amplitude"
    )
    for each in report["resonances"]:
        lines.append(
            f"resonance        {each['frequency_hz']:.1f} Hz, damping {each['damping']:.4f}; {each['shift']:+.2%} and "
            f"{each['damping_change']:+.4f} at the largest amplitude"
        )
    lines.append(f"note             {report['consequence']}")
    return lines
