"""Response of coupled axes that depends on the amplitude: G(A) = G₀ + A G₁ + A² G₂, with A the rms of the drive.

Periodic excitations in steady state, several realisations at several amplitudes. Every line's matrices come from the
lines around it by local polynomials (Pintelon and Schoukens, System Identification, 2012, chapter 7), weighted by 1/√A.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from optodrive.core.errors import MISSING, InputError
from optodrive.core.types.arrays import BoolArray, FloatArray, freeze_arrays
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

HALF_WINDOW, DEGREE = 5, 2
"""Lines on either side of a local polynomial, and its degree."""
EXCITED_SHARE = 1e-3
"""Lines with less than this share of the largest mean power are not excited."""
MODEL = (0.0, 1.0, 2.0)
"""Exponents of the amplitude in the model."""
LAWS = {HYSTERESIS: (1.0, -0.42, 0.25), STIFFNESS: (2.0, 0.0, 0.08), FRICTION: (-1.0, 1.0, 0.4)}
"""Exponent of the amplitude in the response's change; imaginary part of the relative change below resonance, divided by
its real part, with a deviation: −4/(3π) by Rayleigh's law of hysteresis; none of a spring; at least 1 of friction,
whose lag falls as 1/A and whose loss of gain falls faster."""
STATIC_SHARE = 0.3
"""Part of the frequency of the largest response below which a response is quasi-static."""
LINEAR_ODDS, OTHER_ODDS, OTHER_SHARE = 50.0, 0.05, 0.5
DIAGONAL_SHARE = 0.95
"""Axes are decoupled if each output's own input explains this share of its power."""
LEVEL_TOLERANCE = 0.05


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


@dataclass(frozen=True, eq=False)
class AmplitudeResponse:
    """A response as a sum over powers of the amplitude, G(A) = Σ A^exponent G.

    terms: [lines, o, i × exponents], complex; zero where nothing was excited
    """

    exponents: tuple[float, ...]
    terms: Any

    def predict(self, u: FloatArray) -> FloatArray:
        """Return one steady period of the outputs, [n, o, r], for one of the drives, [n, i, r]."""
        level = np.sqrt((u**2).mean(axis=(0, 1)))
        answer: FloatArray = np.fft.irfft(
            self.terms @ _regressors(np.fft.rfft(u, axis=0), level, self.exponents), len(u), axis=0
        )
        return answer

    def at(self, level: float) -> Any:
        """Return G at an amplitude, [lines, o, i], complex."""
        parts = np.split(self.terms, len(self.exponents), axis=2)
        return sum(level**exponent * part for exponent, part in zip(self.exponents, parts, strict=True))


def _regressors(spectrum: Any, level: FloatArray, exponents: tuple[float, ...]) -> Any:
    return np.concatenate([spectrum * level**exponent for exponent in exponents], axis=1)


def fit_response(responses: PeriodicResponses, rows: BoolArray, exponents: tuple[float, ...]) -> AmplitudeResponse:
    """Fit a response to the realisations in rows, [r]."""
    u, y = np.fft.rfft(responses.u[:, :, rows], axis=0), np.fft.rfft(responses.y[:, :, rows], axis=0)
    weight = responses.level[rows] ** -0.5
    x, y = _regressors(u, responses.level[rows], exponents) * weight, y * weight
    power = (np.abs(u) ** 2).mean(axis=(1, 2))
    lines = np.flatnonzero(power > EXCITED_SHARE * power.max())
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
    terms = np.zeros((len(u), y.shape[1], size), complex)
    terms[lines] = solved[:, :, :size]
    return AmplitudeResponse(exponents, terms)


def errors_by_level(responses: PeriodicResponses, response: AmplitudeResponse) -> dict[float, float]:
    """Return the rms error of held-out realisations by amplitude, over all samples and outputs."""
    rows = responses.held_out
    error2 = ((responses.y[:, :, rows] - response.predict(responses.u[:, :, rows])) ** 2).mean(axis=(0, 1))
    return {float(level): float(np.sqrt(each)) for level, each in zip(responses.level[rows], error2, strict=True)}


def is_coupled(responses: PeriodicResponses) -> bool:
    """Return whether an output depends on more than its own input."""
    if responses.u.shape[1] != responses.y.shape[1]:
        return True
    gains = np.abs(fit_response(responses, ~responses.held_out, (0.0,)).terms) ** 2
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
    gain = np.abs(fit_response(responses, ~responses.held_out, (0.0,)).terms[:, axis, axis])
    gain = np.convolve(gain, np.ones(9) / 9.0, "same")
    lines = np.flatnonzero(gain > 0.0)
    static = float(np.median(gain[lines[: max(3, len(lines) // 50)]]))
    below = lines[gain[lines] < 0.7 * static]
    line = int(below[0]) if len(below) else int(lines[-1])
    return records, 2.0 * np.pi * line * rate_hz / n


def assess_coupled(responses: PeriodicResponses) -> dict[str, Any]:
    """Return errors, probabilities and the changes of gain and resonances of coupled axes."""
    train = ~responses.held_out
    levels = np.unique(np.round(np.log(responses.level) / LEVEL_TOLERANCE))
    if len(levels) < 3:
        raise InputError("amplitudes", len(levels), "at least 3, to tell how coupled axes depend on them")
    low, high = float(responses.level.min()), float(responses.level.max())
    linear, model = fit_response(responses, train, (0.0,)), fit_response(responses, train, MODEL)
    errors = {LINEAR: errors_by_level(responses, linear), "model": errors_by_level(responses, model)}
    for name, (exponent, _, _) in LAWS.items():
        errors[name] = errors_by_level(responses, fit_response(responses, train, (0.0, exponent)))
    change, deviation = _measure_static_change(responses, linear)
    mean2 = {name: float(np.mean([(each / level) ** 2 for level, each in of.items()])) for name, of in errors.items()}
    score = {LINEAR: -SYSTEMATIC_WEIGHT * np.log(mean2[LINEAR]) + np.log(LINEAR_ODDS)}
    for name, (_, lag, spread) in LAWS.items():
        wide = float(np.hypot(spread, deviation))
        phase = -0.5 * ((change.imag / change.real - lag) / wide) ** 2 - np.log(wide)
        score[name] = -SYSTEMATIC_WEIGHT * np.log(mean2[name]) + phase
    unknown = mean2["model"] + OTHER_SHARE * max(mean2[LINEAR] - mean2["model"], 0.0)
    score[OTHER] = -SYSTEMATIC_WEIGHT * np.log(unknown) + np.log(OTHER_ODDS)
    probabilities = build_probabilities(score)
    excess = mean2[LINEAR] - min(mean2.values())
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
        "formula": "G(A) = G0 + A G1 + A² G2, A: rms of the drive",
        "probability": {keys[0]: each for keys, each in probabilities.causes.items()}
        | {LINEAR: probabilities.no_effect, OTHER: probabilities.none_of_these},
        "noise": responses.noise,
        "error": {name: {f"{level:.4g}": each for level, each in of.items()} for name, of in errors.items()},
        "gain": 1.0 - float(np.sqrt(mean2["model"] / mean2[LINEAR])),
        "static_gain_change": change.real,
        "static_phase_change_rad": change.imag,
        "resonances": _list_resonances(responses, model, low, high),
        "position_error_share": 0.5 * abs(change),
        "consequence": f"a linear servo misses a target by up to {0.5 * abs(change):.2%} of the move after any "
        "settling time: gates need a tolerance above that, or a position sensor; plans cannot load this response",
    }


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


def _measure_static_change(responses: PeriodicResponses, linear: AmplitudeResponse) -> tuple[complex, float]:
    """Return the relative change of the quasi-static response from the least to the greatest amplitude.

    The second value is the deviation of its imaginary part relative to its real part, from eight bands of lines.
    """
    response = fit_response(responses, ~responses.held_out, MODEL)
    first, last = response.at(float(responses.level.min())), response.at(float(responses.level.max()))
    size = np.linalg.norm(linear.terms, axis=(1, 2))
    lines = np.flatnonzero(size > 0.0)
    static = lines[lines < STATIC_SHARE * int(np.argmax(size))]
    if len(static) < 16:
        static = lines[:16]
    bands = [
        complex((last[each] * np.conj(first[each])).sum() / (np.abs(first[each]) ** 2).sum()) - 1.0
        for each in np.array_split(static, 8)
    ]
    ratios = [each.imag / each.real for each in bands]
    return complex(np.mean(bands)), float(np.std(ratios) / np.sqrt(len(bands)))


def _list_resonances(
    responses: PeriodicResponses, response: AmplitudeResponse, low: float, high: float
) -> list[dict[str, float]]:
    """Return the six highest resonances of the largest singular value, and their relative shift by amplitude."""
    first, last = (np.linalg.norm(response.at(level), ord=2, axis=(1, 2)) for level in (low, high))
    line_hz = responses.sample_rate_hz / len(responses.u)
    width = max(3, len(first) // 200)
    peaks = [
        at for at in range(width, len(first) - width) if first[at] == first[at - width : at + width + 1].max() > 0.0
    ]
    rows = []
    for at in sorted(sorted(peaks, key=lambda each: -first[each])[:6]):
        moved = at - width + int(np.argmax(last[at - width : at + width + 1]))
        rows.append({"frequency_hz": at * line_hz, "shift": moved / at - 1.0, "gain": float(first[at])})
    return rows


def describe_coupled(report: dict[str, Any]) -> list[str]:
    """Describe the answer for coupled axes as text lines."""
    headline, *reasons = report["sentences"]
    lines = [
        f"coupled axes     {headline}",
        *(f"                 {line}" for line in reasons),
        f"model            {report['formula']}",
        f"noise            {report['noise']:.3g} rms",
    ]
    for level, error in report["error"]["model"].items():
        lines.append(
            f"drive {level:>8}   held-out error {report['error'][LINEAR][level]:.4g} linear, {error:.4g} with the model"
        )
    change, lag = report["static_gain_change"], -report["static_phase_change_rad"]
    lines.append(f"below resonance  gain {change:+.2%} and lag {lag:+.4f} rad from the least to the greatest amplitude")
    for each in report["resonances"]:
        lines.append(f"resonance        {each['frequency_hz']:.1f} Hz, {each['shift']:+.2%} at the greatest amplitude")
    lines.append(f"note             {report['consequence']}")
    return lines
