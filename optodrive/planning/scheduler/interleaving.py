"""A frame whose pixels shall stand up at one time: in how many rounds the beam goes through it.

An absorber passes its heat on for 10 to 30 ms, so a pulse may come in slices. Every round costs a move a pixel; which
number of rounds is best is reckoned, with the moves and the heat there are.
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
"""So many gas lags after the last pulse every pixel is past its peak."""

PeriodsByPixel = Mapping[int, int]
"""PWM periods by pixel."""


@dataclass(frozen=True)
class SimultaneousFrame:
    """How a frame was split. simultaneity: as `simultaneity`, reckoned before the limiter; unsplit: in one round.

    extra_s: how much later than in one round the frame ends
    """

    source: int
    interleaved_rounds: int
    simultaneity: float
    simultaneity_single_pulse: float
    extra_s: float


@dataclass(frozen=True)
class CandidateSchedule:
    """What a number of rounds would come to. rested: whether a pixel's slices are far enough apart to count as such."""

    rounds: int
    simultaneity: float
    end_s: float
    has_min_gaps: bool


def split_pulses(single_pulses: Mapping[int, tuple[int, float]], rounds: int) -> PeriodsByPixel | None:
    """Width of each pixel's pulse at full power in every round but the last; None where one is too short to share.

    single: periods and duty, by pixel, of the one pulse that would do.
    """
    periods_by_pixel = {pixel: int(periods * duty / rounds) for pixel, (periods, duty) in single_pulses.items()}
    return periods_by_pixel if rounds == 1 or all(periods_by_pixel.values()) else None


MIN_SIMULTANEITY_GAIN = 0.01
"""More rounds take longer: they must bring up so much more of every target at one time."""


def select_schedule(candidates: list[CandidateSchedule], deadline_s: float) -> CandidateSchedule:
    """Of those that end in time the one of fewest rounds within WORTH of the most simultaneous; else the first."""
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
    """The most, over time, of the least share of its target, over pixels, that the membranes stand at.

    heat: as it is before the plan; last_round_s: when the last round begins, before which no pixel is up.
    """
    pulses = np.column_stack([plan.start_s, plan.width_s, plan.power_w, plan.pixel])
    end_s = float(plan.start_s[-1] + plan.width_s[-1])
    after_s = PEAK_WINDOW_TAU_G * float(heat.pixels.tau_g_s.max())
    t_s = np.union1d(
        np.linspace(last_round_start_s, end_s, SAMPLES), np.linspace(float(plan.start_s[-1]), end_s + after_s, SAMPLES)
    )
    min_ratio: FloatArray = np.full(len(t_s), np.inf)
    for pixel, pixel_target_m in target_m.items():
        min_ratio = np.minimum(min_ratio, heat.simulate_displacement_m(pulses, pixel, t_s) / pixel_target_m)
        on_progress()
    return float(min_ratio.max())


def concatenate_batches(batches: list[PulsePlan]) -> PulsePlan:
    """One plan of pieces, in order."""
    return PulsePlan(
        **{item.name: np.concatenate([getattr(piece, item.name) for piece in batches]) for item in fields(PulsePlan)}
    )


def has_min_gaps(plan: PulsePlan, rest_s: float) -> bool:
    """Whether every pulse comes rest_s or more after the last one on its pixel."""
    order = np.lexsort((plan.start_s, plan.pixel))
    start_s, end_s, pixel = plan.start_s[order], (plan.start_s + plan.width_s)[order], plan.pixel[order]
    is_repeated = pixel[1:] == pixel[:-1]
    return bool(np.all((start_s[1:] - end_s[:-1])[is_repeated] >= rest_s - 1e-9))
