"""Smooth correction of a scan field per axis, for errors that the physical geometry does not explain.

It is a sum of products of Legendre polynomials of both axes, of total degree 2 to ORDER; the physical geometry covers
the lower degrees. Outside the extent it keeps its value at the edge.
"""

from dataclasses import dataclass

import numpy as np

from optodrive.core.types.arrays import FloatArray

ORDER = 6
DEGREES = [(i, total - i) for total in range(2, ORDER + 1) for i in range(total + 1)]
"""Degrees in x and y of each term."""
TERM_COUNT = len(DEGREES)
VARIANCE_RATIO = 0.5
"""Prior variance of each total degree over that of the degree below."""


@dataclass(frozen=True)
class Extent:
    """Range of codes for which a field is calibrated: x_code ± x_half and y_code ± y_half."""

    x_code: float
    y_code: float
    x_half: float
    y_half: float

    def normalise(self, x_code: FloatArray, y_code: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return codes of any shape in units of the half range from the centre, −1 to 1 inside."""
        return (x_code - self.x_code) / self.x_half, (y_code - self.y_code) / self.y_half

    def build_grid(self, count: int) -> tuple[FloatArray, FloatArray]:
        """Return the codes of count × count points from edge to edge, [count²] each, with x as the fast index."""
        axis = np.linspace(-1.0, 1.0, count)
        v, u = np.meshgrid(axis, axis, indexing="ij")
        return self.x_code + self.x_half * u.ravel(), self.y_code + self.y_half * v.ravel()


def evaluate_terms(extent: Extent, x_code: FloatArray, y_code: FloatArray) -> FloatArray:
    """Return every term at codes [n], [n, TERM_COUNT], each with mean square 1 over the extent."""
    u, v = (np.clip(axis, -1.0, 1.0) for axis in extent.normalise(x_code, y_code))
    along_x, along_y = _evaluate_legendre(u), _evaluate_legendre(v)
    out = np.empty((len(u), TERM_COUNT), order="F")
    for at, (i, j) in enumerate(DEGREES):
        np.multiply(along_x[i], along_y[j], out=out[:, at])
    return out


def compute_prior_widths() -> FloatArray:
    """Return the prior standard deviation of each coefficient, [TERM_COUNT], for a surface of rms 1 over the extent."""
    degree = np.array([i + j for i, j in DEGREES])
    variance = VARIANCE_RATIO ** (degree - 2.0) / (degree + 1.0)
    width: FloatArray = np.sqrt(variance / variance.sum())
    return width


def _evaluate_legendre(position: FloatArray) -> list[FloatArray]:
    """Return the Legendre polynomials of degree 0 to ORDER, each with mean square 1 on −1 to 1."""
    plain = [np.ones_like(position), position]
    for n in range(1, ORDER):
        plain.append(((2 * n + 1) * position * plain[n] - n * plain[n - 1]) / (n + 1))
    return [np.sqrt(2 * n + 1) * each for n, each in enumerate(plain)]
