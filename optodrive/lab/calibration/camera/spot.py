"""The beam's spot in a picture: which blob it is, its centre to a fraction of a pixel, and how sure that is."""

from typing import Any, NamedTuple

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.types.arrays import FloatArray
from optodrive.lab.calibration.camera.image import Image, opencv

SMOOTH_PX = 1.5
SEEN = 8.0
"""A blob stands out of the smoothed noise by so many of its sigmas."""
SHARE = 0.2
"""A blob is what is brighter than this share of the brightest."""
AREA_LEAST_PX = 4
RIVAL = 0.5
"""A second blob with this share of the spot's light could be the spot."""
CORE_MOMENT = 0.5 * np.log(2.0)
"""Second moment of the disk within which a bell is brighter than half its peak, in units of the bell's own."""
ROUND_LEAST_PX = 0.8
ROUNDS = 60
STILL_PX = 1e-4
REACH = 4.0
"""The spot is looked at as far as so many widths of the window."""
PATTERN, PATTERN_NOISE = 0.5, 10.0
"""Plain paper without the beam varies less, as a share of its brightness or in noises."""
FLAT_PX = 5
"""So many pixels that are all as bright as the brightest are saturated: light at random does not do that."""
QUANTUM = 0.3
"""Rms of rounding to whole counts."""


class Seen(NamedTuple):
    """A spot: centre, px, [2]; one sigma on an axis, px; pixels that are saturated; the next brightest's share."""

    at_px: FloatArray
    sigma_px: float
    saturated: int
    rival: float


def find_spot(where: str, picture: Image, without: Image) -> Seen:
    """The one spot in a picture; `without`: the same without the beam. InputError names the picture."""
    cv2 = opencv()
    light = picture.astype(np.float32) - without.astype(np.float32)
    light -= np.median(light[::3, ::3])
    noise = max(QUANTUM, 1.4826 * float(np.median(np.abs(light[::3, ::3]))))
    # A median first: single pixels that are always bright are no spots.
    smooth = cv2.GaussianBlur(cv2.medianBlur(light, 3), (0, 0), SMOOTH_PX)
    smooth_noise = max(1.4826 * float(np.median(np.abs(smooth[::3, ::3]))), 0.2 * noise)
    brightest = float(smooth.max())
    if brightest < SEEN * smooth_noise:
        found = f"nothing brighter than {brightest:.1f} counts over the plane without the beam"
        raise InputError(where, found, f"a spot of at least {SEEN * smooth_noise:.1f}, {SEEN:g} times the noise")
    labels, lights, places = _blobs(smooth, light, max(SEEN * smooth_noise, SHARE * brightest))
    order = np.argsort(-lights)
    spot = int(order[0])
    rival = float(lights[order[1]] / lights[spot]) if len(order) > 1 else 0.0
    if rival > RIVAL:
        x, y = places[spot]
        x2, y2 = places[order[1]]
        found = f"two spots alike, at {x:.0f} {y:.0f} and {x2:.0f} {y2:.0f} px, {rival:.0%} as bright"
        raise InputError(where, found, f"one spot; a reflection has at most {RIVAL:.0%} of its light")
    window = _window(labels == spot + 1, smooth)
    _check_edge(where, places[spot], window, light.shape)
    _check_even(where, places[spot], window, without, noise)
    at_px, at_sigma_px = _centre(light, noise, places[spot], window)
    wide_px, wide_sigma_px = _centre(light, noise, at_px, 2.0 * window)
    # What a wider window moves, and noise does not explain: a shape that is not even, or light from elsewhere.
    uneven_px2 = max(0.0, float(((wide_px - at_px) ** 2).mean()) - wide_sigma_px**2)
    return Seen(at_px, float(np.sqrt(at_sigma_px**2 + uneven_px2)), _saturated(picture, labels == spot + 1), rival)


def _blobs(smooth: Any, light: Any, level: float) -> tuple[Any, FloatArray, FloatArray]:
    """Labels [rows, columns], then of each blob from label 1 its light, none where it is small, and middle [n, 2]."""
    count, labels, about, places = opencv().connectedComponentsWithStats((smooth > level).astype(np.uint8))
    lights = np.bincount(labels.ravel(), weights=light.ravel().astype(np.float64), minlength=count)[1:]
    return labels, np.where(about[1:, -1] >= AREA_LEAST_PX, lights, 0.0), places[1:]


def _window(blob: Any, smooth: Any) -> FloatArray:
    """Second moments of the light of a blob as its core says, px², [2, 2], never narrower than a pixel or so.

    The core is what is brighter than half: a reflection that touches the spot is weaker and does not widen it.
    """
    within = np.where(blob, smooth, 0.0)
    peak = np.unravel_index(int(np.argmax(within)), within.shape)
    _, labels = opencv().connectedComponents((within > 0.5 * within[peak]).astype(np.uint8))
    y, x = np.nonzero(labels == labels[peak])
    moments = np.cov(np.stack([x, y]), bias=True) / CORE_MOMENT
    size, axes = np.linalg.eigh(moments)
    window: FloatArray = (axes * np.maximum(size, ROUND_LEAST_PX**2)) @ axes.T
    return window


def _check_edge(where: str, place: FloatArray, window: FloatArray, shape: tuple[int, ...]) -> None:
    reach = 2.0 * np.sqrt(np.diag(window))
    if np.any(place < reach) or np.any(place > np.array(shape[::-1]) - 1.0 - reach):
        raise InputError(where, f"a spot at {place[0]:.0f} {place[1]:.0f} px, cut by the picture's edge", "all of it")


def _check_even(where: str, place: FloatArray, window: FloatArray, without: Image, noise: float) -> None:
    """Refuse a spot on a pattern: what is black sends no light back and draws the centre aside unseen."""
    reach = int(np.ceil(2.0 * np.sqrt(np.linalg.eigvalsh(window)[-1])))
    x, y = np.rint(place).astype(int)
    dark, bright = np.percentile(without[max(0, y - reach) : y + reach + 1, max(0, x - reach) : x + reach + 1], (5, 95))
    if bright - dark > max(PATTERN * bright, PATTERN_NOISE * noise):
        found = f"a spot at {x} {y} px on a pattern of {dark:.0f} to {bright:.0f} counts"
        raise InputError(where, found, "plain paper under it: the grid taken away")


def _centre(light: Any, noise: float, start: FloatArray, window: FloatArray) -> tuple[FloatArray, float]:
    """Centre of the light under a bell-shaped window that follows it, px, and one sigma by noise on an axis.

    A window that is even about the centre is as good with a saturated core, which is even too.
    """
    inverse = np.linalg.inv(window)
    at = np.array(start, dtype=np.float64)
    reach = int(np.ceil(REACH * np.sqrt(np.linalg.eigvalsh(window)[-1])))
    for _ in range(ROUNDS):
        low = np.maximum(np.rint(at).astype(int) - reach, 0)
        part = light[low[1] : int(np.rint(at[1])) + reach + 1, low[0] : int(np.rint(at[0])) + reach + 1]
        y, x = np.mgrid[low[1] : low[1] + part.shape[0], low[0] : low[0] + part.shape[1]]
        away = np.stack([x - at[0], y - at[1]], axis=-1)
        far = np.einsum("...a,ab,...b->...", away, inverse, away)
        weight = np.exp(-0.5 * far)
        around = far > 0.6 * REACH**2
        clean = part - (np.median(part[around]) if around.any() else 0.0)
        total = float((weight * clean).sum())
        if total <= 0.0:
            return np.array(start, dtype=np.float64), float("inf")
        # Under a window as wide as the light the first moment is half of the way to the centre.
        step = 2.0 * np.einsum("yx,yxa->a", weight * clean, away) / total
        at = at + np.clip(step, -reach, reach)
        if np.abs(step).max() < STILL_PX:
            break
    shot = noise**2 + np.maximum(clean, 0.0) * QUANTUM**2
    variance = 4.0 * np.einsum("yx,yxa->a", weight**2 * shot, away**2) / total**2
    return at, float(np.sqrt(variance.mean()))


def _saturated(picture: Image, blob: Any) -> int:
    top = int(picture[blob].max())
    count = int((picture[blob] == top).sum())
    return count if count >= FLAT_PX and (picture.dtype != np.uint8 or top >= 250) else 0
