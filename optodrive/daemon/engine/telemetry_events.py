"""Conversion of the display's state, pulses, cap usage and dots under fingertips to telemetry events."""

from base64 import b64encode
from collections import deque
from collections.abc import Iterable, Sequence
from math import isfinite
from typing import NamedTuple

import numpy as np

from optodrive.core.finger_tracks import PredictedFinger
from optodrive.core.types.arrays import BoolArray, FloatArray, IntArray
from optodrive.daemon.engine.active_plan import ActivePlan
from optodrive.daemon.responses.telemetry import CapUsage, DisplayEvent, PageEvent, PulseBatch, TouchedFinger
from optodrive.device.config import PixelLayout
from optodrive.device.config_sections import LimitsSection
from optodrive.physics.nominal_display import DisplayState
from optodrive.planning.limiter.cap_checks import Usage
from optodrive.planning.limiter.caps import CAPS_BY_KEY

HEIGHT_UNIT_M = 1e-7
TEMPERATURE_UNIT_K = 0.1


def build_display_event(
    board_s: float, warm: bool, state: DisplayState, peaks: DisplayState, ambient_c: float
) -> DisplayEvent:
    """Encode every pixel at a board time, and its peaks since the last event."""
    return DisplayEvent(
        board_s=round(board_s, 6),
        warm=warm,
        height=_encode_base64(state.displacement_m / HEIGHT_UNIT_M),
        height_peak=_encode_base64(peaks.displacement_m / HEIGHT_UNIT_M),
        absorber=_encode_base64((ambient_c + state.absorber_k) / TEMPERATURE_UNIT_K),
        absorber_peak=_encode_base64((ambient_c + peaks.absorber_k) / TEMPERATURE_UNIT_K),
    )


def build_page_event(board_s: float, page_m: FloatArray, limited_by: tuple[str, ...]) -> PageEvent:
    """Encode the heights of the standing page, [p], m, which are all 0 without one, and the caps that limit it."""
    height = _encode_base64(page_m / HEIGHT_UNIT_M) if page_m.any() else ""
    return PageEvent(board_s=round(board_s, 6), height=height, limited_by=list(limited_by))


def build_pulse_batch(
    active: ActivePlan, row: IntArray, start_s: FloatArray, width_s: FloatArray, power_w: FloatArray
) -> PulseBatch:
    """Build a batch from rows [n] of a plan with their times on the board's clock and their powers."""
    plan = active.planned.plan
    return PulseBatch(
        plan=active.record.plan_id,
        name=active.record.name,
        row=row.tolist(),
        pixel=plan.pixel[row].tolist(),
        start_s=_round_values(start_s, 6),
        width_s=_round_values(width_s, 6),
        power_w=_round_values(power_w, 4),
        trimmed_j=_round_values(plan.trimmed_j[row], 6),
        reason=[str(reason) for reason in plan.reason[row]],
    )


def describe_caps(usages: Iterable[Usage], limits: LimitsSection) -> list[CapUsage]:
    """Convert finite caps to display units: temperature in °C, energy in J, power in W, acceleration in rad/s² rms."""
    caps = []
    for usage in usages:
        if not isfinite(usage.limit):
            continue
        cap = CAPS_BY_KEY[usage.cap]
        setting = getattr(limits, cap.setting)
        value, limit = (cap.scale.to_setting(each, usage.limit, setting) for each in (usage.used, usage.limit))
        caps.append(
            CapUsage(
                cap=usage.cap,
                fraction=round(usage.used / usage.limit, 4),
                value=float(f"{value:.5g}"),
                limit=float(f"{limit:.5g}"),
                unit=cap.unit,
                pixel=usage.pixel,
            )
        )
    return caps


def _encode_base64(values: FloatArray) -> str:
    return b64encode(np.clip(np.rint(values), 0, 65535).astype("<u2").tobytes()).decode()


def _round_values(values: FloatArray, digits: int) -> list[float]:
    rounded: list[float] = np.round(values, digits).tolist()
    return rounded


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
