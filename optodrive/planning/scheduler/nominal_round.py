"""The pulses of a frame's round on nominal pixels, in one kernel.

It states what `BatchPlanner.extend_round` does pulse by pulse, without train pulses; other threads run meanwhile.
"""

from itertools import repeat
from typing import NamedTuple

import numpy as np

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.device.settling import CEIL_OFFSET
from optodrive.physics.nominal_display import NominalThermalState, solve_pulse_at
from optodrive.physics.pulse_for_height import DriveRange, round_us
from optodrive.planning.scheduler.batch_draft import BatchDraft, PlannedPulse
from optodrive.planning.scheduler.scan_head import MoveTimes

NO_PIXEL = -1


class KernelBeam(NamedTuple):
    """The part of a `BeamState` that a round changes, NO_PIXEL for an unknown pixel."""

    free_us: int
    pixel: int
    arrival_us: int
    dwell_us: int


class DriveSpan(NamedTuple):
    """A `DriveRange` for kernels."""

    max_power_w: float
    period_s: float
    max_periods: int
    is_fine: bool
    min_duty: float


class RoundPulses(NamedTuple):
    """Columns of the pulses [n] of a round, filled in by the kernel. width_us: 0 for a pixel that needs no pulse."""

    start_us: IntArray
    settling_us: IntArray
    width_us: IntArray
    duty: FloatArray

    @classmethod
    def empty(cls, count: int) -> "RoundPulses":
        """Return columns of `count` pulses."""
        start_us, settling_us, width_us = np.zeros((3, count), dtype=np.int64)
        return cls(start_us, settling_us, width_us, np.zeros(count))


def draft_round(
    draft: BatchDraft,
    stage: int,
    heat: NominalThermalState,
    pixel: IntArray,
    target_m: FloatArray,
    requested_us: int,
    earliest_us: int,
    source: int,
    drive: DriveRange,
    max_count: int | None,
    until_us: float,
) -> None:
    """Draft at most max_count pulses of a stage, to the heights target_m [n] on `pixel` [n], in this order.

    earliest_us: no pulse starts before; until_us: none but the first follows one that ends then or later
    Raises ValueError for a pulse before its pixel's last event.
    """
    beam, pulses = draft.state.beams[stage], RoundPulses.empty(len(pixel))
    start = KernelBeam(beam.free_us, NO_PIXEL if beam.pixel is None else beam.pixel, beam.arrival_us, beam.dwell_us)
    span = DriveSpan(drive.max_power_w, drive.period_s, drive.max_periods, drive.is_fine, drive.min_duty)
    count = len(pixel) if max_count is None else max_count
    visited, *after = _solve_round(
        *heat.kernel_state, draft.paths[stage].moves, pixel, target_m, earliest_us, until_us, start, span, count, pulses
    )
    if visited < 0:
        row = -1 - visited
        raise heat.build_time_order_error(int(pixel[row]), float(pulses.start_us[row]) * 1e-6)
    beam.position += visited
    beam.free_us, last_pixel, beam.arrival_us, beam.dwell_us = after
    beam.pixel = None if last_pixel == NO_PIXEL else last_pixel
    for skipped in np.flatnonzero(pulses.width_us[:visited] == 0):
        draft.skip(source, int(pixel[skipped]), float(target_m[skipped]))
    drawn = np.flatnonzero(pulses.width_us[:visited])
    columns = (
        pulses.start_us[drawn],
        pulses.width_us[drawn],
        pulses.duty[drawn] * drive.max_power_w,
        pixel[drawn],
        pulses.settling_us[drawn],
        target_m[drawn],
    )
    draft.rows += map(
        PlannedPulse._make,
        zip(*(column.tolist() for column in columns), repeat(requested_us), repeat(source), repeat(stage)),
    )


@kernel
def _solve_round(
    columns: FloatArray,
    at_s: FloatArray,
    theta_k: FloatArray,
    gamma_k: FloatArray,
    moves: MoveTimes,
    pixel: IntArray,
    target_m: FloatArray,
    earliest_us: int,
    until_us: float,
    beam: KernelBeam,
    drive: DriveSpan,
    max_rows: int,
    pulses: RoundPulses,
) -> tuple[int, int, int, int, int]:
    """Fill in the pulses [n]. Return the number of visited pixels, and the beam after them.

    The number is −1 − n if pulse n is before its pixel's last event.
    """
    row = rows = 0
    free_us, origin, arrival_us, dwell_us = beam.free_us, beam.pixel, beam.arrival_us, beam.dwell_us
    while row < len(pixel) and rows < max_rows and (rows == 0 or free_us < until_us):
        i = pixel[row]
        settling_us = _compute_settling_us(moves, origin, i, dwell_us)
        start_us = max(earliest_us, free_us + settling_us)
        periods, duty = solve_pulse_at(
            columns,
            at_s,
            theta_k,
            gamma_k,
            i,
            start_us * 1e-6,
            target_m[row],
            drive.max_power_w,
            drive.period_s,
            1,
            drive.max_periods,
            drive.is_fine,
            drive.min_duty,
            0.0,
        )
        pulses.start_us[row], pulses.settling_us[row] = start_us, settling_us
        width_us = round_us(periods * drive.period_s)
        pulses.width_us[row], pulses.duty[row] = width_us, duty
        if periods < 0.0:
            # A kernel raises no error with numbers in it; the caller does.
            return -1 - row, free_us, origin, arrival_us, dwell_us
        # A skipped pixel is not visited: the beam goes on from where it stands.
        if width_us:
            if i != origin:
                arrival_us = start_us
            free_us, origin = start_us + width_us, i
            dwell_us = free_us - arrival_us
            rows += 1
        row += 1
    return row, free_us, origin, arrival_us, dwell_us


@kernel
def _compute_settling_us(moves: MoveTimes, origin: int, pixel: int, dwell_us: int) -> int:
    """Return the settling time of a move as `SettlingTable.settling_us` does, from NO_PIXEL too."""
    if origin == NO_PIXEL:
        return moves.lead_in_us
    # Rounded up to whole pitches, as in the table: of a distance between two the longer time holds.
    x = int(abs(moves.x_rad[pixel] - moves.x_rad[origin]) / moves.pitch_rad + CEIL_OFFSET)
    y = int(abs(moves.y_rad[pixel] - moves.y_rad[origin]) / moves.pitch_rad + CEIL_OFFSET)
    early_us = moves.early_us if dwell_us >= moves.early_dwell_us else 0
    if dwell_us >= moves.long_dwell_us:
        # Both axes move at once, so the slower decides. Only after a long dwell has the mirror come to rest, so that a
        # step may be sent early.
        return max(0, int(max(moves.long_x_us[x], moves.long_y_us[y])) - early_us)
    return int(max(moves.short_x_us[x], moves.short_y_us[y]))
