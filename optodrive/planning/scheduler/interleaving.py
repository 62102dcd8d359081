"""A frame whose pixels shall stand up at one time: in how many rounds the beam goes through it.

An absorber passes its heat on for 10 to 30 ms, so a pulse may come in slices. Every round costs a move a pixel; which
number of rounds is best is reckoned, with the moves and the heat there are.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.plans import PulsePlan
from optodrive.physics.thermal_state import Heat

ROUNDS = (1, 2, 3, 4, 6, 8)
SAMPLES = 400
AFTER_TAU_G = 5.0
"""So many gas lags after the last pulse every pixel is past its peak."""

Periods = Mapping[int, int]
"""PWM periods by pixel."""


@dataclass(frozen=True)
class Together:
    """How a frame was split. simultaneity: as `simultaneity`, reckoned before the limiter; unsplit: in one round.

    extra_s: how much later than in one round the frame ends
    """

    source: int
    rounds: int
    simultaneity: float
    simultaneity_unsplit: float
    extra_s: float


@dataclass(frozen=True)
class Rehearsal:
    """What a number of rounds would come to. rested: whether a pixel's slices are far enough apart to count as such."""

    rounds: int
    simultaneity: float
    end_s: float
    rested: bool


def slices(single: Mapping[int, tuple[int, float]], rounds: int) -> Periods | None:
    """Width of each pixel's pulse at full power in every round but the last; None where one is too short to share.

    single: periods and duty, by pixel, of the one pulse that would do.
    """
    share = {pixel: int(periods * duty / rounds) for pixel, (periods, duty) in single.items()}
    return share if rounds == 1 or all(share.values()) else None


WORTH = 0.01
"""More rounds take longer: they must bring up so much more of every target at one time."""


def best(rehearsals: list[Rehearsal], due_s: float) -> Rehearsal:
    """Of those that end in time the one of fewest rounds within WORTH of the most simultaneous; else the first."""
    able = [item for item in rehearsals if item.end_s <= due_s + 1e-9 and item.rested]
    most = max((item.simultaneity for item in able), default=0.0)
    return next((item for item in able if item.simultaneity >= most - WORTH), rehearsals[0])


def simultaneity(
    heat: Heat, plan: PulsePlan, target_m: Mapping[int, float], last_round_s: float, tick: Callable[[], None]
) -> float:
    """The most, over time, of the least share of its target, over pixels, that the membranes stand at.

    heat: as it is before the plan; last_round_s: when the last round begins, before which no pixel is up.
    """
    pulses = np.column_stack([plan.start_s, plan.width_s, plan.power_w, plan.pixel])
    end_s = float(plan.start_s[-1] + plan.width_s[-1])
    after_s = AFTER_TAU_G * float(heat.pixels.tau_g_s.max())
    t_s = np.union1d(
        np.linspace(last_round_s, end_s, SAMPLES), np.linspace(float(plan.start_s[-1]), end_s + after_s, SAMPLES)
    )
    least: FloatArray = np.full(len(t_s), np.inf)
    for pixel, asked_m in target_m.items():
        least = np.minimum(least, heat.heights_m(pulses, pixel, t_s) / asked_m)
        tick()
    return float(least.max())


def joined(pieces: list[PulsePlan]) -> PulsePlan:
    """One plan of pieces, in order."""
    return PulsePlan(
        **{item.name: np.concatenate([getattr(piece, item.name) for piece in pieces]) for item in fields(PulsePlan)}
    )


def rested(plan: PulsePlan, rest_s: float) -> bool:
    """Whether every pulse comes rest_s or more after the last one on its pixel."""
    order = np.lexsort((plan.start_s, plan.pixel))
    start_s, end_s, pixel = plan.start_s[order], (plan.start_s + plan.width_s)[order], plan.pixel[order]
    again = pixel[1:] == pixel[:-1]
    return bool(np.all((start_s[1:] - end_s[:-1])[again] >= rest_s - 1e-9))
