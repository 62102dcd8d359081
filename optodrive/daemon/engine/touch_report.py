"""Rate and height of the dots under each fingertip, from the pulses that the board has executed."""

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from optodrive.core.finger_tracks import PredictedFinger
from optodrive.core.types.arrays import BoolArray, FloatArray, IntArray
from optodrive.daemon.responses.telemetry import TouchedFinger
from optodrive.device.config import PixelLayout

WINDOW_S = 0.2
"""Time over which pulses are counted. A finger that reads is on a dot for 0.1 to 0.5 s."""
REPORT_LAG_MAX_S = 0.2
"""Pulses end the window, as far as they are reported, unless the newest is older than this."""


class _Pulses(NamedTuple):
    """Executed pulses [n].

    start_s: board time; height_m: to which they raise their pixel
    """

    pixel: IntArray
    start_s: FloatArray
    height_m: FloatArray


class TouchReport:
    """Executed pulses of the last moments."""

    def __init__(self, layout: PixelLayout) -> None:
        self._layout = layout
        self._batches: deque[_Pulses] = deque()
        self._newest_s = -np.inf

    def add(self, pixel: IntArray, start_s: FloatArray, height_m: FloatArray) -> None:
        """Add executed pulses [n], in order of time."""
        self._batches.append(_Pulses(pixel, start_s, height_m))
        self._newest_s = float(start_s[-1])
        while self._batches[0].start_s[-1] < self._newest_s - WINDOW_S:
            self._batches.popleft()

    def clear(self) -> None:
        """Forget all pulses, when the board's clock has restarted."""
        self._batches.clear()
        self._newest_s = -np.inf

    def build(self, board_s: float, fingers: Sequence[PredictedFinger], page_m: FloatArray) -> list[TouchedFinger]:
        """Return rate and height of the dots under each finger.

        page_m: [p] heights of the standing page, 0 without one
        """
        end_s = self._newest_s if board_s - self._newest_s < REPORT_LAG_MAX_S else board_s
        count, height_m = np.zeros(len(page_m)), np.zeros(len(page_m))
        for batch in self._batches:
            recent = batch.start_s > end_s - WINDOW_S
            np.add.at(count, batch.pixel[recent], 1.0)
            height_m[batch.pixel[recent]] = batch.height_m[recent]
        reached = np.minimum(1.0, height_m / np.where(page_m > 0.0, page_m, np.inf))
        return [self._describe(finger, page_m > 0.0, count / WINDOW_S, reached) for finger in fingers]

    def _describe(
        self, finger: PredictedFinger, is_dot: BoolArray, rate_hz: FloatArray, reached: FloatArray
    ) -> TouchedFinger:
        distance_m = np.hypot(self._layout.x_m - finger.x_m, self._layout.y_m - finger.y_m)
        dots = np.flatnonzero(is_dot & (distance_m <= finger.radius_m))
        return TouchedFinger(
            number=finger.number,
            x_m=round(finger.x_m, 6),
            y_m=round(finger.y_m, 6),
            radius_m=round(finger.radius_m, 6),
            dots=len(dots),
            rate_hz=round(float(rate_hz[dots].mean()), 2) if len(dots) else None,
            height_share=round(float(reached[dots].mean()), 4) if len(dots) else None,
        )
