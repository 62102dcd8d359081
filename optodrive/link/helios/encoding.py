"""Limited plans to a Helios' points at a fixed rate, and the very bytes back to SI, for the proof before emission.

A point is lit only if all of it lies within the plan's pulse: light comes no sooner, ends no later, and is no stronger
than planned. Mirrors are sent on with the first point after a pulse, so they have at least the time planned.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from optodrive.core.errors import LocalProtocolError
from optodrive.core.types.arrays import FloatArray, IntArray, freeze_arrays
from optodrive.core.types.plans import LimitedPlan
from optodrive.device.config import HELIOS_HALF_RANGE_CODES, Config
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
from optodrive.link.protocol.dac_codes import BipolarDac

DAC = BipolarDac(12)
LEVEL_MAX = 255
TICKS_PER_US = CLOCK_HZ // 1_000_000
TRAILING_POINTS = 2
"""Dark points after a plan: one ends its last frame, the other lets that be a point shorter."""


@dataclass(frozen=True)
class PointScale:
    """How SI becomes codes, levels and points. points_per_s: as asked for; the board's own rate is a little lower."""

    rad_per_code: float
    full_power_w: float
    points_per_s: int

    @classmethod
    def from_config(cls, config: Config) -> "PointScale":
        """Codes span the scanner's whole range, level 255 is the laser's full power."""
        rad_per_code = config.scanner.range_rad / HELIOS_HALF_RANGE_CODES
        return cls(rad_per_code, config.laser.max_power_w, config.board.points_per_s)

    @property
    def point_s(self) -> float:
        """The time from one point to the next as the board keeps it, s."""
        return point_ticks(self.points_per_s) / CLOCK_HZ

    def to_codes(self, angle_rad: FloatArray) -> IntArray:
        """Mirror angle to codes; LocalProtocolError beyond the converter's range. Any shape."""
        return DAC.to_codes(angle_rad, self.rad_per_code)

    def to_angles_rad(self, codes: IntArray) -> FloatArray:
        """Codes to mirror angle, rad. Any shape."""
        return DAC.to_angles_rad(codes, self.rad_per_code)


@dataclass(frozen=True, eq=False)
class PointPulses:
    """Pulses read back from frames, times from the first point, without holes between frames; all [n].

    A pulse that a frame's end cuts is two.
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
    """Frames for a plan; power is rounded down, each frame ends dark, within a pulse if there is no other place."""
    points = _encode_points(plan, scale)
    return tuple(
        HeliosFrame.from_points(points[first:last], scale.points_per_s) for first, last in _split_frames(points, scale)
    )


def _encode_points(plan: LimitedPlan, scale: PointScale) -> PointTable:
    """All points of a plan, [n, 7]: the first begins with the plan."""
    ticks = point_ticks(scale.points_per_s)
    start = np.rint(plan.start_s * 1e6).astype(np.int64) * TICKS_PER_US
    end = start + np.rint(plan.width_s * 1e6).astype(np.int64) * TICKS_PER_US
    if len(plan) and (start[0] < 0 or (start[1:] < end[:-1]).any()):
        raise LocalProtocolError("pulses overlap, or the first begins before the plan")
    level = np.floor(plan.power_w / scale.full_power_w * LEVEL_MAX * (1 + 1e-12)).astype(np.int64)
    if len(plan) and not 0 <= level.min() <= level.max() <= LEVEL_MAX:
        raise LocalProtocolError(f"levels {level.min()} to {level.max()} leave the range 0 to {LEVEL_MAX}")
    first, last = -(-start // ticks), end // ticks
    last[:-1] -= last[:-1] == first[1:]  # a dark point between any two, by which they are told apart
    emitting = (level > 0) & (last > first)  # the mirrors do not go where there is no light
    first, last, level = first[emitting], last[emitting], level[emitting]
    x, y = scale.to_codes(plan.x_rad[emitting]), scale.to_codes(plan.y_rad[emitting])
    before = np.concatenate([[0], last[:-1]])[: len(last)]
    run_lengths = np.column_stack([first - before, last - first]).ravel()
    tail = [TRAILING_POINTS]
    levels = np.repeat(
        np.append(np.column_stack([np.zeros_like(level), level]).ravel(), 0), np.append(run_lengths, tail)
    )
    dwell_points = np.append(last - before, tail)
    x, y = (np.repeat(np.append(codes, codes[-1:] if len(codes) else DAC.centre), dwell_points) for codes in (x, y))
    return _pack_points(x, y, levels)


def _pack_points(x: IntArray, y: IntArray, level: IntArray) -> PointTable:
    points = np.empty((len(level), POINT_BYTES), dtype=np.uint8)
    points[:, 0] = x >> 4
    points[:, 1] = (x & 15) << 4 | y >> 8
    points[:, 2] = y & 255
    points[:, 3:] = level[:, None]
    return points


def _split_frames(points: PointTable, scale: PointScale) -> Iterator[tuple[int, int]]:
    """Where frames begin and end; a point that ends a frame within a pulse is darkened."""
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
    """The latest end of a frame after a dark point, in the later half of what it may hold; None without one."""
    min_end = first + (longest - first) // 2
    for last in (min_end + 1 + np.flatnonzero(points[min_end:longest, 6] == 0))[::-1].tolist():
        if not is_whole_packets(last - first):
            return int(last)
    return None


def decode(frames: Sequence[bytes], scale: PointScale) -> PointPulses:
    """Read pulses back from the bytes of frames in order; the brightest channel counts. LocalProtocolError if bad."""
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
