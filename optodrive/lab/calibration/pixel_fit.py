"""Fit of one pixel's gain and offset to its responses: the ratios of measured heights to the model's prediction.

The focus is modelled as a uniform rectangle: the fraction on the absorber decreases linearly from one to zero while the
focus crosses an edge. An offset is therefore determined only along an axis on which aims cross both edges.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.types.arrays import BoolArray, FloatArray
from optodrive.core.types.measurements import Run
from optodrive.device.config import Config
from optodrive.device.pixel_map import DEAD, GAIN_MAX, GAIN_MIN, MEASURED, NOT_MEASURED, max_aim_offset_m

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
SIGNIFICANCE_SIGMAS = 3.0
"""Sigmas by which a significant response differs from a value."""
GAIN_SIGMA_MAX = 0.1
"""Largest sigma of a usable gain."""
OFFSET_SIGMA_MAX_M = 1e-4
"""Largest sigma of a usable offset, m."""
EDGE_FRACTION_MIN = 0.02
"""Smallest fractions of the focus on and off the absorber for an aim that crosses an edge."""
REDUCED_CHI2_MAX = 2.0
"""Reduced chi-square above which the sigmas are enlarged."""
GRID_OFFSETS = 41
"""Offsets per axis of the initial grid search."""
DERIVATIVE_STEPS = (1e-6, 1e-9, 1e-9)
"""Steps of the derivatives by gain and by offsets, m."""


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


class PixelEstimate(NamedTuple):
    """Estimate of one pixel. Sigmas are NaN if not determined."""

    state: str
    gain: float
    gain_sigma: float
    offset_m: tuple[float, float]
    offset_sigma_m: tuple[float, float]


NO_ESTIMATE = PixelEstimate(NOT_MEASURED, 1.0, np.nan, (0.0, 0.0), (np.nan, np.nan))


@dataclass(frozen=True)
class Optics:
    """Half widths of absorber and focus, and the largest plausible offset, x and y, m."""

    absorber_half_m: tuple[float, float]
    focus_half_m: tuple[float, float]
    offset_max_m: tuple[float, float]

    @classmethod
    def from_config(cls, config: Config) -> "Optics":
        """Build the optics of a configuration."""
        display, laser = config.display, config.laser
        return cls(
            (display.absorber_width_m / 2.0, display.absorber_height_m / 2.0),
            (laser.focus_width_m / 2.0, laser.focus_height_m / 2.0),
            max_aim_offset_m(config),
        )

    def absorbed_fraction(self, axis: int, offset_m: FloatArray) -> FloatArray:
        """Return the fraction of the focus on the absorber at an offset of any shape between their centres."""
        focus_half_m = self.focus_half_m[axis]
        overlap_m = self.absorber_half_m[axis] + focus_half_m - np.abs(offset_m)
        return np.asarray(np.clip(overlap_m / (2.0 * focus_half_m), 0.0, 1.0), dtype=np.float64)

    def search_range_m(self, axis: int) -> float:
        """Return the largest searched offset, m. Beyond it hardly any of the focus is on the absorber."""
        return min(self.offset_max_m[axis], self.absorber_half_m[axis] + 0.6 * self.focus_half_m[axis])


class ResponseTable(NamedTuple):
    """Responses of one pixel as columns [k], aim_m [2, k]."""

    aim_m: FloatArray
    ratio: FloatArray
    sigma: FloatArray

    @classmethod
    def build(cls, responses: list[PixelResponse]) -> "ResponseTable":
        """Tabulate responses."""
        _, x_m, y_m, ratio, sigma = np.array(responses, dtype=np.float64).T
        return cls(np.array([x_m, y_m]), ratio, sigma)


def fit_pixel(responses: list[PixelResponse], optics: Optics) -> PixelEstimate:
    """Fit gain and offset of one pixel to its responses at any aims."""
    if not responses:
        return NO_ESTIMATE
    table = ResponseTable.build(responses)
    if is_dead(table.ratio, table.sigma, select_centred(table.aim_m, optics)):
        return NO_ESTIMATE._replace(state=DEAD)
    is_offset_free = [_crosses_both_edges(table.aim_m[axis], optics, axis) for axis in range(2)]
    for axis in range(2):
        if not is_offset_free[axis]:  # the absorbed fraction of an aim near only one edge is unknown
            is_whole = optics.absorbed_fraction(axis, table.aim_m[axis]) == 1.0
            table = ResponseTable(*(column[..., is_whole] for column in table))
    if not len(table.ratio):
        return NO_ESTIMATE
    gain, offset_m = _search_offsets(table, optics, is_offset_free)
    gain, offset_m, sigma = _fit_from(table, optics, is_offset_free, gain, offset_m)
    if not (sigma[0] <= GAIN_SIGMA_MAX and GAIN_MIN <= gain <= GAIN_MAX):
        return NO_ESTIMATE
    ends_m = [optics.search_range_m(axis) for axis in range(2)]
    is_known = np.array(is_offset_free) & (sigma[1:] <= OFFSET_SIGMA_MAX_M) & (np.abs(offset_m) < ends_m)
    x_m, y_m = np.where(is_known, offset_m, 0.0).tolist()
    x_sigma_m, y_sigma_m = np.where(is_known, sigma[1:], np.nan).tolist()
    return PixelEstimate(MEASURED, gain, float(sigma[0]), (x_m, y_m), (x_sigma_m, y_sigma_m))


def select_centred(aim_m: FloatArray, optics: Optics) -> BoolArray:
    """Return which aims [2, k] have the whole focus nominally on the absorber.

    If there are none, return those with at least half.
    """
    fraction = optics.absorbed_fraction(0, aim_m[0]) * optics.absorbed_fraction(1, aim_m[1])
    is_whole = fraction > 1.0 - EDGE_FRACTION_MIN
    return np.asarray(is_whole if is_whole.any() else fraction >= 0.5, dtype=np.bool_)


def weighted_mean(value: FloatArray, sigma: FloatArray) -> tuple[float, float]:
    """Return the weighted mean and its sigma."""
    weight = 1.0 / sigma**2
    return float((weight * value).sum() / weight.sum()), float(weight.sum() ** -0.5)


def is_dead(ratio: FloatArray, sigma: FloatArray, is_centred: BoolArray) -> bool:
    """Return whether a pixel has no significant response although some aims were centred."""
    if not is_centred.any():
        return False
    mean, mean_sigma = weighted_mean(ratio[is_centred], sigma[is_centred])
    responds = np.any(ratio - SIGNIFICANCE_SIGMAS * sigma > GAIN_MIN)
    return bool(mean + SIGNIFICANCE_SIGMAS * mean_sigma < GAIN_MIN and not responds)


def _crosses_both_edges(aim_m: FloatArray, optics: Optics, axis: int) -> bool:
    """Return whether aims cross both edges of an axis."""
    fraction = optics.absorbed_fraction(axis, aim_m)
    edge = (fraction > EDGE_FRACTION_MIN) & (fraction < 1.0 - EDGE_FRACTION_MIN)
    return bool(np.any(edge & (aim_m > 0)) and np.any(edge & (aim_m < 0)))


def _search_offsets(table: ResponseTable, optics: Optics, is_offset_free: list[bool]) -> tuple[float, FloatArray]:
    """Return gain and offset with the smallest chi-square on a grid of offsets."""
    grid, offsets_m, fractions = np.linspace(-1.0, 1.0, GRID_OFFSETS), [], []
    for axis in range(2):
        offsets_m.append(grid * optics.search_range_m(axis) if is_offset_free[axis] else np.zeros(1))
        fractions.append(optics.absorbed_fraction(axis, table.aim_m[axis] - offsets_m[axis][:, None]))
    fraction = fractions[0][:, None] * fractions[1][None]
    weight = 1.0 / table.sigma**2
    gain = (fraction * weight * table.ratio).sum(-1) / np.maximum(1e-12, (fraction**2 * weight).sum(-1))
    chi2 = (weight * (table.ratio - gain[..., None] * fraction) ** 2).sum(-1)
    x_at, y_at = np.unravel_index(int(chi2.argmin()), chi2.shape)
    return float(gain[x_at, y_at]), np.array([offsets_m[0][x_at], offsets_m[1][y_at]])


def _fit_from(
    table: ResponseTable, optics: Optics, is_offset_free: list[bool], gain: float, offset_m: FloatArray
) -> tuple[float, FloatArray, FloatArray]:
    """Return gain, offset and their standard errors [3], enlarged if the residuals exceed the stated sigmas."""
    from optodrive.lab.inference.fit import fit_residuals  # a sweep needs no scipy

    def compute_residual(x: FloatArray) -> FloatArray:
        fractions = [optics.absorbed_fraction(axis, table.aim_m[axis] - x[1 + axis]) for axis in range(2)]
        return np.asarray((table.ratio - x[0] * fractions[0] * fractions[1]) / table.sigma)

    ends = np.array([np.inf, optics.search_range_m(0), optics.search_range_m(1)])
    free, start = np.array([True, *is_offset_free]), np.array([gain, *offset_m])
    fit = fit_residuals(compute_residual, start, (-ends, ends), np.array(DERIVATIVE_STEPS), free=free)
    sigma = np.where(free & (fit.sigma > 0.0), fit.sigma, np.inf)  # 0: no response depends on it
    degrees_of_freedom = len(table.ratio) - int(free.sum())
    reduced_chi2 = fit.chi2 / degrees_of_freedom if degrees_of_freedom > 0 else 1.0
    return float(fit.x[0]), fit.x[1:], sigma * np.sqrt(reduced_chi2 if reduced_chi2 > REDUCED_CHI2_MAX else 1.0)
