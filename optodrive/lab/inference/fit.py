"""Least squares within bounds, for every program that estimates parameters from residuals."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.optimize import least_squares

from optodrive.core.types.arrays import BoolArray, FloatArray


@dataclass(frozen=True, eq=False)
class Prior:
    """Independent normal priors of the parameters.

    mean, sigma: [k]; an infinite sigma states nothing about its parameter
    """

    mean: FloatArray
    sigma: FloatArray


@dataclass(frozen=True, eq=False)
class Fit:
    """A point of least squares.

    x: [k] parameters; residual: [m] there, without priors; chi2: sum of its squares and of the priors' terms;
    covariance: [k, k] for residuals in units of the noise, 0 of fixed parameters
    """

    x: FloatArray
    residual: FloatArray
    chi2: float
    covariance: FloatArray

    @property
    def sigma(self) -> FloatArray:
        """Standard deviation of each parameter, [k]."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def fit_residuals(
    compute_residual: Callable[[FloatArray], FloatArray],
    start: FloatArray,
    bounds: tuple[FloatArray, FloatArray],
    step: FloatArray | float,
    *,
    free: BoolArray | None = None,
    prior: Prior | None = None,
    evaluations: int = 60,
    tolerance: float = 1e-8,
    method: Literal["trf", "dogbox"] = "trf",
) -> Fit:
    """Minimise the sum of squares of residuals [m] over parameters [k] within bounds.

    step: of the derivatives' finite differences, in each parameter's unit; free: [k], parameters that are fitted, all
    whose bounds differ by default; evaluations: largest number of steps; tolerance: relative, of the sum and of the
    point, below which the fit ends; method: "dogbox" where the optimum is often at a bound, for it ends there exactly
    """
    low, high = (np.broadcast_to(np.asarray(each, dtype=np.float64), start.shape) for each in bounds)
    steps = np.broadcast_to(np.asarray(step, dtype=np.float64), start.shape)
    is_free = (high > low) & (True if free is None else free)
    fixed = np.where(is_free, np.clip(start, low, high), start)
    rows = np.flatnonzero(is_free)
    stated = np.zeros(0, dtype=np.int64) if prior is None else np.flatnonzero(is_free & np.isfinite(prior.sigma))

    def expand(part: FloatArray) -> FloatArray:
        whole = fixed.copy()
        whole[rows] = part
        return whole

    def compute(part: FloatArray) -> FloatArray:
        whole = expand(part)
        residual = np.asarray(compute_residual(whole), dtype=np.float64)
        if prior is None:
            return residual
        return np.append(residual, (whole - prior.mean)[stated] / prior.sigma[stated])

    last = [fixed[rows], compute(fixed[rows])]  # derivatives begin at the point whose residuals were computed last

    def recall(part: FloatArray) -> FloatArray:
        if not np.array_equal(part, last[0]):
            last[:] = part.copy(), compute(part)
        return last[1]

    def differentiate(part: FloatArray) -> FloatArray:
        at, columns = recall(part), np.empty((size, len(rows)))
        for column, row in enumerate(rows):
            shifted = part.copy()
            # A difference looks inside the bounds, where the model is defined.
            shifted[column] += steps[row] if part[column] + steps[row] <= high[row] else -steps[row]
            columns[:, column] = (compute(shifted) - at) / (shifted[column] - part[column])
        return columns

    covariance = np.zeros((len(start), len(start)))
    first = last[1]
    size = len(first)
    if not len(rows):
        return Fit(fixed, first, float(first @ first), covariance)
    found = least_squares(
        recall,
        fixed[rows],
        jac=differentiate,
        bounds=(low[rows], high[rows]),
        method=method,
        x_scale="jac",
        ftol=tolerance,
        xtol=tolerance,
        max_nfev=evaluations,
    )
    # Units differ by orders of magnitude, so the cut of small singular values needs columns of one length.
    length = np.linalg.norm(found.jac, axis=0)
    length[length == 0.0] = 1.0
    inverse = np.linalg.pinv((found.jac / length).T @ (found.jac / length))
    covariance[np.ix_(rows, rows)] = inverse / np.outer(length, length)
    return Fit(expand(found.x), found.fun[: size - len(stated)], 2.0 * float(found.cost), covariance)
