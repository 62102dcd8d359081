"""The display as it is now: heat and budget of what the board said it executed, on the board's time line.

The planner's own heat is ahead of the light; this one follows it. One thread at a time.
"""

from typing import NamedTuple

import numpy as np

from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.daemon.engine.plan_record import PlanRecord
from optodrive.daemon.engine.progress import PlanProgress
from optodrive.link.protocol.quantisation import DUTY_MAX, WireScale
from optodrive.physics.nominal_display import DisplayState
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.limiter.limiter import commit_executed, shift_state
from optodrive.planning.limiter.usage import Usage, compute_usage


class ExecutedBatch(NamedTuple):
    """Pulses [n] of a plan as executed; row: of the plan; start_s: board time; also what the limiter may count."""

    record: PlanRecord
    row: IntArray
    pixel: IntArray
    start_s: FloatArray
    width_s: FloatArray
    power_w: FloatArray
    x_rad: FloatArray
    y_rad: FloatArray

    @classmethod
    def from_progress(cls, progress: PlanProgress, scale: WireScale) -> "ExecutedBatch":
        """What the board reported."""
        record, job = progress.run
        plan, reported = record.planned.plan, job.read_reported(progress.begin, progress.end)
        row = reported.row
        return cls(
            record=record,
            row=row,
            pixel=plan.pixel[row],
            start_s=np.asarray(reported.on_tick * scale.tick_s, dtype=np.float64),
            width_s=np.asarray(reported.on_ticks * scale.tick_s, dtype=np.float64),
            power_w=np.asarray(reported.duty / DUTY_MAX * scale.full_power_w, dtype=np.float64),
            x_rad=plan.x_rad[row],
            y_rad=plan.y_rad[row],
        )


class LiveThermalState:
    """Heat and budget as executed; from rest, because a daemon does not know what was before it.

    out_of_order: pulses that came with a time before one on their pixel already known, and were left out
    """

    def __init__(self, display: DisplayModel) -> None:
        self._display = display
        self._heat, self._budget = display.build_cold_state()
        self.out_of_order = 0

    def apply(self, executed: ExecutedBatch) -> None:
        """Count pulses, in order of time."""
        columns = (executed.pixel, executed.start_s, executed.width_s, executed.power_w)
        try:
            self._heat.apply_pulses(*columns)
        except ValueError:
            self.out_of_order += len(executed.row)
        self._budget = commit_executed(executed.pixel, executed, self._budget, self._display.budget)

    def shift_clock(self, delay_s: float) -> None:
        """Everything happened delay_s later on a clock set anew."""
        self._heat, self._budget = self._heat.copy_shifted(delay_s), shift_state(self._budget, delay_s)

    def state_at(self, board_s: float) -> DisplayState:
        """Every pixel at a time of the board's, s."""
        return self._heat.state_at(board_s)

    def compute_usage(self, board_s: float) -> tuple[Usage, ...]:
        """How near each cap is at a time of the board's, s."""
        return compute_usage(self._budget, self._display.budget, board_s)
