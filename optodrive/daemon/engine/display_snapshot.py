"""Present state of the display from the pulses that the board has reported, in board time.

The planner's thermal state is ahead of emission; this one follows it. It is not thread-safe.
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple, Self

import numpy as np

from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.daemon.engine.active_plan import ActivePlan
from optodrive.daemon.engine.progress import PlanProgress
from optodrive.link.protocol.quantisation import WireScale
from optodrive.physics.nominal_display import DisplayState
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.limiter.cap_checks import Usage, compute_panel_k, compute_usage
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
        on_tick = job.find_begin_tick(reported, plan, tick_s)
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
