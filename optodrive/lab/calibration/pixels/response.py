"""Response of a run, the ratio of a pixel's measured heights to the model's prediction for its pulses."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.measurements import Run

SIGNAL = "displacement_m"
PredictHeights = Callable[[FloatArray, int, FloatArray], FloatArray]
"""Heights of a pixel, m, at times [m] under pulses [n, 4]."""
SAMPLES_MIN = 8
"""Smallest number of samples of a response."""
CLIPPING_ITERATIONS_MAX = 5
"""Largest number of iterations of outlier rejection."""
CLIPPING_SIGMAS = 5.0
"""Residual in sigmas above which a sample is rejected."""
MAD_TO_SIGMA = 1.4826
"""Sigma per median absolute deviation of a normal distribution."""
RELATIVE_SIGMA_MIN = 1e-4
"""Smallest relative sigma of a response."""
PREDICTED_RANGE_MIN_M = 1e-7
"""Smallest range of predicted heights, m; a run below it does not determine the gain."""


class PixelResponse(NamedTuple):
    """Response of a pixel in one run.

    ratio: measured over predicted height, with one standard error sigma; aim: beam position from the pixel's middle
    """

    pixel: int
    aim_x_m: float
    aim_y_m: float
    ratio: float
    sigma: float


def compute_response(
    where: str, run: Run, predict: PredictHeights, aim_max_m: tuple[float, float]
) -> PixelResponse | None:
    """Return the response of a run, or None without heights, pulses on the pixel, or enough samples.

    Raises InputError for an aim that is not a number or beyond aim_max_m.
    """
    x_m, y_m = (_read_aim_m(where, run, axis, limit_m) for axis, limit_m in zip("xy", aim_max_m, strict=True))
    signal = run.signals.get(SIGNAL)
    if signal is None:
        return None
    is_finite = np.isfinite(signal.value)
    if int(is_finite.sum()) < SAMPLES_MIN or not np.any(run.pulses[:, 3] == signal.pixel):
        return None
    predicted_m = predict(run.pulses, signal.pixel, np.array(signal.t_s[is_finite]))
    if np.ptp(predicted_m) < PREDICTED_RANGE_MIN_M:
        return None
    ratio_and_sigma = _fit_ratio(predicted_m, signal.value[is_finite])
    return None if ratio_and_sigma is None else PixelResponse(signal.pixel, x_m, y_m, *ratio_and_sigma)


def _fit_ratio(predicted_m: FloatArray, measured_m: FloatArray) -> tuple[float, float] | None:
    """Return the ratio to a prediction and its sigma, with an unknown instrument offset and outliers rejected."""
    is_inlier = np.ones(len(measured_m), dtype=np.bool_)
    design = np.column_stack([predicted_m, np.ones(len(predicted_m))])
    for _ in range(CLIPPING_ITERATIONS_MAX):
        solution = np.linalg.lstsq(design[is_inlier], measured_m[is_inlier], rcond=None)[0]
        residual_m = measured_m - design @ solution
        typical_m = MAD_TO_SIGMA * float(np.median(np.abs(residual_m[is_inlier])))
        still_inlier = np.abs(residual_m) <= CLIPPING_SIGMAS * typical_m if typical_m > 0.0 else is_inlier
        if np.array_equal(still_inlier, is_inlier):
            break
        is_inlier = still_inlier
    count = int(is_inlier.sum())
    if count < SAMPLES_MIN or np.ptp(predicted_m[is_inlier]) < PREDICTED_RANGE_MIN_M:
        return None
    variance = float((residual_m[is_inlier] ** 2).sum()) / (count - 2)
    sum_of_squares = float(((predicted_m[is_inlier] - predicted_m[is_inlier].mean()) ** 2).sum())
    ratio = float(solution[0])
    return ratio, float(np.hypot(np.sqrt(variance / sum_of_squares), RELATIVE_SIGMA_MIN * max(1.0, abs(ratio))))


def _read_aim_m(where: str, run: Run, axis: str, aim_max_m: float) -> float:
    key = f"aim_{axis}_m"
    aim_m = run.attributes.get(key, 0.0)
    if isinstance(aim_m, str) or not abs(aim_m) <= aim_max_m:
        expected = f"a number of metres from the pixel's middle, at most ±{aim_max_m:.6g}"
        raise InputError(f"{where}: /runs/{run.name}: {key}", aim_m, expected)
    return float(aim_m)
