"""A response of coupled axes as a sum of modes whose poles move with the amplitude of the drive.

Theory

    G(z, A) = [Σ Rₖ / (z − exp(λₖ(A) / f)) + D₀ + D₁ / z] · diag(1 + gᵢ a),  λₖ(A) = λₖ exp(cₖ a),  a = (A / A₀)^p − 1

λₖ, Rₖ, D: the linear response at the amplitude A₀, with poles in conjugate pairs. The amplitude adds one complex number
cₖ per mode (frequency and damping), one complex gain gᵢ per input, and one exponent p for all: 2 m + 2 i + 1 numbers.
Poles of a first linear response come from vector fitting (Gustavsen and Semlyen, IEEE Trans. Power Delivery 14, 1999,
1052), in z. All poles and changes then follow by Gauss–Newton steps, in which residues are eliminated (variable
projection, Kaufman's Jacobian).

The exponent follows from a lag. A hysteresis whose first curve is x + c |x|^p x and whose branches are that curve at
twice its size (Masing) has, at the fundamental of a sine, a loss and a storage that both grow as A^p, in the ratio
`lag_of_exponent`: 4/(3π) by Rayleigh's law, p = 1, and less if p is less. So two amplitudes determine it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import gamma, pi, sqrt
from typing import Any

import numpy as np
from scipy.optimize import brentq, least_squares

from optodrive.core.types.arrays import BoolArray, FloatArray, ReadOnlyArrays

MODES_MAX = 16
"""Largest number of modes that move with the amplitude."""
PAIRS = range(2, 21, 2)
"""Numbers of pole pairs that are compared."""
GAIN_MIN = 0.02
"""Least relative gain of the error by which more pairs are worth their numbers."""
DAMPING_MAX = 0.3
"""Poles with more damping are background, which does not move."""
CHANGE_SIGMA = 0.01
"""Prior deviation of a pole's relative change: it keeps at rest the poles whose change nothing shows."""
CHANGE_MAX = 0.7
"""Largest change of a logarithm of a pole by the fit, of a pole by the amplitude, and of a gain."""
LINES_MAX, LINES_PER_PAIR = 1000, 8
ROUNDS, EVALUATIONS = 12, 25
RANK = 1e-10
EXPONENTS = (0.1, 3.0)


def lag_of_exponent(exponent: float) -> float:
    """Return the loss of a hysteresis divided by its storage, in the part of both that grows as A^exponent."""

    def integrate(q: float) -> float:  # sin^(2 q) over half a period
        return sqrt(pi) * gamma(q + 0.5) / gamma(q + 1.0)

    storage = 2.0 * integrate(2.0 + exponent) - integrate(1.0 + exponent)
    return exponent / (exponent + 2.0) / storage


def find_exponent(lag: float) -> float:
    """Return the exponent of a hysteresis with a lag, within EXPONENTS."""
    low, high = EXPONENTS
    if not lag_of_exponent(low) < lag < lag_of_exponent(high):
        return low if lag < lag_of_exponent(high) else high
    return float(brentq(lambda exponent: lag_of_exponent(exponent) - lag, low, high))


@dataclass(frozen=True, eq=False)
class ModalResponse(ReadOnlyArrays):
    """A response with modes that move.

    poles: [m] λ of the modes that move, rad/s, one of each pair; fixed: [k] of the others; changes: [m] c;
    gains: [i] g; level: A₀; residues: [2 m + 2 k + 2, o, i] of `_build_columns`
    """

    rate_hz: float
    level: float
    exponent: float
    poles: Any
    fixed: Any
    changes: Any
    gains: Any
    residues: FloatArray

    @property
    def number_count(self) -> int:
        """Real numbers beside the linear response."""
        return 2 * len(self.changes) + 2 * len(self.gains) + 1

    def poles_at(self, level: float) -> Any:
        """Return λ of the modes at an amplitude, [m], rad/s."""
        return self.poles * np.exp(self.changes * self._law(level))

    def at(self, level: float, frequency_hz: FloatArray) -> Any:
        """Return G at an amplitude, [lines, o, i], complex."""
        poles = self.list_poles(level)
        columns = _build_columns(np.exp(2j * pi * frequency_hz / self.rate_hz), np.exp(poles / self.rate_hz))
        return np.tensordot(columns, self.residues, axes=1) * (1.0 + self.gains * self._law(level))

    def predict(self, u: FloatArray) -> FloatArray:
        """Return one steady period of the outputs, [n, o, r], for one of the drives, [n, i, r]."""
        level, spectrum = np.sqrt((u**2).mean(axis=(0, 1))), np.fft.rfft(u, axis=0)
        frequency_hz: FloatArray = np.arange(len(spectrum), dtype=np.float64) * (self.rate_hz / len(u))
        parts = [self.at(float(each), frequency_hz) @ spectrum[:, :, [row]] for row, each in enumerate(level)]
        return np.asarray(np.fft.irfft(np.concatenate(parts, axis=2), len(u), axis=0), dtype=np.float64)

    def list_poles(self, level: float) -> Any:
        """Return λ of all modes at an amplitude, [m + k], rad/s."""
        return np.concatenate([self.poles_at(level), self.fixed])

    def measure_ringing(self, level: float, outputs: FloatArray, inputs: FloatArray) -> FloatArray:
        """Return the largest ringing of each mode, [m + k], in outputs [a, o] after a step of inputs [i, a]."""
        ends = self._pair_residues() / (1.0 - np.exp(self.list_poles(level) / self.rate_hz))[:, None, None]
        return np.asarray(2.0 * np.abs(outputs @ ends @ inputs).max(axis=(1, 2)), dtype=np.float64)

    def respond_to_step(self, level: float, count: int, rings: BoolArray) -> FloatArray:
        """Return the outputs at each of count samples after a unit step of each input from rest, [count, o, i].

        rings: [m + k], modes that take time; others are at their end at once. The gains' imaginary parts, a lag at any
        frequency, are left out: a step has no frequency.
        """
        poles = np.exp(self.list_poles(level) / self.rate_hz)
        decays = np.where(rings, poles, 0.0) ** np.arange(count)[:, None]
        modes = np.tensordot((1.0 - np.where(rings, decays, 0.0)) / (1.0 - poles), self._pair_residues(), axes=1)
        direct = self.residues[-2] + self.residues[-1] * (np.arange(count) > 0)[:, None, None]
        return np.asarray((2.0 * modes.real + direct) * (1.0 + self.gains.real * self._law(level)), dtype=np.float64)

    def _pair_residues(self) -> Any:
        """Return R of each mode's first pole, [m + k, o, i]."""
        pairs = self.residues[:-2].reshape(-1, 2, *self.residues.shape[1:])
        return pairs[:, 0] + 1j * pairs[:, 1]

    def _law(self, level: float) -> float:
        return float((level / self.level) ** self.exponent) - 1.0


def _build_columns(z: Any, poles: Any) -> Any:
    """Return both real columns of each pole pair, then a constant and a sample's delay: [lines, 2 k + 2], complex."""
    first, second = 1.0 / (z[:, None] - poles), 1.0 / (z[:, None] - poles.conj())
    pairs = np.stack([first + second, 1j * (first - second)], axis=2).reshape(len(z), -1)
    return np.column_stack([pairs, np.ones(len(z)), 1.0 / z])


def _stack(values: Any) -> FloatArray:
    """Return real and imaginary parts below each other."""
    return np.asarray(np.concatenate([values.real, values.imag]), dtype=np.float64)


def fit_poles(z: Any, response: Any, pairs: int) -> Any:
    """Return the poles in z of a response [lines, o, i], one of each pair."""
    values = response.reshape(len(z), -1)
    poles = np.exp((-0.01 + 1j) * np.linspace(np.angle(z).min() + 0.02, np.angle(z).max(), pairs))
    for _ in range(ROUNDS):
        columns = _build_columns(z, poles)
        # A real pole leaves an empty second column.
        size = 2 * len(poles)
        is_used = np.linalg.norm(columns[:, :size], axis=0) > 0.0
        numerator = columns[:, np.append(is_used, [True, True])]
        rows, right, first = [], [], numerator.shape[1]
        for value in values.T:
            block = _stack(np.column_stack([numerator, -columns[:, :size][:, is_used] * value[:, None], value]))
            left: FloatArray = np.asarray(np.linalg.qr(block, mode="r"))[first:, first:]
            rows.append(left[:, :-1])
            right.append(left[:, -1])
        weights = np.zeros(size)
        weights[is_used] = np.linalg.lstsq(np.concatenate(rows), np.concatenate(right), rcond=None)[0]
        matrix, begin = np.zeros((size, size)), np.zeros(size)
        for row, pole in enumerate(poles):
            at = slice(2 * row, 2 * row + 2)
            matrix[at, at] = [[pole.real, pole.imag], [-pole.imag, pole.real]]
            begin[2 * row] = 2.0
        matrix = (matrix - np.outer(begin, weights))[np.ix_(is_used, is_used)]
        roots = np.linalg.eigvals(matrix)
        roots = np.where(np.abs(roots) > 1.0, 1.0 / roots.conj(), roots)
        poles = roots[roots.imag >= 0.0]
    return poles


def choose_pairs(z: Any, first: Any, second: Any) -> int:
    """Return the fewest pole pairs that predict a response [lines, o, i] from other realisations about best."""
    best, found, without_gain = np.inf, PAIRS[0], 0
    for pairs in PAIRS[: max(1, len(z) // LINES_PER_PAIR)]:
        columns = _stack(_build_columns(z, fit_poles(z, first, pairs)))
        fitted, other = (_stack(each.reshape(len(z), -1)) for each in (first, second))
        error = float(np.linalg.norm(other - columns @ np.linalg.lstsq(columns, fitted, rcond=RANK)[0]))
        if error < (1.0 - GAIN_MIN) * best:
            best, found, without_gain = error, pairs, 0
        elif without_gain:  # the second number in a row
            break
        else:
            without_gain += 1
    return found


def fit_modes(
    rate_hz: float, frequency_hz: FloatArray, responses: Mapping[float, Any], pairs: int, exponent: float
) -> ModalResponse:
    """Fit to responses [lines, o, i] by amplitude, each with the same weight."""
    z, levels = np.exp(2j * pi * frequency_hz / rate_hz), np.array(list(responses))
    level = float(np.median(levels))
    law, values = (levels / level) ** exponent - 1.0, np.stack(list(responses.values()))
    found = np.log(fit_poles(z, values.mean(axis=0), pairs) + 0j) * rate_hz
    found = found[np.argsort(-found.real / np.abs(found))]
    moves = (found.imag > 0.0) & (-found.real < DAMPING_MAX * np.abs(found)) & (np.arange(len(found)) < MODES_MAX)
    start = np.concatenate([np.log(found[moves]), np.zeros(moves.sum() + values.shape[3])]).view(np.float64)
    fit = _ModalFit(rate_hz, z, law, values, found[~moves], 0.0)
    noise = float(np.sqrt(np.mean(fit.compute_residual(start) ** 2)))
    low = start - CHANGE_MAX
    # A pole whose logarithm has an imaginary part of π/2 does not decay.
    angles = slice(1, 2 * moves.sum(), 2)
    low[angles] = np.maximum(low[angles], 0.5 * (0.5 * pi + start[angles]))
    fit = replace(fit, weight=noise / CHANGE_SIGMA)
    end = least_squares(
        fit.compute_residual,
        start,
        jac=fit.differentiate,
        bounds=(low, start + CHANGE_MAX),
        x_scale="jac",
        max_nfev=EVALUATIONS,
        ftol=1e-6,
    ).x
    logs, changes, gains = fit.unpack(end)
    residues = np.stack([each.residues for each in fit.project(end)], axis=2)
    return ModalResponse(rate_hz, level, exponent, np.exp(logs), found[~moves], changes, gains, residues)


@dataclass(frozen=True, eq=False)
class _Projection:
    """Residues [k, o] of an input's responses, the rest [rows, o], and the orthonormal columns behind it."""

    residues: FloatArray
    rest: FloatArray
    columns: FloatArray


@dataclass(frozen=True, eq=False)
class _ModalFit:
    """Residual and Jacobian by real and imaginary parts of log λ [m], c [m] and g [i].

    z: [lines]; law: [a] of each amplitude; values: [a, lines, o, i]; fixed: poles that do not move;
    weight: of the prior
    """

    rate_hz: float
    z: Any
    law: FloatArray
    values: Any
    fixed: Any
    weight: float

    def unpack(self, x: FloatArray) -> tuple[Any, Any, Any]:
        whole = x.view(np.complex128)
        count = (len(whole) - self.values.shape[3]) // 2
        return whole[:count], whole[count : 2 * count], whole[2 * count :]

    def _columns_by_level(self, x: FloatArray) -> list[Any]:
        logs, changes, _ = self.unpack(x)
        poles = [np.concatenate([np.exp(logs + changes * each), self.fixed]) for each in self.law]
        return [_build_columns(self.z, np.exp(each / self.rate_hz)) for each in poles]

    def project(self, x: FloatArray) -> list[_Projection]:
        """Return the projection of each input's responses."""
        columns, gains, found = self._columns_by_level(x), self.unpack(x)[2], []
        for row, gain in enumerate(gains):
            levels = [each * (1.0 + gain * a) for each, a in zip(columns, self.law, strict=True)]
            scaled = _stack(np.concatenate(levels))
            target = _stack(np.concatenate(self.values[:, :, :, row]))
            u, singular, v = np.linalg.svd(scaled, full_matrices=False)
            kept = singular > RANK * singular[0]
            inside = u[:, kept].T @ target
            residues = (v[kept].T / singular[kept]) @ inside
            found.append(_Projection(residues, target - u[:, kept] @ inside, u[:, kept]))
        return found

    def compute_residual(self, x: FloatArray) -> FloatArray:
        prior = self.weight * np.ascontiguousarray(self.unpack(x)[1]).view(np.float64)
        return np.asarray(np.concatenate([*(each.rest.ravel() for each in self.project(x)), prior]), dtype=np.float64)

    def differentiate(self, x: FloatArray) -> FloatArray:
        """Return Kaufman's Jacobian, [rows, parameters]: the residues' own change is projected out."""
        logs, changes, gains = self.unpack(x)
        columns, law, blocks = self._columns_by_level(x), self.law[:, None, None], []
        # Of each mode and amplitude, [m, a, 1, 1]: the pole in z and its derivative by log λ.
        poles = np.exp(logs[:, None] + changes[:, None] * self.law)[:, :, None, None] / self.rate_hz
        at, slope = np.exp(poles), poles * np.exp(poles)
        for row, (part, gain) in enumerate(zip(self.project(x), gains, strict=True)):
            pairs = part.residues[: 2 * len(logs)].reshape(len(logs), 2, -1)
            moved = (pairs[:, 0] + 1j * pairs[:, 1])[:, None, None] * slope
            first, second = moved / (self.z[:, None] - at) ** 2, moved.conj() / (self.z[:, None] - at.conj()) ** 2
            by_log = np.stack([first + second, 1j * (first - second)], axis=1) * (1.0 + gain * law)
            by_log = by_log.reshape(2 * len(logs), *by_log.shape[2:])
            of_gain = np.stack([each @ part.residues * a for each, a in zip(columns, self.law, strict=True)])
            of_gains = [of_gain * unit * (other == row) for other in range(len(gains)) for unit in (1.0, 1j)]
            block = np.stack([_stack(np.concatenate(each)) for each in (*by_log, *(by_log * law), *of_gains)], axis=2)
            block -= np.tensordot(part.columns, np.tensordot(part.columns, block, axes=(0, 0)), axes=1)
            blocks.append(-block.reshape(-1, len(x)))
        prior = np.zeros((2 * len(changes), len(x)))
        prior[:, 2 * len(logs) : 4 * len(logs)] = self.weight * np.eye(2 * len(changes))
        return np.concatenate([*blocks, prior])
