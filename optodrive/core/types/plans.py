"""Pulse plans, the limiter's state between plans, and pulses that the board reports as executed."""

from dataclasses import dataclass, fields

import numpy as np

from optodrive.core.types.arrays import FloatArray, IntArray, ReadOnlyArrays, StrArray


@dataclass(frozen=True, eq=False)
class PulsePlan(ReadOnlyArrays):
    """Timed pulses of all beams before the limiter, one row per pulse, in order of their starts, all arrays [n].

    start_s: gate-on time from the plan's start, whole microseconds; width_s: gate-on duration, whole PWM periods
    x_rad, y_rad: mechanical mirror angles (the beam turns by twice the angle)
    power_w: mean incident power while the gate is on; pixel: index
    settling_s: gate-off time before the pulse for the mirrors' move
    target_m: peak displacement that the pulse is planned to reach; NaN for pulses of a `PulseTrain` and for all
    interleaved sub-pulses of a frame but the last
    requested_start_s: time at which the request wants the pulse (frame: start of the frame; train: gate on)
    source: index of the frame, or number of frames + index of the train
    stage: index of the optical stage whose beam it is; pulses of one stage do not overlap
    """

    start_s: FloatArray
    width_s: FloatArray
    x_rad: FloatArray
    y_rad: FloatArray
    power_w: FloatArray
    pixel: IntArray
    settling_s: FloatArray
    target_m: FloatArray
    requested_start_s: FloatArray
    source: IntArray
    stage: IntArray

    def __len__(self) -> int:
        return len(self.start_s)

    @property
    def end_s(self) -> float:
        """End of the last pulse of all stages, s, or 0 without pulses."""
        return float((self.start_s + self.width_s).max(initial=0.0))


_NO_FLOATS: FloatArray = np.zeros(0)

_NO_INTS: IntArray = np.zeros(0, dtype=np.int64)

EMPTY_PLAN = PulsePlan(
    start_s=_NO_FLOATS,
    width_s=_NO_FLOATS,
    x_rad=_NO_FLOATS,
    y_rad=_NO_FLOATS,
    power_w=_NO_FLOATS,
    pixel=_NO_INTS,
    settling_s=_NO_FLOATS,
    target_m=_NO_FLOATS,
    requested_start_s=_NO_FLOATS,
    source=_NO_INTS,
    stage=_NO_INTS,
)
"""A plan without pulses."""


@dataclass(frozen=True, eq=False)
class LimitedPlan(PulsePlan):
    """A plan that the limiter has passed. Only `optodrive.planning.limiter` creates one.

    energy_j: [n] incident energy of the pulse as passed; trimmed_j: [n] energy that the limiter removed
    reason: [n] key of the binding cap, '' if no energy was removed
    headroom_k: [p] smallest distance of each pixel's absorber bound from its cap during the plan
    """

    energy_j: FloatArray
    trimmed_j: FloatArray
    reason: StrArray
    headroom_k: FloatArray


@dataclass(frozen=True, eq=False)
class BudgetState(ReadOnlyArrays):
    """State of the limiter between plans. Passed pulses count as executed until the board reports otherwise.

    at_s: end of the last pulse of any stage, on the budget's time line; begun_s: start of the last one
    last_pulse_end_s: [p] end of each pixel's last pulse; the following [p] arrays hold at that time
    rise_k, lower_bound_k: [p] upper and lower bound of the absorber's rise over its wall
    bucket_j: [p] leaky bucket of energy; merged_width_s: [p] total width of the last pulses without a gap
    wall_k, touch_k: [p, 2] bounds on wall and touch surface at nodes_at_s [p]
    inflow_w: [p] upper bound on the heat flow from neighbouring walls since exchanged_at_s
    panel_k: [2] bounds on the panel at panel_at_s; those of walls and touch surfaces are rises over it
    beam_end_s: [k] end of each stage's last pulse
    mirror_rad: [k, 2] mirror angles; galvo_mean_square, galvo_ringing: [k, 2] bounds on the mirrors' mean-square
    acceleration, rad²/s⁴, and on the root of the remaining integral of a², rad/s^1.5, at mirror_at_s [k], the arrival
    time of their targets
    recent_*: [r] start_s, width_s, power_w, pixel and stage of pulses that a sliding window may still contain
    """

    at_s: float
    begun_s: float
    last_pulse_end_s: FloatArray
    rise_k: FloatArray
    lower_bound_k: FloatArray
    bucket_j: FloatArray
    merged_width_s: FloatArray
    wall_k: FloatArray
    touch_k: FloatArray
    nodes_at_s: FloatArray
    inflow_w: FloatArray
    exchanged_at_s: float
    panel_k: FloatArray
    panel_at_s: float
    beam_end_s: FloatArray
    mirror_rad: FloatArray
    galvo_mean_square: FloatArray
    galvo_ringing: FloatArray
    mirror_at_s: FloatArray
    recent_start_s: FloatArray
    recent_width_s: FloatArray
    recent_power_w: FloatArray
    recent_pixel: IntArray
    recent_stage: IntArray


@dataclass(frozen=True, eq=False)
class ExecutedPulses(ReadOnlyArrays):
    """Pulses that the board reports as executed, one row per pulse in order, all arrays [n].

    on_tick: tick of gate on, of the board, or of the host if there are several stages; width_ticks: gate-on duration;
    of a pulse that was trimmed to nothing, the tick at which it would have begun, and 0
    pixel, stage: of the plan's row; start_s: on_tick counted from the tick of the plan's start, s
    complete: whether no report is missing
    """

    on_tick: IntArray
    width_ticks: IntArray
    pixel: IntArray
    power_w: FloatArray
    start_s: FloatArray
    width_s: FloatArray
    stage: IntArray
    complete: bool

    def __len__(self) -> int:
        return len(self.on_tick)


def concatenate_executed(first: ExecutedPulses, second: ExecutedPulses) -> ExecutedPulses:
    """Concatenate the pulses of two parts of a plan. They are complete if those of both are."""
    columns = {item.name: getattr(first, item.name) for item in fields(ExecutedPulses) if item.name != "complete"}
    joined = {name: np.concatenate([column, getattr(second, name)]) for name, column in columns.items()}
    return ExecutedPulses(**joined, complete=first.complete and second.complete)
