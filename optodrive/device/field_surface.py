"""The part of a field that no mirror, lens or board explains: a smooth surface on each axis, of low order.

Products of Legendre polynomials of each axis, of total degree 2 to ORDER; lower ones would only say again what the
physical part says. Beyond the extent it goes on as at the edge.
"""

from dataclasses import dataclass

import numpy as np

from optodrive.core.types.arrays import FloatArray

ORDER = 6
DEGREES = [(i, total - i) for total in range(2, ORDER + 1) for i in range(total + 1)]
"""Degrees in x and y of each term."""
TERM_COUNT = len(DEGREES)
VARIANCE_RATIO = 0.5
"""Each degree has so much of the variance of the one below before anything is measured: what is left is smooth."""


@dataclass(frozen=True)
class Extent:
    """The codes for which a field is made: from x_code ∓ x_half to ±, the same for y."""

    x_code: float
    y_code: float
    x_half: float
    y_half: float

    def normalise(self, x_code: FloatArray, y_code: FloatArray) -> tuple[FloatArray, FloatArray]:
        """−1 to 1 inside; any shape."""
        return (x_code - self.x_code) / self.x_half, (y_code - self.y_code) / self.y_half

    def build_grid(self, count: int) -> tuple[FloatArray, FloatArray]:
        """Codes of count × count places from edge to edge, [count²] each, x runs faster."""
        shares = np.linspace(-1.0, 1.0, count)
        y_share, x_share = np.meshgrid(shares, shares, indexing="ij")
        return self.x_code + self.x_half * x_share.ravel(), self.y_code + self.y_half * y_share.ravel()


def evaluate_terms(extent: Extent, x_code: FloatArray, y_code: FloatArray) -> FloatArray:
    """Every term at codes [n]: [n, TERMS]; each has mean square 1 over the extent."""
    x_share, y_share = (np.clip(share, -1.0, 1.0) for share in extent.normalise(x_code, y_code))
    along_x, along_y = _evaluate_legendre(x_share), _evaluate_legendre(y_share)
    out = np.empty((len(x_share), TERM_COUNT), order="F")
    for at, (i, j) in enumerate(DEGREES):
        np.multiply(along_x[i], along_y[j], out=out[:, at])
    return out


def compute_prior_widths() -> FloatArray:
    """Prior width of each term's coefficient for a surface of 1 rms over the extent, [TERMS]."""
    degree = np.array([i + j for i, j in DEGREES])
    variance = VARIANCE_RATIO ** (degree - 2.0) / (degree + 1.0)
    width: FloatArray = np.sqrt(variance / variance.sum())
    return width


def _evaluate_legendre(position: FloatArray) -> list[FloatArray]:
    """Polynomials of degree 0 to ORDER, each of mean square 1 on −1 to 1."""
    plain = [np.ones_like(position), position]
    for n in range(1, ORDER):
        plain.append(((2 * n + 1) * position * plain[n] - n * plain[n - 1]) / (n + 1))
    return [np.sqrt(2 * n + 1) * each for n, each in enumerate(plain)]
