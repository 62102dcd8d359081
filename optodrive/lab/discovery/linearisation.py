"""Derivatives of a model along one record, the filter that uses them, and how a change spreads through the record.

Theory of operation. A term or a parameter changes the predictions, to first order, by a linear recursion over the
samples: it forces the states, the states carry the change on, and the filter's gains take a part of it back. One
recursion serves both, a thousand columns per second.
"""

from math import isfinite
from typing import NamedTuple

import numpy as np

from optodrive.core.kernels import array_kernel, kernel
from optodrive.core.types.arrays import FloatArray


class Linearisation(NamedTuple):
    """Derivatives along one record of m samples: n states, o outputs, q parameters.

    predicted, variance: [m, o] outputs and their expected variance; states: [m, n] corrected; gains: [m, n, o];
    transition: [m, n, n] from one corrected state to the next predicted one; response: [m, n, n] by a constant rate in
    each equation meanwhile; forcing: [m, n, q]; observation: [m, o, n]; direct: [m, o, q]
    """

    predicted: FloatArray
    variance: FloatArray
    states: FloatArray
    gains: FloatArray
    transition: FloatArray
    response: FloatArray
    forcing: FloatArray
    observation: FloatArray
    direct: FloatArray

    @classmethod
    def allocate(cls, m: int, n: int, o: int, q: int) -> "Linearisation":
        """Return arrays of zeros."""
        shapes = ((m, o), (m, o), (m, n), (m, n, o), (m, n, n), (m, n, n), (m, n, q), (m, o, n), (m, o, q))
        return cls(*(np.zeros(shape) for shape in shapes))

    def propagate(self, forcing: FloatArray, direct: FloatArray, start: FloatArray) -> FloatArray:
        """Return the change of the predictions [m, o, q] by q causes.

        forcing: [m, n, q] of the states since the sample before; direct: [m, o, q] of the outputs; start: [n, q] of the
        first state
        """
        return _propagate(self.transition, self.observation, self.gains, forcing, direct, start)


@kernel
def copy(values: FloatArray, out: FloatArray) -> None:
    """Copy one vector to another: to compile a slice assignment takes seconds, most of them for its error message."""
    for j in range(len(out)):
        out[j] = values[j]


@kernel
def correct(
    x: FloatArray,
    covariance: FloatArray,
    observation: FloatArray,
    noise: FloatArray,
    y: FloatArray,
    predicted: FloatArray,
    variance: FloatArray,
    gains: FloatArray,
) -> None:
    """Correct states and covariance by each output that was measured, and write their joint gains."""
    n, o = len(x), len(y)
    for j in range(o):
        s = noise[j]
        for a in range(n):
            for b in range(n):
                s += observation[j, a] * covariance[a, b] * observation[j, b]
        variance[j] = s
        if not (isfinite(y[j]) and isfinite(s) and s > 0.0):
            continue
        for a in range(n):
            total = 0.0
            for b in range(n):
                total += covariance[a, b] * observation[j, b]
            gains[a, j] = total / s
        # The gains of earlier outputs of this sample already move this output.
        for other in range(j):
            moves = 0.0
            for a in range(n):
                moves += observation[j, a] * gains[a, other]
            for a in range(n):
                gains[a, other] -= gains[a, j] * moves
        for a in range(n):
            for b in range(n):
                covariance[a, b] -= gains[a, j] * s * gains[b, j]
    for j in range(o):
        if isfinite(y[j]):
            for a in range(n):
                x[a] += gains[a, j] * (y[j] - predicted[j])


@kernel
def predict_covariance(
    covariance: FloatArray, half: FloatArray, transition: FloatArray, noise_rate: FloatArray, dt_s: float
) -> None:
    """Carry the covariance to the next sample, in place."""
    n = len(covariance)
    for a in range(n):
        for b in range(n):
            half[a, b] = 0.0
            for c in range(n):
                half[a, b] += transition[a, c] * covariance[c, b]
    for a in range(n):
        for b in range(n):
            total = noise_rate[a] * dt_s if a == b else 0.0
            for c in range(n):
                total += half[a, c] * transition[b, c]
            covariance[a, b] = total


@array_kernel
def _propagate(
    transition: FloatArray,
    observation: FloatArray,
    gains: FloatArray,
    forcing: FloatArray,
    direct: FloatArray,
    start: FloatArray,
) -> FloatArray:
    """Carry out `Linearisation.propagate`."""
    m, n, count = forcing.shape
    o = direct.shape[1]
    out, delta, moved = np.zeros((m, o, count)), start.copy(), np.zeros((n, count))
    for k in range(m):
        if k > 0:
            for s in range(n):
                for q in range(count):
                    total = forcing[k, s, q]
                    for j in range(n):
                        total += transition[k, s, j] * delta[j, q]
                    moved[s, q] = total
            for s in range(n):
                copy(moved[s], delta[s])
        for j in range(o):
            for q in range(count):
                total = direct[k, j, q]
                for s in range(n):
                    total += observation[k, j, s] * delta[s, q]
                out[k, j, q] = total
        for s in range(n):
            for j in range(o):
                for q in range(count):
                    delta[s, q] -= gains[k, s, j] * out[k, j, q]
    return out
