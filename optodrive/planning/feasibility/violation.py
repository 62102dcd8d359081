"""What breaks a plan first, and what proves that no order of a frame's pulses could mend it.

A train's pulse may come late by the move to it and no more: pulses that abut cannot do otherwise, but what adds up over
several is a miss. No frame makes a train later than the train would be alone, so no order mends that.
"""

from dataclasses import dataclass

import numpy as np

from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.core.types.plans import LimitedPlan, PulsePlan
from optodrive.core.types.stimuli import FrameSequence, PulseTrain
from optodrive.physics.thermal_state import Heat
from optodrive.planning.pipeline import ROUNDING_S, Display
from optodrive.planning.scheduler.scheduler import Machine

MOMENT_S = 1e-6


@dataclass(frozen=True)
class Breach:
    """The first pulse that breaks a plan. reason: "deadline", the name of a cap, or "reach"; source: as in a plan."""

    reason: str
    source: int
    pixel: int


def deadlines_s(sequence: FrameSequence, lead_s: float) -> FloatArray:
    """When the last pulse of each frame must have ended, on the plan's time line: [frames]."""
    return np.array([lead_s + frame.show_at_s + frame.duration_s for frame in sequence.frames])


def first_breach(plan: PulsePlan, due_s: FloatArray) -> Breach | None:
    """The first pulse of a plan, or of a piece of one, that is late or was trimmed. due_s: [frames] deadlines."""
    due_s = np.append(due_s, np.inf)
    of_frame = plan.source < len(due_s) - 1
    end_s = plan.start_s + plan.width_s
    frame_late = end_s > due_s[np.minimum(plan.source, len(due_s) - 1)] + ROUNDING_S
    train_late = ~of_frame & (plan.start_s > plan.nominal_s + plan.settle_s + ROUNDING_S)
    late = frame_late | train_late
    trimmed = plan.reason != "" if isinstance(plan, LimitedPlan) else np.zeros(len(plan), dtype=bool)
    rows = np.flatnonzero(late | trimmed)
    if not len(rows):
        return None
    row = int(rows[0])
    reason = "deadline" if late[row] or not isinstance(plan, LimitedPlan) else str(plan.reason[row])
    return Breach(reason, int(plan.source[row]), int(plan.pixel[row]))


def no_order_helps(breach: Breach, sequence: FrameSequence) -> bool:
    """Whether a breach is there whatever the order: out of reach, or a train that is late by itself."""
    return breach.reason == "reach" or (breach.reason == "deadline" and breach.source >= len(sequence.frames))


def least_s(display: Display, sequence: FrameSequence, heat: Heat, source: int, lead_s: float) -> float | None:
    """Beam time that a frame takes at the least between its show_at and its deadline, s; None where nobody knows.

    Counted are trains' pulses that fall into that time whole, and the frame's pixels that nothing else in the sequence
    lights before. Their heat is what there is now; where it falls, the pulse at show_at is the shortest there can be.
    Each but one needs a move from the nearest it can come from. With terms in the model a pulse may get shorter
    by waiting, and nothing is claimed.
    """
    if display.parameters.planner_terms:
        return None
    frame, machine = sequence.frames[source], display.machine
    at_s = lead_s + round(frame.show_at_s * 1e6) * 1e-6
    due_s = lead_s + frame.show_at_s + frame.duration_s
    lit_before = np.zeros(len(frame.target_m), dtype=bool)
    for earlier in sequence.frames[:source]:
        lit_before |= earlier.target_m > 0
    # What a train by height needs is known only with the heat at each of its pulses.
    trains = [t for t in sequence.trains if isinstance(t, PulseTrain) and lead_s + t.start_s < due_s]
    origins = np.array([train.pixel for train in sequence.trains], dtype=np.int64)
    lit_before[origins] = True
    driven = np.flatnonzero(frame.target_m > 0)
    own = _falling(heat, driven[~lit_before[driven]], at_s)
    width_s = {}
    for pixel in own.tolist():
        pulse = heat.pulse_for_peak(pixel, at_s, float(frame.target_m[pixel]), machine.drive)
        if pulse is not None:
            width_s[pixel] = round(pulse[0] * machine.drive.period_s * 1e6) * 1e-6
    moves_s = _least_moves_s(machine, np.array(list(width_s), dtype=np.int64), np.concatenate([driven, origins]))
    train_s = 0.0
    for train in trains:
        starts_s = lead_s + train.pulse_starts_s()
        inside = (starts_s >= at_s) & (starts_s + lead_s + train.pulse_width_s <= due_s)
        train_s += train.pulse_width_s * int(np.count_nonzero(inside))
    return sum(width_s.values()) + moves_s + train_s


def _falling(heat: Heat, pixels: IntArray, at_s: float) -> IntArray:
    """Those pixels whose displacement falls, or rests, when left dark at at_s: it does so from then on."""
    if not len(pixels):
        return pixels
    height_m = heat.traces(np.zeros((0, 4)), pixels.tolist(), np.array([at_s, at_s + MOMENT_S])).displacement_m
    falling: IntArray = pixels[height_m[1] <= height_m[0]]
    return falling


def _least_moves_s(machine: Machine, pixels: IntArray, origins: IntArray) -> float:
    """Moves to each pixel but one, each from where of the other `origins` it takes least; [k] and [m]."""
    if not len(pixels):
        return 0.0
    x_rad, y_rad = machine.field.angles_rad(machine.layout.x_m, machine.layout.y_m)
    moves_s = []
    for pixel in pixels:
        # A train on the pixel itself would need no move; its pixels are not counted here.
        others = origins[origins != pixel]
        if len(others):
            moves_us = machine.moves.least_us(x_rad[others] - x_rad[pixel], y_rad[others] - y_rad[pixel])
            moves_s.append(moves_us * 1e-6)
    return sum(moves_s) - max(moves_s, default=0.0)
