"""What breaks a plan first, and what proves that no order of a frame's pulses could mend it.

A train's pulse may come late by the move to it and no more: pulses that abut cannot do otherwise, but what adds up over
several is a miss. No frame makes a train later than the train would be alone, so no order mends that.
"""

from dataclasses import dataclass

import numpy as np

from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.core.types.plans import LimitedPlan, PulsePlan
from optodrive.core.types.stimuli import FrameSequence, PulseTrain
from optodrive.physics.thermal_state import ThermalState
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.planned_sequence import TIME_TOLERANCE_S
from optodrive.planning.scheduler.scan_head import ScanHead

SLOPE_INTERVAL_S = 1e-6


@dataclass(frozen=True)
class Violation:
    """The first pulse of a plan that violates a limit.

    reason: "deadline", the name of a cap, or "unreachable"; source: as in a plan.
    """

    reason: str
    source: int
    pixel: int


def deadlines_s(sequence: FrameSequence, lead_s: float) -> FloatArray:
    """When the last pulse of each frame must have ended, on the plan's time line: [frames]."""
    return np.array([lead_s + frame.show_at_s + frame.duration_s for frame in sequence.frames])


def find_first_violation(plan: PulsePlan, deadline_s: FloatArray) -> Violation | None:
    """The first pulse of a plan, or of a piece of one, that is late or was trimmed. due_s: [frames] deadlines."""
    deadline_s = np.append(deadline_s, np.inf)
    is_frame = plan.source < len(deadline_s) - 1
    end_s = plan.start_s + plan.width_s
    is_frame_late = end_s > deadline_s[np.minimum(plan.source, len(deadline_s) - 1)] + TIME_TOLERANCE_S
    is_train_late = ~is_frame & (plan.start_s > plan.requested_start_s + plan.settling_s + TIME_TOLERANCE_S)
    is_late = is_frame_late | is_train_late
    is_trimmed = plan.reason != "" if isinstance(plan, LimitedPlan) else np.zeros(len(plan), dtype=bool)
    rows = np.flatnonzero(is_late | is_trimmed)
    if not len(rows):
        return None
    row = int(rows[0])
    reason = "deadline" if is_late[row] or not isinstance(plan, LimitedPlan) else str(plan.reason[row])
    return Violation(reason, int(plan.source[row]), int(plan.pixel[row]))


def is_order_independent(violation: Violation, sequence: FrameSequence) -> bool:
    """Whether a breach is there whatever the order: out of reach, or a train that is late by itself."""
    return violation.reason == "unreachable" or (
        violation.reason == "deadline" and violation.source >= len(sequence.frames)
    )


def beam_lower_bound_s(
    display: DisplayModel, sequence: FrameSequence, heat: ThermalState, source: int, lead_s: float
) -> float | None:
    """Beam time that a frame takes at the least between its show_at and its deadline, s; None where nobody knows.

    Counted are trains' pulses that fall into that time whole, and the frame's pixels that nothing else in the sequence
    lights before. Their heat is what there is now; where it falls, the pulse at show_at is the shortest there can be.
    Each but one needs a move from the nearest it can come from. With terms in the model a pulse may get shorter
    by waiting, and nothing is claimed.
    """
    if display.parameters.planner_terms:
        return None
    frame, machine = sequence.frames[source], display.scan_head
    at_s = lead_s + round(frame.show_at_s * 1e6) * 1e-6
    deadline_s = lead_s + frame.show_at_s + frame.duration_s
    is_driven_before = np.zeros(len(frame.target_m), dtype=bool)
    for earlier in sequence.frames[:source]:
        is_driven_before |= earlier.target_m > 0
    # What a train by height needs is known only with the heat at each of its pulses.
    trains = [t for t in sequence.trains if isinstance(t, PulseTrain) and lead_s + t.start_s < deadline_s]
    origins = np.array([train.pixel for train in sequence.trains], dtype=np.int64)
    is_driven_before[origins] = True
    driven = np.flatnonzero(frame.target_m > 0)
    fresh = _select_falling_pixels(heat, driven[~is_driven_before[driven]], at_s)
    width_s = {}
    for pixel in fresh.tolist():
        pulse = heat.solve_pulse(pixel, at_s, float(frame.target_m[pixel]), machine.drive)
        if pulse is not None:
            width_s[pixel] = round(pulse[0] * machine.drive.period_s * 1e6) * 1e-6
    settling_s = _min_settling_s(machine, np.array(list(width_s), dtype=np.int64), np.concatenate([driven, origins]))
    train_s = 0.0
    for train in trains:
        starts_s = lead_s + train.pulse_starts_s()
        inside = (starts_s >= at_s) & (starts_s + lead_s + train.pulse_width_s <= deadline_s)
        train_s += train.pulse_width_s * int(np.count_nonzero(inside))
    return sum(width_s.values()) + settling_s + train_s


def _select_falling_pixels(heat: ThermalState, pixels: IntArray, at_s: float) -> IntArray:
    """Those pixels whose displacement falls, or rests, when left dark at at_s: it does so from then on."""
    if not len(pixels):
        return pixels
    height_m = heat.simulate_traces(
        np.zeros((0, 4)), pixels.tolist(), np.array([at_s, at_s + SLOPE_INTERVAL_S])
    ).displacement_m
    falling: IntArray = pixels[height_m[1] <= height_m[0]]
    return falling


def _min_settling_s(machine: ScanHead, pixels: IntArray, origins: IntArray) -> float:
    """Moves to each pixel but one, each from where of the other `origins` it takes least; [k] and [m]."""
    if not len(pixels):
        return 0.0
    x_rad, y_rad = machine.field.angles_rad(machine.layout.x_m, machine.layout.y_m)
    settling_s = []
    for pixel in pixels:
        # A train on the pixel itself would need no move; its pixels are not counted here.
        others = origins[origins != pixel]
        if len(others):
            settling_us = machine.settling.min_settling_us(x_rad[others] - x_rad[pixel], y_rad[others] - y_rad[pixel])
            settling_s.append(settling_us * 1e-6)
    return sum(settling_s) - max(settling_s, default=0.0)
