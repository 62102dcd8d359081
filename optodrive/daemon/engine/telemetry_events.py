"""Events of telemetry, made of the display, pulses, caps and dots under fingertips.

The planner's thermal state is ahead of emission; `DisplaySnapshot` follows it, in board time. It is not thread-safe.
"""

from base64 import b64encode
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from math import isfinite
from typing import NamedTuple, Self

import numpy as np

from optodrive.core.finger_tracks import PredictedFinger
from optodrive.core.types.arrays import BoolArray, FloatArray, IntArray
from optodrive.daemon.engine.active_plan import ActivePlan
from optodrive.daemon.engine.metrics import PlanProgress
from optodrive.daemon.responses.telemetry import CapUsage, DisplayEvent, PageEvent, PulseBatch, TouchedFinger
from optodrive.device.config import PixelLayout
from optodrive.device.config_sections import LimitsSection
from optodrive.link.protocol.quantisation import WireScale
from optodrive.physics.nominal_display import DisplayState
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.limiter.cap_checks import Usage, compute_panel_k, compute_usage
from optodrive.planning.limiter.caps import CAPS_BY_KEY
from optodrive.planning.limiter.limiter import commit_executed, shift_state


class EmittedPulses(NamedTuple):
    """Pulses that boards report as executed, [n], as input for the heat and the limiter. start_s: board time."""

    pixel: IntArray
    start_s: FloatArray
    width_s: FloatArray
    power_w: FloatArray
    x_rad: FloatArray
    y_rad: FloatArray
    stage: IntArray

    @classmethod
    def join(cls, parts: Sequence[Self]) -> Self:
        """Return the pulses of several parts, one after another."""
        return cls(*map(np.concatenate, zip(*parts, strict=True)))


def join_in_order(batches: Iterable[EmittedPulses]) -> Iterator[EmittedPulses]:
    """Join consecutive batches, none empty, as far as each begins after the last pulse of the one before."""
    parts: list[EmittedPulses] = []
    for batch in batches:
        if parts and batch.start_s[0] < parts[-1].start_s[-1]:
            yield EmittedPulses.join(parts)
            parts = []
        parts.append(batch)
    if parts:
        yield EmittedPulses.join(parts)


class ExecutedBatch(NamedTuple):
    """Executed pulses of a plan, [n], and their rows in the plan."""

    plan: ActivePlan
    row: IntArray
    pulses: EmittedPulses

    @classmethod
    def from_progress(cls, progress: PlanProgress, scales: Sequence[WireScale]) -> "ExecutedBatch":
        """Build the batch from the boards' reports. scales: of each stage."""
        active, job = progress.run
        plan, reported = active.planned.plan, job.read_reported(progress.begin, progress.end, scales)
        row, tick_s = reported.row, scales[0].tick_s
        on_tick = job.find_begin_tick(reported, plan, tick_s, active.zero_s)
        pulses = EmittedPulses(
            pixel=plan.pixel[row],
            start_s=np.asarray(on_tick * tick_s, dtype=np.float64),
            width_s=np.asarray(reported.on_ticks * tick_s, dtype=np.float64),
            power_w=reported.power_w,
            x_rad=plan.x_rad[row],
            y_rad=plan.y_rad[row],
            stage=reported.stage,
        )
        return cls(active, row, pulses)


class LiveThermalState:
    """Heat and budget after the executed pulses. The initial state is cold, because the daemon knows no earlier one.

    out_of_order: number of pulses omitted from the heat because they precede another pulse on their pixel
    """

    def __init__(self, display: DisplayModel) -> None:
        self._display = display
        self._heat, self._budget = display.build_cold_state()
        self._peaks = self._build_no_peaks()
        self.out_of_order = 0

    def apply(self, executed: EmittedPulses) -> FloatArray:
        """Add pulses, in order of time. Return the displacement to which each raises its pixel, [n], m."""
        displacement_m = np.zeros(len(executed.pixel))
        columns = (executed.pixel, executed.start_s, executed.width_s, executed.power_w)
        try:
            peaks = self._heat.apply_pulses(*columns)
            displacement_m = peaks.displacement_m
            for held, values in zip(self._peaks, peaks, strict=True):
                np.maximum.at(held, executed.pixel, values)
        except ValueError:
            self.out_of_order += len(executed.pixel)
        self._budget = commit_executed(executed.pixel, executed.stage, executed, self._budget, self._display.budget)
        return displacement_m

    def shift_clock(self, delay_s: float) -> None:
        """Shift all past pulses by delay_s after a restart of the board's clock."""
        self._heat, self._budget = self._heat.copy_shifted(delay_s), shift_state(self._budget, delay_s)

    def state_at(self, board_s: float) -> DisplayState:
        """Return the state of all pixels at a board time, s."""
        return self._heat.state_at(board_s)

    def take_peaks(self) -> DisplayState:
        """Return the peaks of the pulses applied since the last call, with 0 on pixels without any."""
        peaks, self._peaks = self._peaks, self._build_no_peaks()
        return peaks

    def _build_no_peaks(self) -> DisplayState:
        pixels = len(self._display.layout)
        return DisplayState(np.zeros(pixels), np.zeros(pixels))

    def compute_usage(self, board_s: float) -> tuple[Usage, ...]:
        """Compute the usage of every cap at a board time, s."""
        return compute_usage(self._budget, self._display.budget, board_s)

    def compute_panel_c(self, board_s: float) -> float:
        """Compute the bound on the panel's temperature at a board time, °C."""
        return self._display.config.ambient_c + compute_panel_k(self._budget, self._display.budget, board_s)


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


def build_page_event(board_s: float, page_m: FloatArray, limited_by: tuple[str, ...], touched_only: bool) -> PageEvent:
    """Encode the heights of the standing page, [p], m, which are all 0 without one, and the caps that limit it."""
    height = _encode_base64(page_m / HEIGHT_UNIT_M) if page_m.any() else ""
    return PageEvent(board_s=round(board_s, 6), height=height, limited_by=list(limited_by), touched_only=touched_only)


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
