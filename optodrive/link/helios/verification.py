"""Proof before emission: the very bytes, decoded, light nothing but the plan and pass no cap."""

from dataclasses import dataclass

import numpy as np

from optodrive.core.errors import LocalProtocolError
from optodrive.core.types.arrays import IntArray
from optodrive.core.types.plans import BudgetState, LimitedPlan
from optodrive.link.helios.encoding import PointPulses, PointScale, decode, encode
from optodrive.link.helios.frames import HeliosFrame
from optodrive.planning.limiter.budget import Budget
from optodrive.planning.limiter.limiter import verify

ROUNDING_S = 1e-9
ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class ProvenFrames:
    """Frames that may be played; only `prove` makes them. pulses [n] as decoded, row [n] of the plan's pulses."""

    frames: tuple[HeliosFrame, ...]
    pulses: PointPulses
    row: IntArray

    @property
    def duration_s(self) -> float:
        """How long they play without a hole, s."""
        return sum(frame.duration_s for frame in self.frames)

    @property
    def energy_j(self) -> float:
        """Incident energy of the light, J."""
        return float(self.pulses.power_w @ self.pulses.width_s)


def prove(plan: LimitedPlan, scale: PointScale, state: BudgetState, budget: Budget) -> ProvenFrames:
    """Encode a plan, which was limited from `state`, and prove its bytes; LocalProtocolError where they fail."""
    frames = encode(plan, scale)
    pulses, row = check([frame.data for frame in frames], plan, scale, state, budget)
    return ProvenFrames(frames, pulses, row)


def check(
    frames: list[bytes], plan: LimitedPlan, scale: PointScale, state: BudgetState, budget: Budget
) -> tuple[PointPulses, IntArray]:
    """Pulses of frames, and the plan's pulse [n] that each is part of; LocalProtocolError for light beyond the plan's.

    That is: sooner, later, stronger, elsewhere, in a frame that may not leave, or above a cap.
    """
    for data in frames:
        HeliosFrame.checked(data)
    pulses = decode(frames, scale)
    row = np.searchsorted(plan.start_s, pulses.start_s + ROUNDING_S, side="right") - 1
    end_s, plan_end_s = pulses.start_s + pulses.width_s, plan.start_s + plan.width_s
    aside_rad = (0.5 + 1e-6) * scale.rad_per_code
    beyond = (row < 0) | (np.abs(pulses.x_rad - plan.x_rad[row]) > aside_rad) if len(plan) else np.ones(len(row), bool)
    if len(plan):
        beyond |= np.abs(pulses.y_rad - plan.y_rad[row]) > aside_rad
        beyond |= end_s > plan_end_s[row] + ROUNDING_S
        beyond |= pulses.power_w > plan.power_w[row] * (1 + ROUNDING)
    if beyond.any():
        first = int(np.flatnonzero(beyond)[0])
        raise LocalProtocolError(f"encoded light at {pulses.start_s[first]:.6f} s lies beyond the plan's pulses")
    verify(plan, row, pulses, state, budget)
    return pulses, row
