"""Encoding of limited plans to Helios frames, and decoding of the frame bytes for verification before emission.

A point emits only if its whole duration lies within the plan's pulse: emission starts no earlier, ends no later and is
no stronger than planned. The first point after a pulse moves the mirrors on, so they have at least the planned time.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from optodrive.core.errors import LocalProtocolError
from optodrive.core.types.arrays import FloatArray, IntArray, freeze_arrays
from optodrive.core.types.plans import LimitedPlan
from optodrive.device.config import Config
from optodrive.device.config_sections import HELIOS_HALF_RANGE_CODES
from optodrive.link.helios.frames import (
    CLOCK_HZ,
    FRAME_MAX_S,
    POINT_BYTES,
    POINTS_MAX,
    HeliosFrame,
    PointTable,
    is_whole_packets,
    parse_points,
    point_ticks,
)
from optodrive.link.protocol.dac_codes import DacScale

LEVEL_MAX = 255
TICKS_PER_US = CLOCK_HZ // 1_000_000
TRAILING_POINTS = 2
"""Blank points after a plan: one ends its last frame, the other permits that frame to be one point shorter."""


@dataclass(frozen=True)
class PointScale(DacScale, bits=12):
    """Scale factors between SI units and codes, levels and points.

    points_per_s: requested rate; the actual rate of the DAC is slightly lower
    """

    full_power_w: float
    points_per_s: int

    @classmethod
    def from_config(cls, config: Config) -> "PointScale":
        """Derive the scale. The codes span the whole range of the scanner, level 255 is the laser's full power."""
        rad_per_code = config.scanner.range_rad / HELIOS_HALF_RANGE_CODES
        return cls(rad_per_code, config.laser.max_power_w, config.board.points_per_s)

    @property
    def point_s(self) -> float:
        """Actual duration of a point, s."""
        return point_ticks(self.points_per_s) / CLOCK_HZ


@dataclass(frozen=True, eq=False)
class PointPulses:
    """Pulses decoded from frames, all [n]. Times count from the first point and assume no gaps between frames.

    A pulse across the end of a frame appears as two pulses.
    """

    start_s: FloatArray
    width_s: FloatArray
    x_rad: FloatArray
    y_rad: FloatArray
    power_w: FloatArray

    def __post_init__(self) -> None:
        freeze_arrays(self)

    def __len__(self) -> int:
        return len(self.start_s)


def encode(plan: LimitedPlan, scale: PointScale) -> tuple[HeliosFrame, ...]:
    """Encode a plan to frames.

    Power is rounded down. Every frame ends with a blank point, which interrupts a pulse if necessary. Raise
    LocalProtocolError if pulses overlap or exceed the power range.
    """
    points = _encode_points(plan, scale)
    return tuple(
        HeliosFrame.from_points(points[first:last], scale.points_per_s) for first, last in _split_frames(points, scale)
    )


def _encode_points(plan: LimitedPlan, scale: PointScale) -> PointTable:
    """Return all points of a plan, [n, 7], from the plan's zero."""
    ticks = point_ticks(scale.points_per_s)
    start = np.rint(plan.start_s * 1e6).astype(np.int64) * TICKS_PER_US
    end = start + np.rint(plan.width_s * 1e6).astype(np.int64) * TICKS_PER_US
    if len(plan) and (start[0] < 0 or (start[1:] < end[:-1]).any()):
        raise LocalProtocolError("pulses overlap, or the first begins before the plan")
    level = np.floor(plan.power_w / scale.full_power_w * LEVEL_MAX * (1 + 1e-12)).astype(np.int64)
    if len(plan) and not 0 <= level.min() <= level.max() <= LEVEL_MAX:
        raise LocalProtocolError(f"levels {level.min()} to {level.max()} leave the range 0 to {LEVEL_MAX}")
    first, last = -(-start // ticks), end // ticks
    last[:-1] -= last[:-1] == first[1:]  # a blank point separates adjacent pulses
    emitting = (level > 0) & (last > first)  # the mirrors skip pulses without emission
    first, last, level = first[emitting], last[emitting], level[emitting]
    x, y = scale.to_codes(plan.x_rad[emitting]), scale.to_codes(plan.y_rad[emitting])
    before = np.concatenate([[0], last[:-1]])[: len(last)]
    run_lengths = np.column_stack([first - before, last - first]).ravel()
    tail = [TRAILING_POINTS]
    levels = np.repeat(
        np.append(np.column_stack([np.zeros_like(level), level]).ravel(), 0), np.append(run_lengths, tail)
    )
    dwell_points = np.append(last - before, tail)
    x, y = (
        np.repeat(np.append(codes, codes[-1:] if len(codes) else PointScale.CENTRE_CODE), dwell_points)
        for codes in (x, y)
    )
    return _pack_points(x, y, levels)


def _pack_points(x: IntArray, y: IntArray, level: IntArray) -> PointTable:
    points = np.empty((len(level), POINT_BYTES), dtype=np.uint8)
    points[:, 0] = x >> 4
    points[:, 1] = (x & 15) << 4 | y >> 8
    points[:, 2] = y & 255
    points[:, 3:] = level[:, None]
    return points


def _split_frames(points: PointTable, scale: PointScale) -> Iterator[tuple[int, int]]:
    """Yield first and last index of every frame. Blank the last point of a frame that ends within a pulse."""
    points_max, first = min(POINTS_MAX, int(FRAME_MAX_S / scale.point_s)), 0
    while first < len(points):
        longest = min(first + points_max, len(points))
        last = _find_gate_off_end(points, first, longest)
        if last is None:
            last = longest - 1 if is_whole_packets(longest - first) else longest
            points[last - 1, 3:] = 0
        yield first, last
        first = last


def _find_gate_off_end(points: PointTable, first: int, longest: int) -> int | None:
    """Return the latest frame end behind a blank point, in the second half of the longest frame, None without one."""
    min_end = first + (longest - first) // 2
    for last in (min_end + 1 + np.flatnonzero(points[min_end:longest, 6] == 0))[::-1].tolist():
        if not is_whole_packets(last - first):
            return int(last)
    return None


def decode(frames: Sequence[bytes], scale: PointScale) -> PointPulses:
    """Decode the bytes of consecutive frames. The brightest channel counts.

    Raise LocalProtocolError for invalid frames.
    """
    tables, ticks = [], []
    for data in frames:
        table, points_per_s = parse_points(data)
        tables.append(table)
        ticks.append(np.full(len(table), point_ticks(points_per_s), dtype=np.int64))
    points = np.concatenate([*tables, np.zeros((1, POINT_BYTES), dtype=np.uint8)]).astype(np.int64)
    begin_ticks = np.concatenate([[0], np.cumsum(np.concatenate([*ticks, np.zeros(1, dtype=np.int64)]))[:-1]])
    x, y = points[:, 0] << 4 | points[:, 1] >> 4, (points[:, 1] & 15) << 8 | points[:, 2]
    level = points[:, 3:].max(axis=1)
    changes = np.flatnonzero((np.diff(x) != 0) | (np.diff(y) != 0) | (np.diff(level) != 0)) + 1
    run_starts = np.concatenate([[0], changes])
    run_ends = np.append(changes, len(points) - 1)
    emitting = level[run_starts] > 0
    run_starts, run_ends = run_starts[emitting], run_ends[emitting]
    return PointPulses(
        start_s=begin_ticks[run_starts] / CLOCK_HZ,
        width_s=(begin_ticks[run_ends] - begin_ticks[run_starts]) / CLOCK_HZ,
        x_rad=scale.to_angles_rad(x[run_starts]),
        y_rad=scale.to_angles_rad(y[run_starts]),
        power_w=level[run_starts] / LEVEL_MAX * scale.full_power_w,
    )
