"""Verification of the chunks' bytes before emission, against the plan and the caps."""

from dataclasses import dataclass

import numpy as np

from optodrive.core.errors import LocalProtocolError
from optodrive.core.types.arrays import IntArray
from optodrive.core.types.plans import BudgetState, LimitedPlan
from optodrive.link.dac.encoding import PointPulses, PointScale, decode, encode
from optodrive.link.dac.formats.base import Chunk
from optodrive.planning.limiter.budget import Budget
from optodrive.planning.limiter.limiter import verify

TIME_TOLERANCE_S = 1e-9
POWER_TOLERANCE = 1e-9


@dataclass(frozen=True, eq=False)
class VerifiedChunks:
    """Chunks that may be played, built by encode_verified().

    pulses: [n] decoded pulses
    row: [n] plan row of each
    """

    chunks: tuple[Chunk, ...]
    pulses: PointPulses
    row: IntArray

    @property
    def duration_s(self) -> float:
        """Playing time without gaps, s."""
        return sum(chunk.duration_s for chunk in self.chunks)

    @property
    def energy_j(self) -> float:
        """Largest incident optical energy, J."""
        return float(self.pulses.power_w @ self.pulses.width_s)


def encode_verified(plan: LimitedPlan, scale: PointScale, state: BudgetState, budget: Budget) -> VerifiedChunks:
    """Encode a plan that was limited from `state` and verify its bytes. Raise LocalProtocolError if they fail."""
    chunks = encode(plan, scale)
    pulses, row = verify_chunks([chunk.data for chunk in chunks], plan, scale, state, budget)
    return VerifiedChunks(chunks, pulses, row)


def verify_chunks(
    chunks: list[bytes], plan: LimitedPlan, scale: PointScale, state: BudgetState, budget: Budget
) -> tuple[PointPulses, IntArray]:
    """Return the pulses of chunks and the plan row [n] of each.

    Raise LocalProtocolError if an emission is earlier, later, stronger or elsewhere than planned, if a chunk is unsafe,
    or if the pulses exceed a cap.
    """
    for data in chunks:
        scale.format.check(data)
    pulses = decode(chunks, scale)
    row = np.searchsorted(plan.start_s, pulses.start_s + TIME_TOLERANCE_S, side="right") - 1
    end_s, plan_end_s = pulses.start_s + pulses.width_s, plan.start_s + plan.width_s
    tolerance_rad = (0.5 + 1e-6) * scale.rad_per_code
    violating = (
        (row < 0) | (np.abs(pulses.x_rad - plan.x_rad[row]) > tolerance_rad) if len(plan) else np.ones(len(row), bool)
    )
    if len(plan):
        violating |= np.abs(pulses.y_rad - plan.y_rad[row]) > tolerance_rad
        violating |= end_s > plan_end_s[row] + TIME_TOLERANCE_S
        violating |= pulses.power_w > plan.power_w[row] * (1 + POWER_TOLERANCE)
    if violating.any():
        first = int(np.flatnonzero(violating)[0])
        raise LocalProtocolError(f"encoded emission at {pulses.start_s[first]:.6f} s exceeds the plan's pulses")
    verify(plan, np.unique(row), _merge_parts(pulses, row), state, budget)
    return pulses, row


def _merge_parts(pulses: PointPulses, row: IntArray) -> PointPulses:
    """Return one pulse for each row of the plan, from the begin of its first part to the end of its last one.

    It has more energy than its parts, and lies within the planned pulse. The bound on the mirrors' load counts the
    largest possible move at each end of a pulse; at the end of a chunk within one, they stay.
    """
    first = np.unique(row, return_index=True)[1]
    last = np.append(first[1:], len(row))[: len(first)] - 1
    return PointPulses(
        start_s=pulses.start_s[first],
        width_s=pulses.start_s[last] + pulses.width_s[last] - pulses.start_s[first],
        x_rad=pulses.x_rad[first],
        y_rad=pulses.y_rad[first],
        power_w=np.maximum.reduceat(pulses.power_w, first) if len(first) else pulses.power_w,
    )
