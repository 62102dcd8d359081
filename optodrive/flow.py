"""The types that flow through the driver, one way.

    FrameSequence → PulsePlan → LimitedPlan → wire bytes → ExecutedPulses → PixelTrace → Measurement

Stages share these and nothing else. Arrays are read-only; n pulses, p pixels, m times; SI units, in the names.
"""

from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
StrArray = NDArray[np.str_]


def freeze_arrays(instance: object) -> None:
    """Make every array field of a dataclass instance read-only."""
    for item in fields(instance):  # type: ignore[arg-type]
        value: Any = getattr(instance, item.name)
        if isinstance(value, np.ndarray):
            value.setflags(write=False)


@dataclass(frozen=True, eq=False)
class TactileFrame:
    """One tactile picture: the peak displacement asked of each pixel while the frame is shown.

    target_m: [p], peak displacement asked for, m; 0 where the pixel is not driven.
    together: the pixels shall stand up at one time rather than one after the other
    priority: the larger, the later it is left out where not everything fits.
    """

    frame_id: str
    show_at_s: float
    duration_s: float
    target_m: FloatArray
    together: bool = False
    priority: int = 0

    def __post_init__(self) -> None:
        freeze_arrays(self)


@dataclass(frozen=True)
class PulseTrain:
    """Cyclic stimulation of one pixel: pulses of `pulse_width_s` with `gap_s` between, for `duration_s`.

    power_w: incident power while on, W. The train holds every pulse that starts before its end; the last may end later.
    priority: as a frame's.
    """

    pixel: int
    start_s: float
    duration_s: float
    pulse_width_s: float
    gap_s: float
    power_w: float
    priority: int = 0

    def pulse_starts_s(self) -> FloatArray:
        """Nominal start of each pulse, s: [n]."""
        return _cycle_starts_s(self.start_s, self.duration_s, self.pulse_width_s + self.gap_s)


@dataclass(frozen=True)
class HeightTrain:
    """Cyclic stimulation of one pixel by what is felt: a peak of target_m every period_s, for `duration_s`.

    peak_to_peak_m: fall of the membrane between two peaks, m; None for as little energy as possible. Cycles as for a
    `PulseTrain`; each pulse is planned from the heat that is there. priority: as a frame's.
    """

    pixel: int
    start_s: float
    duration_s: float
    period_s: float
    target_m: float
    peak_to_peak_m: float | None = None
    priority: int = 0

    def pulse_starts_s(self) -> FloatArray:
        """Nominal start of each pulse, s: [n]."""
        return _cycle_starts_s(self.start_s, self.duration_s, self.period_s)


Train = PulseTrain | HeightTrain


def _cycle_starts_s(start_s: float, duration_s: float, period_s: float) -> FloatArray:
    count = max(1, int(np.ceil(duration_s / period_s - 1e-9)))
    return np.asarray(start_s + period_s * np.arange(count), dtype=np.float64)


@dataclass(frozen=True)
class FrameSequence:
    """What a caller asks to be felt: frames by height, trains by pulse or by height; times from the plan's start."""

    frames: tuple[TactileFrame, ...] = ()
    trains: tuple[Train, ...] = ()


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
    settle_s: FloatArray
    target_m: FloatArray
    nominal_s: FloatArray
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
    settle_s=_NO_FLOATS,
    target_m=_NO_FLOATS,
    nominal_s=_NO_FLOATS,
    source=_NO_INTS,
)
"""A plan without pulses."""


@dataclass(frozen=True, eq=False)
class LimitedPlan(PulsePlan):
    """A plan as the limiter passed it; only `optodrive.limit` makes one.

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
    dark_since_s: FloatArray
    rise_k: FloatArray
    least_k: FloatArray
    spot_j: FloatArray
    on_s: FloatArray
    wall_k: FloatArray
    touch_k: FloatArray
    nodes_at_s: FloatArray
    inflow_w: FloatArray
    exchanged_at_s: float
    mirror_rad: FloatArray
    acceleration2: FloatArray
    swing: FloatArray
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


@dataclass(frozen=True, eq=False)
class PixelTrace:
    """What pixels do in time. t_s [m]; absorber_k, gas_k (rises above ambient), displacement_m, force_n: [m, p]."""

    t_s: FloatArray
    pixel: IntArray
    absorber_k: FloatArray
    gas_k: FloatArray
    displacement_m: FloatArray
    force_n: FloatArray

    def __post_init__(self) -> None:
        freeze_arrays(self)


@dataclass(frozen=True, eq=False)
class Signal:
    """One measured signal of one pixel: t_s [m] increasing; value [m], NaN where missing; sigma: stated noise."""

    pixel: int
    t_s: FloatArray
    value: FloatArray
    sigma: float | None = None

    def __post_init__(self) -> None:
        freeze_arrays(self)


@dataclass(frozen=True, eq=False)
class Run:
    """One run of a recording: the drive as commanded, and the signals measured meanwhile.

    pulses: [n, 4] start_s, width_s, power_w, pixel; signals: by the format's names; attributes: as in the file
    """

    name: str
    ambient_k: float
    pulses: FloatArray
    signals: dict[str, Signal]
    attributes: dict[str, str | float] = field(default_factory=dict)
    commands: FloatArray | None = None

    def __post_init__(self) -> None:
        freeze_arrays(self)


@dataclass(frozen=True)
class Measurement:
    """A recording: runs in order."""

    runs: tuple[Run, ...]


@dataclass(frozen=True)
class Estimate:
    """A fitted number: value, unit, its 95 % interval."""

    value: float
    unit: str
    low: float
    high: float


@dataclass(frozen=True)
class Gain:
    """RMSE on runs that were held out, by signal, SI; reduction: (before − after) / (before − floor), 95 % interval."""

    before: dict[str, float]
    after: dict[str, float]
    floor: dict[str, float]
    reduction: float
    low: float
    high: float


@dataclass(frozen=True)
class CandidateCause:
    """One cause as judged. statistic: likelihood ratio beside the nominal fit; smallest: what would have been seen."""

    cause: str
    label: str
    statistic: float
    p_value: float
    heldout_gain: float | None
    verdict: str
    smallest: str


@dataclass(frozen=True, eq=False)
class NextExperiment:
    """The experiment that tells rivals apart.

    pulses: [n, 4]; pixel: the one to look at; repeats: how often; separation: χ² between rivals; seconds: of lab time
    """

    why: str
    pulses: FloatArray
    pixel: int
    repeats: int
    signals: tuple[str, ...]
    separation: float
    seconds: float


@dataclass(frozen=True, eq=False)
class Course:
    """One signal of one group: measured, and residuals before and after in units of sigma, one sample's noise; [m]."""

    group: str
    signal: str
    sigma: float
    t_s: FloatArray
    measured: FloatArray
    before: FloatArray
    after: FloatArray


@dataclass(frozen=True, eq=False)
class Discrepancy:
    """What a recording says of the model: verdict "cause", "none", "unexplained" or "ambiguous", and all behind it.

    terms: the extension, term → parameter → value; base: nominal parameters as refitted with it
    """

    verdict: str
    causes: tuple[str, ...]
    labels: tuple[str, ...]
    parameters: dict[str, Estimate]
    base: dict[str, float]
    terms: dict[str, dict[str, float]]
    gain: Gain | None
    candidates: tuple[CandidateCause, ...]
    next_experiment: NextExperiment | None
    fitted: tuple[str, ...]
    held_out: tuple[str, ...]
    courses: tuple[Course, ...]
    remarks: tuple[str, ...]
    explained: float
    seconds: float
