"""Interleaved rounds of a simultaneous frame: each pulse is split into sub-pulses, one per round of the beam.

An absorber releases its heat over 10 to 30 ms, so a pulse can be split. Every round costs one move per pixel. The
number of rounds is chosen by planning each candidate with its settling times and the residual heat.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.plans import PulsePlan
from optodrive.physics.thermal_state import ThermalState

ROUND_COUNTS = (1, 2, 3, 4, 6, 8)
SAMPLES = 400
PEAK_WINDOW_TAU_G = 5.0
"""Number of gas lags after the last pulse by which every pixel is past its peak."""

PeriodsByPixel = Mapping[int, int]
"""Width in PWM periods, by pixel."""


@dataclass(frozen=True)
class SimultaneousFrame:
    """How a frame was interleaved.

    simultaneity, simultaneity_single_pulse: `compute_simultaneity` of the selected number of rounds and of one round,
    before the limiter; extra_s: additional duration against one round
    """

    source: int
    interleaved_rounds: int
    simultaneity: float
    simultaneity_single_pulse: float
    extra_s: float


@dataclass(frozen=True)
class CandidateSchedule:
    """Result of one number of rounds.

    has_min_gaps: whether all sub-pulses of a pixel count separately
    """

    rounds: int
    simultaneity: float
    end_s: float
    has_min_gaps: bool


def split_pulses(single_pulses: Mapping[int, tuple[float, float]], rounds: int) -> PeriodsByPixel | None:
    """Compute each pixel's sub-pulse width at full power. Return None if a pulse is too short to be split.

    single_pulses: by pixel, width in PWM periods and duty of the single pulse that reaches the target
    """
    # Rounded down: the last round brings the rest, and must not find the pixel above its target.
    periods_by_pixel = {pixel: int(periods * duty / rounds) for pixel, (periods, duty) in single_pulses.items()}
    return periods_by_pixel if rounds == 1 or all(periods_by_pixel.values()) else None


MIN_SIMULTANEITY_GAIN = 0.01
"""Gain in simultaneity by which more rounds justify their longer duration."""


def select_schedule(candidates: list[CandidateSchedule], deadline_s: float) -> CandidateSchedule:
    """Select the candidate with the fewest rounds close to the best simultaneity among those that meet the deadline.

    Returns the first candidate if none meets the deadline.
    """
    # Without gaps, sub-pulses count as one pulse in the width cap, of limiter and board.
    feasible = [item for item in candidates if item.end_s <= deadline_s + 1e-9 and item.has_min_gaps]
    max_simultaneity = max((item.simultaneity for item in feasible), default=0.0)
    return next(
        (item for item in feasible if item.simultaneity >= max_simultaneity - MIN_SIMULTANEITY_GAIN), candidates[0]
    )


def compute_simultaneity(
    heat: ThermalState,
    plan: PulsePlan,
    target_m: Mapping[int, float],
    last_round_start_s: float,
    on_progress: Callable[[], None],
) -> float:
    """Return the maximum over time of the minimum over pixels of displacement / target.

    heat: before the plan; last_round_start_s: start of the last round, before which no pixel reaches its target
    """
    pulses = np.column_stack([plan.start_s, plan.width_s, plan.power_w, plan.pixel])
    end_s = plan.end_s
    after_s = PEAK_WINDOW_TAU_G * float(heat.pixels.tau_g_s.max())
    # Two densities: peaks lie behind the last pulse, and the rounds before it may take longer than all of that.
    t_s = np.union1d(
        np.linspace(last_round_start_s, end_s, SAMPLES), np.linspace(float(plan.start_s[-1]), end_s + after_s, SAMPLES)
    )
    min_ratio: FloatArray = np.full(len(t_s), np.inf)
    for pixel, pixel_target_m in target_m.items():
        min_ratio = np.minimum(min_ratio, heat.simulate_displacement_m(pulses, pixel, t_s) / pixel_target_m)
        on_progress()
    return float(min_ratio.max())


def concatenate_batches(batches: list[PulsePlan]) -> PulsePlan:
    """Concatenate batches in order."""
    return PulsePlan(
        **{item.name: np.concatenate([getattr(batch, item.name) for batch in batches]) for item in fields(PulsePlan)}
    )


def has_min_gaps(plan: PulsePlan, min_gap_s: float) -> bool:
    """Return whether every pulse starts at least `min_gap_s` after the previous one on its pixel."""
    order = np.lexsort((plan.start_s, plan.pixel))
    start_s, end_s, pixel = plan.start_s[order], (plan.start_s + plan.width_s)[order], plan.pixel[order]
    is_repeated = pixel[1:] == pixel[:-1]
    return bool(np.all((start_s[1:] - end_s[:-1])[is_repeated] >= min_gap_s - 1e-9))
