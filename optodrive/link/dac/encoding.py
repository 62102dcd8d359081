"""Encoding of limited plans to chunks of points, and decoding of their bytes for verification before emission.

A point emits only if its whole duration lies within the plan's pulse: emission starts no earlier, ends no later and is
no stronger than planned. The first point after a pulse moves the mirrors on, so they have at least the planned time.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from optodrive.core.errors import LocalProtocolError
from optodrive.core.laser_power import ROUNDING, compute_duty
from optodrive.core.types.arrays import BoolArray, FloatArray, IntArray, ReadOnlyArrays
from optodrive.core.types.plans import LimitedPlan
from optodrive.device.config import Config
from optodrive.device.config_sections import DAC_HALF_RANGE_CODES
from optodrive.device.field_loader import build_settling_table
from optodrive.link.dac.formats.base import CHUNK_MAX_S, Chunk, DacFormat, PointTable
from optodrive.link.dac.formats.registry import find_format
from optodrive.link.protocol.quantisation import DacScale

TICKS_PER_PLAN_S = 1_000_000
"""Plans have whole microseconds."""
TRAILING_POINTS = 2
"""Blank points after a plan: one ends its last chunk, the other permits that chunk to be one point shorter."""


@dataclass(frozen=True)
class PointScale(DacScale, bits=12):
    """Scale factors between SI units and codes, levels and points of one kind of DAC.

    early_points: points by which the mirrors leave before the end of a pulse, after early_dwell_us on its pixel
    """

    format: DacFormat
    early_points: int = 0
    early_dwell_us: int = 0

    @classmethod
    def from_config(cls, config: Config) -> "PointScale":
        """Derive the scale. The codes span the scanner's whole range, the largest level is the laser's full power."""
        rad_per_code = config.scanner.range_rad / DAC_HALF_RANGE_CODES
        dac_format = find_format(config.board.transport)(config.board.points_per_s)
        settling = build_settling_table(config)
        return cls(
            rad_per_code,
            config.laser.max_power_w,
            dac_format,
            settling.early_points,
            settling.early_dwell_us,
            curve=config.laser.curve,
            min_power_w=config.min_power_w,
            **config.scanner.wiring._asdict(),
        )

    @property
    def point_s(self) -> float:
        """Actual duration of a point, s."""
        return self.format.point_ticks / self.format.clock_hz

    @property
    def points_max(self) -> int:
        """Maximum number of points of a chunk."""
        return min(self.format.points_max, int(CHUNK_MAX_S / self.point_s * (1 + 1e-12)))


@dataclass(frozen=True, eq=False)
class PointPulses(ReadOnlyArrays):
    """Pulses decoded from chunks, all [n]. Times count from the first point and assume no gaps between chunks.

    A pulse across the end of a chunk appears as two pulses.
    """

    start_s: FloatArray
    width_s: FloatArray
    x_rad: FloatArray
    y_rad: FloatArray
    power_w: FloatArray

    def __len__(self) -> int:
        return len(self.start_s)


def encode(plan: LimitedPlan, scale: PointScale) -> tuple[Chunk, ...]:
    """Encode a plan to chunks.

    Power is rounded down. Every chunk ends with a blank point, which interrupts a pulse if necessary. Raise
    LocalProtocolError if pulses overlap or exceed the power range.
    """
    points, ticks = _encode_points(plan, scale), scale.format.point_ticks
    return tuple(
        scale.format.check(scale.format.pack(points[first:last], first * ticks))
        for first, last in _split_chunks(points, scale)
    )


def _encode_points(plan: LimitedPlan, scale: PointScale) -> PointTable:
    """Return all points of a plan, [n, 3], from the plan's zero."""
    ticks, ticks_per_us = scale.format.point_ticks, scale.format.clock_hz // TICKS_PER_PLAN_S
    level_max = scale.format.level_max
    start = np.rint(plan.start_s * 1e6).astype(np.int64) * ticks_per_us
    end = start + np.rint(plan.width_s * 1e6).astype(np.int64) * ticks_per_us
    if len(plan) and (start[0] < 0 or (start[1:] < end[:-1]).any()):
        raise LocalProtocolError("pulses overlap, or the first begins before the plan")
    share = plan.power_w / scale.full_power_w
    if len(plan) and not 0 <= share.min() <= share.max() <= 1 + 1e-12:
        raise LocalProtocolError(f"powers of {share.min():g} to {share.max():g} leave the range 0 to 1 of the laser's")
    # A device that may play slower emits less power for longer: a pulse's power has the stretch, its light has not.
    duty = compute_duty(plan.power_w / scale.format.stretch, scale.full_power_w, scale.curve)
    duty[plan.power_w < scale.min_power_w * (1.0 - ROUNDING)] = 0.0
    level = np.floor(duty * level_max * (1 + 1e-12)).astype(np.int64)
    first, last = -(-start // ticks) + scale.format.settling_points, end // ticks
    last[:-1] -= last[:-1] == first[1:]  # a blank point separates adjacent pulses
    emitting = (level > 0) & (last > first)  # the mirrors skip pulses without emission
    first, last, level = first[emitting], last[emitting], level[emitting]
    x, y = scale.to_outputs(scale.to_codes(plan.x_rad[emitting]), scale.to_codes(plan.y_rad[emitting]))
    early = np.where(_find_early_steps(plan, scale), scale.early_points, 0)[emitting]
    before = np.concatenate([[0], last[:-1]])[: len(last)]
    run_lengths = np.column_stack([first - before, last - first]).ravel()
    count = int(last[-1]) if len(last) else 0
    tail = [-(count + 1) % scale.points_max + 1 if scale.format.fixed_length else TRAILING_POINTS]
    levels = np.repeat(
        np.append(np.column_stack([np.zeros_like(level), level]).ravel(), 0), np.append(run_lengths, tail)
    )
    early[-1:] = 0  # the mirrors stay on the last pixel
    dwell_points = np.append(np.diff(last - early, prepend=0), tail)
    x, y = (
        np.repeat(np.append(codes, codes[-1:] if len(codes) else PointScale.CENTRE_CODE), dwell_points)
        for codes in (x, y)
    )
    return np.column_stack([x, y, levels])


def _find_early_steps(plan: LimitedPlan, scale: PointScale) -> BoolArray:
    """Return for every pulse whether the step behind it is sent early, [n]: the mirrors have rested on its pixel.

    They have been there since the first of the consecutive pulses on it, also if that one emits nothing.
    """
    start_us, width_us = (np.rint(1e6 * times_s).astype(np.int64) for times_s in (plan.start_s, plan.width_s))
    is_first = np.append(True, np.diff(plan.pixel) != 0)[: len(plan)]
    arrival_us = start_us[is_first][np.cumsum(is_first) - 1]
    dwell_us: IntArray = start_us + width_us - arrival_us
    return (dwell_us >= scale.early_dwell_us) & (scale.early_points > 0)


def _split_chunks(points: PointTable, scale: PointScale) -> Iterator[tuple[int, int]]:
    """Yield first and last index of every chunk. Blank the last point of a chunk that ends within a pulse."""
    first = 0
    while first < len(points):
        longest = min(first + scale.points_max, len(points))
        last = None if scale.format.fixed_length else _find_gate_off_end(points, first, longest, scale.format)
        if last is None:
            last = longest if scale.format.accepts_length(longest - first) else longest - 1
            points[last - 1, 2] = 0
            _blank_early_step(points, last, scale)
        yield first, last
        first = last


def _blank_early_step(points: PointTable, last: int, scale: PointScale) -> None:
    """Blank the light of an early step that follows the end of a chunk."""
    before = points[max(0, last - scale.early_points) : last + 1, :2]
    if (before != before[-1:]).any():
        level = points[last : last + scale.early_points, 2]
        level[np.logical_and.accumulate(level > 0)] = 0


def _find_gate_off_end(points: PointTable, first: int, longest: int, dac_format: DacFormat) -> int | None:
    """Return the latest chunk end behind a blank point, in the second half of the longest chunk, None without one."""
    min_end = first + (longest - first) // 2
    for last in (min_end + 1 + np.flatnonzero(points[min_end:longest, 2] == 0))[::-1].tolist():
        if dac_format.accepts_length(last - first):
            return int(last)
    return None


def decode(chunks: Sequence[bytes], scale: PointScale) -> PointPulses:
    """Decode the bytes of consecutive chunks. The brightest channel counts.

    Power is that of the level times the stretch, as if the energy of a longer point had been emitted in the nominal
    time. The light of an early step, whose mirrors have rested before it, belongs to the pulse before it. Raise
    LocalProtocolError for invalid chunks.
    """
    tables, ticks = [], []
    for data in chunks:
        table, point_ticks = scale.format.parse(data)
        tables.append(table)
        ticks.append(np.full(len(table), point_ticks, dtype=np.int64))
    points = np.concatenate([*tables, np.zeros((1, 3), dtype=np.int64)])
    begin_ticks = np.concatenate([[0], np.cumsum(np.concatenate([*ticks, np.zeros(1, dtype=np.int64)]))[:-1]])
    changes = np.flatnonzero((np.diff(points, axis=0) != 0).any(axis=1)) + 1
    run_starts = np.concatenate([[0], changes])
    run_ends = np.append(changes, len(points) - 1)
    emitting = points[run_starts, 2] > 0
    run_starts, run_ends = run_starts[emitting], run_ends[emitting]
    is_early = _match_early_steps(points, run_starts, run_ends, begin_ticks / scale.format.clock_hz, scale)
    run_ends = np.where(np.append(is_early[1:], False), np.append(run_ends[1:], 0), run_ends)[~is_early]
    run_starts = run_starts[~is_early]
    x_output, y_output, level = points[run_starts].T
    x, y = scale.to_axes(x_output, y_output)
    return PointPulses(
        start_s=begin_ticks[run_starts] / scale.format.clock_hz,
        width_s=(begin_ticks[run_ends] - begin_ticks[run_starts]) / scale.format.clock_hz,
        x_rad=scale.to_angles_rad(x),
        y_rad=scale.to_angles_rad(y),
        power_w=scale.to_power_w(level / scale.format.level_max) * scale.format.stretch,
    )


def _match_early_steps(
    points: PointTable, run_starts: IntArray, run_ends: IntArray, begin_s: FloatArray, scale: PointScale
) -> BoolArray:
    """Return which emitting runs [k] continue the light of the run before while the mirrors leave, [k].

    begin_s: [n] of each point
    """
    moved = np.flatnonzero(np.append(True, (np.diff(points[:, :2], axis=0) != 0).any(axis=1)))
    arrived = moved[np.searchsorted(moved, run_starts, side="right") - 1]
    held_us = 1e6 * (begin_s[run_ends] - begin_s[arrived])
    is_early = np.zeros(len(run_starts), dtype=np.bool)
    is_early[1:] = (
        (run_starts[1:] == run_ends[:-1])
        & (points[run_starts[1:], 2] == points[run_starts[:-1], 2])
        & (run_ends[1:] - run_starts[1:] <= scale.early_points)
        & (held_us[:-1] >= scale.early_dwell_us)
    )
    return is_early
