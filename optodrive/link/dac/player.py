"""Verified playing on a laser DAC.

The bytes of the chunks are verified against the plan and the caps before any of them is emitted.
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from optodrive.core.clock import Clock
from optodrive.core.errors import LinkError, LocalProtocolError
from optodrive.core.types.arrays import IntArray
from optodrive.core.types.plans import BudgetState, LimitedPlan
from optodrive.link.dac.encoding import PointPulses, PointScale, decode, encode
from optodrive.link.dac.formats.base import Chunk
from optodrive.link.dac.laser_dac import LaserDac
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


POLL_INTERVAL_S = 0.001
READY_TIMEOUT_S = 0.5
"""Maximum time for the DAC to become ready, 20 times the longest chunk."""


@dataclass(frozen=True)
class PlaybackReport:
    """Report of a playback.

    underruns, underrun_s: number and minimum total duration of gaps between chunks; nothing is emitted in a gap, and
    everything after it is late
    """

    chunks: int
    underruns: int
    underrun_s: float


def play(
    dac: LaserDac,
    verified: VerifiedChunks,
    clock: Clock,
    on_progress: Callable[[float], None] = lambda _fraction: None,
) -> PlaybackReport:
    """Play chunks on a display in the thermal state that the plan assumes. Block until emission has ended.

    on_progress: called often with the sent fraction; an exception that it raises ends the playback
    Raise InputError without an interlock and LinkError if the DAC fails. The DAC is stopped before any exception
    propagates.
    """
    dac.require_interlock()
    try:
        dac.stop()  # also centres the mirrors, where every plan starts
        dac.start()
        report = _send_chunks(dac, verified.chunks, clock, on_progress)
    except BaseException:
        with suppress(LinkError):  # the first error propagates; closing the DAC stops it again
            dac.stop()
        raise
    dac.stop()
    return report


def _send_chunks(
    dac: LaserDac, chunks: tuple[Chunk, ...], clock: Clock, on_progress: Callable[[float], None]
) -> PlaybackReport:
    underruns, underrun_s, end_s = 0, 0.0, clock.now_s()
    for number, chunk in enumerate(chunks):
        fraction = number / len(chunks)
        _wait_until_ready(dac, clock, lambda fraction=fraction: on_progress(fraction))  # type: ignore[misc]
        dac.send(chunk)
        now_s = clock.now_s()
        if number and now_s > end_s:
            underruns, underrun_s = underruns + 1, underrun_s + now_s - end_s
        end_s = max(end_s, now_s) + chunk.duration_s
    while clock.now_s() < end_s + dac.format.lag_max_s:
        on_progress(1.0)
        clock.sleep(POLL_INTERVAL_S)
    return PlaybackReport(len(chunks), underruns, underrun_s)


def _wait_until_ready(dac: LaserDac, clock: Clock, on_progress: Callable[[], None]) -> None:
    deadline_s = clock.now_s() + READY_TIMEOUT_S
    on_progress()
    while not dac.is_ready():
        if clock.now_s() > deadline_s:
            raise LinkError(
                f"the {dac.format.label} was not ready for a chunk within {READY_TIMEOUT_S:g} s; it was stopped"
            )
        on_progress()
        clock.sleep(POLL_INTERVAL_S)
