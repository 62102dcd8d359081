"""Pulse plans, the limiter's state between plans, and pulses reported as executed."""

from dataclasses import dataclass

import numpy as np

from optodrive.core.types.arrays import FloatArray, IntArray, StrArray, freeze_arrays


@dataclass(frozen=True, eq=False)
class PulsePlan:
    """Timed pulses before the limiter: one row a pulse, in order of time, one beam. All arrays [n].

    start_s: gate on, from the plan's start, whole microseconds; width_s: whole PWM periods
    x_rad, y_rad: mechanical mirror angles (the beam turns by twice that)
    power_w: mean incident power while on; pixel: index
    settle_s: dark time kept before the pulse for the mirrors' move
    target_m: peak displacement the pulse is meant to reach, NaN for pulses of a `PulseTrain`
    and for slices of a frame's pulse before the last, which are to reach nothing by themselves
    nominal_s: when the request wanted the pulse (frame: shown by; train: gate on); source: index of frame, or of
    train counted on from the frames
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

    def __post_init__(self) -> None:
        freeze_arrays(self)

    def __len__(self) -> int:
        return len(self.start_s)


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
)

"""A plan without pulses."""


@dataclass(frozen=True, eq=False)
class LimitedPlan(PulsePlan):
    """A plan as the limiter passed it; only `optodrive.planning.limiter` makes one.

    energy_j: incident energy of the pulse as passed [n]; trimmed_j: energy taken from it [n]
    reason: why energy was taken, '' where none was [n]
    headroom_k: least distance of each pixel's absorber bound from its cap during the plan [p]
    """

    energy_j: FloatArray
    trimmed_j: FloatArray
    reason: StrArray
    headroom_k: FloatArray


@dataclass(frozen=True, eq=False)
class BudgetState:
    """What the limiter remembers between plans; pulses passed count as fired until shown otherwise.

    at_s: the time up to which the plan reached, on the budget's time line
    dark_since_s: [p] end of each pixel's last pulse; rise_k, spot_j, on_s: [p] then: bound on the absorber's rise over
    its wall, leaky bucket of energy, light without a rest; least_k: [p] that rise at least
    wall_k, touch_k: [p, 2] bounds on wall and touch surface at nodes_at_s [p]; inflow_w: [p] what neighbours send a
    wall at most, as of exchanged_at_s
    mirror_rad: [2] where the mirrors stand; acceleration2: [2] bound on their mean-square acceleration, rad²/s⁴, and
    swing: [2] on the root of the integral of a² still to come, rad/s^1.5, at mirror_at_s, when their targets arrived
    recent_*: [r] pulses still inside a sliding window: start_s, width_s, power_w, pixel
    """

    at_s: float
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
    mirror_rad: FloatArray
    galvo_mean_square: FloatArray
    galvo_ringing: FloatArray
    mirror_at_s: float
    recent_start_s: FloatArray
    recent_width_s: FloatArray
    recent_power_w: FloatArray
    recent_pixel: IntArray

    def __post_init__(self) -> None:
        freeze_arrays(self)


@dataclass(frozen=True, eq=False)
class ExecutedPulses:
    """What the board says it did, one row an executed pulse, in order; complete: none is missing. All arrays [n].

    on_tick: board tick of gate on; width_ticks: gate-on time; index: wire index of the point
    pixel, power_w: of the plan's row; start_s: on_tick from the tick at which the plan was started, s
    """

    index: IntArray
    on_tick: IntArray
    width_ticks: IntArray
    pixel: IntArray
    power_w: FloatArray
    start_s: FloatArray
    width_s: FloatArray
    complete: bool

    def __post_init__(self) -> None:
        freeze_arrays(self)

    def __len__(self) -> int:
        return len(self.index)
