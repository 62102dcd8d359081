"""First violation of a plan, and the lower bound of a frame's beam time over all orders of its pulses.

A train's pulse may be late by the settling time to its pixel and no more. Abutting pulses cannot start earlier, but
lateness that accumulates over several pulses is a violation. No frame delays a train beyond its lateness alone, so
such a violation does not depend on the order.
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
"""Time difference from which the sign of the displacement's slope is computed, s."""


@dataclass(frozen=True)
class Violation:
    """The first pulse of a plan that violates a limit.

    reason: "deadline", the name of a cap, or "unreachable"; source: as in a plan.
    """

    reason: str
    source: int
    pixel: int


def deadlines_s(sequence: FrameSequence, lead_in_s: float) -> FloatArray:
    """Return the deadline of each frame's last pulse on the plan's time axis, s, [frames]."""
    return np.array([lead_in_s + frame.show_at_s + frame.duration_s for frame in sequence.frames])


def find_first_violation(plan: PulsePlan, deadline_s: FloatArray) -> Violation | None:
    """Return the first late or trimmed pulse of a plan or batch, or None.

    deadline_s: [frames]
    """
    deadline_s = np.append(deadline_s, np.inf)
    is_frame = plan.source < len(deadline_s) - 1
    end_s = plan.start_s + plan.width_s
    is_frame_late = end_s > deadline_s[np.minimum(plan.source, len(deadline_s) - 1)] + TIME_TOLERANCE_S
    # One move is no order's fault: pulses that abut cannot avoid it. More than one adds up from pulse to pulse.
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
    """Return whether a violation occurs in every order: an unreachable target or a late train."""
    return violation.reason == "unreachable" or (
        violation.reason == "deadline" and violation.source >= len(sequence.frames)
    )


def beam_lower_bound_s(
    display: DisplayModel, sequence: FrameSequence, heat: ThermalState, source: int, lead_in_s: float
) -> float | None:
    """Return a lower bound of a frame's beam time between show_at and its deadline, s, or None with planner terms.

    The bound sums the trains' pulses that lie within that time, the pulses of the frame's pixels that no earlier frame
    and no train drives, and the smallest settling time to all of these pixels but one. The thermal state of these
    pixels is known; if their displacement falls, the pulse at show_at is the shortest possible. With planner terms a
    pulse may become shorter by waiting, and no bound holds. Several stages share the light, at best equally and without
    moves.
    """
    if display.parameters.planner_terms:
        return None
    stages = len(display.scan_heads)
    scan_head = max(display.scan_heads, key=lambda head: head.drive.max_power_w)
    frame, is_one_drive = sequence.frames[source], len({head.drive for head in display.scan_heads}) == 1
    at_s = lead_in_s + round(frame.show_at_s * 1e6) * 1e-6
    deadline_s = lead_in_s + frame.show_at_s + frame.duration_s
    is_driven_before = np.zeros(len(frame.target_m), dtype=bool)
    for earlier in sequence.frames[:source]:
        is_driven_before |= earlier.target_m > 0
    # The pulse widths of a height train depend on the thermal state at each pulse and are unknown here.
    trains = [t for t in sequence.trains if isinstance(t, PulseTrain) and lead_in_s + t.start_s < deadline_s]
    origins = np.array([train.pixel for train in sequence.trains], dtype=np.int64)
    is_driven_before[origins] = True
    driven = np.flatnonzero(frame.target_m > 0)
    fresh = _select_falling_pixels(heat, driven[~is_driven_before[driven]], at_s)
    width_s = {}
    for pixel in fresh.tolist():
        pulse = heat.solve_pulse(pixel, at_s, float(frame.target_m[pixel]), scan_head.drive)
        if pulse is not None:
            periods = pulse[0] if is_one_drive else pulse[0] - 1  # a finer PWM rounds less
            width_s[pixel] = round(periods * scan_head.drive.period_s * 1e6) * 1e-6
    settling_s = 0.0
    if stages == 1:
        drawn = np.array(list(width_s), dtype=np.int64)
        settling_s = _min_settling_s(scan_head, drawn, np.concatenate([driven, origins]))
    train_s = 0.0
    for train in trains:
        starts_s = lead_in_s + train.pulse_starts_s()
        inside = (starts_s >= at_s) & (starts_s + lead_in_s + train.pulse_width_s <= deadline_s)
        train_s += train.pulse_width_s * int(np.count_nonzero(inside))
    return (sum(width_s.values()) + settling_s + train_s) / stages


def _select_falling_pixels(heat: ThermalState, pixels: IntArray, at_s: float) -> IntArray:
    """Return the pixels whose displacement does not rise after at_s with the gate off. It then keeps falling."""
    if not len(pixels):
        return pixels
    height_m = heat.simulate_traces(
        np.zeros((0, 4)), pixels.tolist(), np.array([at_s, at_s + SLOPE_INTERVAL_S])
    ).displacement_m
    falling: IntArray = pixels[height_m[1] <= height_m[0]]
    return falling


def _min_settling_s(scan_head: ScanHead, pixels: IntArray, origins: IntArray) -> float:
    """Return the sum of the smallest settling times to all pixels but one, s.

    pixels: [k], origins: [m]
    """
    if not len(pixels):
        return 0.0
    x_rad, y_rad = scan_head.field.angles_rad(scan_head.layout.x_m, scan_head.layout.y_m)
    settling_s = []
    for pixel in pixels:
        # A train on the pixel itself would need no move; pixels of trains are excluded here.
        others = origins[origins != pixel]
        if len(others):
            settling_us = scan_head.settling.min_settling_us(x_rad[others] - x_rad[pixel], y_rad[others] - y_rad[pixel])
            # The nearest of all pixels from which the beam may come: no order has a shorter move.
            settling_s.append(settling_us * 1e-6)
    # All but one: the beam may already stand on the pixel that is farthest from the others.
    return sum(settling_s) - max(settling_s, default=0.0)
