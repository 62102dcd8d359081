"""Responses to one pixel's gain and offset.

The focus is taken as an evenly lit rectangle, as everywhere here: what of it lies on the absorber falls straight from
all to nothing while it crosses an edge. Which response belongs to which offset is therefore known only where the beam
was aimed across the edges, on both sides.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from optodrive.core.types.arrays import BoolArray, FloatArray
from optodrive.device.config import Config
from optodrive.device.pixel_map import DEAD, GAIN_LEAST, GAIN_MOST, MEASURED, NOT_MEASURED, offset_most_m
from optodrive.lab.calibration.pixels.response import Response

SURELY = 3.0
"""So many sigmas make a response surely less, or more, than something."""
GAIN_SIGMA_MOST = 0.1
OFFSET_SIGMA_MOST_M = 1e-4
"""What is known less well is not used."""
FOUND_SHARE = 0.02
"""An aim is across an edge where so much of the focus lies on it, and so much beside it, at the least."""
DISAGREE = 2.0
"""Responses that are off by more than so many times their variance are less sure than they say."""
PLACES = 41
STEPS = 12


class Found(NamedTuple):
    """One pixel as found. Sigmas are NaN where nothing was."""

    state: str
    gain: float
    gain_sigma: float
    offset_m: tuple[float, float]
    offset_sigma_m: tuple[float, float]


NOTHING = Found(NOT_MEASURED, 1.0, np.nan, (0.0, 0.0), (np.nan, np.nan))


@dataclass(frozen=True)
class Optics:
    """Half-widths of absorber and focus, and the farthest offset believed, x and y, m."""

    absorber_m: tuple[float, float]
    focus_m: tuple[float, float]
    most_m: tuple[float, float]

    @classmethod
    def of(cls, config: Config) -> "Optics":
        """Those of a configuration."""
        display, laser = config.display, config.laser
        return cls(
            (display.absorber_width_m / 2.0, display.absorber_height_m / 2.0),
            (laser.focus_width_m / 2.0, laser.focus_height_m / 2.0),
            offset_most_m(config),
        )

    def share(self, axis: int, off_m: FloatArray) -> FloatArray:
        """How much of the focus lies on the absorber, its middle off_m from the absorber's; any shape."""
        focus_m = self.focus_m[axis]
        over_m = self.absorber_m[axis] + focus_m - np.abs(off_m)
        return np.asarray(np.clip(over_m / (2.0 * focus_m), 0.0, 1.0), dtype=np.float64)

    def slope_per_m(self, axis: int, off_m: FloatArray) -> FloatArray:
        """How that changes with off_m."""
        share = self.share(axis, off_m)
        inside = (share > 0.0) & (share < 1.0)
        return np.where(inside, -np.sign(off_m) / (2.0 * self.focus_m[axis]), 0.0)

    def farthest_m(self, axis: int) -> float:
        """Offsets are looked for so far either way: beyond it hardly any focus is left on the absorber."""
        return min(self.most_m[axis], self.absorber_m[axis] + 0.6 * self.focus_m[axis])


@dataclass(frozen=True, eq=False)
class _Table:
    """Responses of one pixel as columns [k]; aim_m [2, k]."""

    aim_m: FloatArray
    value: FloatArray
    sigma: FloatArray

    def rows(self, kept: BoolArray) -> "_Table":
        return _Table(self.aim_m[:, kept], self.value[kept], self.sigma[kept])


def fit_pixel(responses: list[Response], optics: Optics) -> Found:
    """What responses of one pixel, to any aims, say of it."""
    if not responses:
        return NOTHING
    table = _Table(
        np.array([[item.aim_x_m for item in responses], [item.aim_y_m for item in responses]]),
        np.array([item.value for item in responses]),
        np.array([item.sigma for item in responses]),
    )
    if is_dead(table.value, table.sigma, centred(table.aim_m, optics)):
        return NOTHING._replace(state=DEAD)
    free = [_across(table.aim_m[axis], optics, axis) for axis in range(2)]
    for axis in range(2):
        if not free[axis]:  # nobody knows how much of the focus an aim near one edge leaves on the absorber
            table = table.rows(optics.share(axis, table.aim_m[axis]) == 1.0)
    if not len(table.value):
        return NOTHING
    gain, offset_m = _refined(table, optics, free, *_nearest(table, optics, free))
    sigma = _sigmas(table, optics, free, gain, offset_m)
    if not (sigma[0] <= GAIN_SIGMA_MOST and GAIN_LEAST <= gain <= GAIN_MOST):
        return NOTHING
    known = [
        free[axis] and sigma[1 + axis] <= OFFSET_SIGMA_MOST_M and abs(offset_m[axis]) < optics.farthest_m(axis)
        for axis in range(2)
    ]
    x_m, y_m = (float(offset_m[axis]) if known[axis] else 0.0 for axis in range(2))
    x_sigma_m, y_sigma_m = (float(sigma[1 + axis]) if known[axis] else float("nan") for axis in range(2))
    return Found(MEASURED, gain, float(sigma[0]), (x_m, y_m), (x_sigma_m, y_sigma_m))


def centred(aim_m: FloatArray, optics: Optics) -> BoolArray:
    """Aims [2, k] with the whole focus nominally on the absorber; without any, those with half of it."""
    share = optics.share(0, aim_m[0]) * optics.share(1, aim_m[1])
    whole = share > 1.0 - FOUND_SHARE
    return np.asarray(whole if whole.any() else share >= 0.5, dtype=np.bool_)


def mean_of(value: FloatArray, sigma: FloatArray) -> tuple[float, float]:
    """Weighted mean and its sigma."""
    weight = 1.0 / sigma**2
    return float((weight * value).sum() / weight.sum()), float(weight.sum() ** -0.5)


def is_dead(value: FloatArray, sigma: FloatArray, on_it: BoolArray) -> bool:
    """Whether a pixel surely responds to no aim, though some were on it."""
    if not on_it.any():
        return False
    mean, unsure = mean_of(value[on_it], sigma[on_it])
    answers = np.any(value - SURELY * sigma > GAIN_LEAST)
    return bool(mean + SURELY * unsure < GAIN_LEAST and not answers)


def _across(aim_m: FloatArray, optics: Optics, axis: int) -> bool:
    share = optics.share(axis, aim_m)
    edge = (share > FOUND_SHARE) & (share < 1.0 - FOUND_SHARE)
    return bool(np.any(edge & (aim_m > 0)) and np.any(edge & (aim_m < 0)))


def _nearest(table: _Table, optics: Optics, free: list[bool]) -> tuple[float, FloatArray]:
    """Gain and offset of the best of many offsets."""
    tried = [
        np.linspace(-1.0, 1.0, PLACES) * optics.farthest_m(axis) if free[axis] else np.zeros(1) for axis in range(2)
    ]
    x_share, y_share = (optics.share(axis, table.aim_m[axis] - tried[axis][:, None]) for axis in range(2))
    share = x_share[:, None] * y_share[None]
    weight = 1.0 / table.sigma**2
    gain = (share * weight * table.value).sum(-1) / np.maximum(1e-12, (share**2 * weight).sum(-1))
    left = (weight * (table.value - gain[..., None] * share) ** 2).sum(-1)
    x_at, y_at = np.unravel_index(int(left.argmin()), left.shape)
    return float(gain[x_at, y_at]), np.array([tried[0][x_at], tried[1][y_at]])


def _modelled(table: _Table, optics: Optics, gain: float, offset_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Responses [k], and their derivatives by gain and both offsets [k, 3]."""
    x_off_m, y_off_m = table.aim_m - offset_m[:, None]
    x_share, y_share = optics.share(0, x_off_m), optics.share(1, y_off_m)
    by_x = -gain * optics.slope_per_m(0, x_off_m) * y_share
    by_y = -gain * optics.slope_per_m(1, y_off_m) * x_share
    return gain * x_share * y_share, np.column_stack([x_share * y_share, by_x, by_y])


def _badness(table: _Table, optics: Optics, gain: float, offset_m: FloatArray) -> float:
    return float((((table.value - _modelled(table, optics, gain, offset_m)[0]) / table.sigma) ** 2).sum())


def _refined(
    table: _Table, optics: Optics, free: list[bool], gain: float, offset_m: FloatArray
) -> tuple[float, FloatArray]:
    """Gauss and Newton from the best place tried; a step that makes it worse is halved."""
    columns = np.array([True, *free])
    best = _badness(table, optics, gain, offset_m)
    for _ in range(STEPS):
        expected, derivative = _modelled(table, optics, gain, offset_m)
        step = np.zeros(3)
        scaled = derivative[:, columns] / table.sigma[:, None]
        step[columns] = np.linalg.lstsq(scaled, (table.value - expected) / table.sigma, rcond=None)[0]
        for _ in range(STEPS):
            tried = gain + step[0], offset_m + step[1:]
            badness = _badness(table, optics, *tried)
            if badness < best:
                break
            step *= 0.5
        else:
            break
        (gain, offset_m), best = (float(tried[0]), tried[1]), badness
    return gain, offset_m


def _sigmas(table: _Table, optics: Optics, free: list[bool], gain: float, offset_m: FloatArray) -> FloatArray:
    """Standard uncertainties of gain and offsets, [3]; larger where the responses disagree more than they should."""
    columns = np.array([True, *free])
    scaled = _modelled(table, optics, gain, offset_m)[1][:, columns] / table.sigma[:, None]
    sigma = np.full(3, np.inf)
    information = scaled.T @ scaled
    if np.linalg.cond(information / np.sqrt(np.outer(information.diagonal(), information.diagonal()))) > 1e8:
        return sigma
    spare = len(table.value) - int(columns.sum())
    worse = _badness(table, optics, gain, offset_m) / spare if spare > 0 else 1.0
    sigma[columns] = np.sqrt(np.linalg.inv(information).diagonal() * (worse if worse > DISAGREE else 1.0))
    return sigma
