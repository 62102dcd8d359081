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
from optodrive.device.config import HELIOS_CODES_A_SIDE, Config
from optodrive.link.helios.frames import (
    CLOCK_HZ,
    FRAME_MAX_S,
    POINT_BYTES,
    POINTS_MAX,
    HeliosFrame,
    Table,
    fills_packets,
    point_ticks,
    points_of,
)
from optodrive.link.protocol.dac_codes import Converter

DAC = Converter(12)
LEVEL_MAX = 255
TICKS_PER_US = CLOCK_HZ // 1_000_000
TAIL = 2
"""Dark points after a plan: one ends its last frame, the other lets that be a point shorter."""


@dataclass(frozen=True)
class PointScale:
    """How SI becomes codes, levels and points. points_per_s: as asked for; the board's own rate is a little lower."""

    rad_per_code: float
    full_power_w: float
    points_per_s: int

    @classmethod
    def of(cls, config: Config) -> "PointScale":
        """Codes span the scanner's whole range, level 255 is the laser's full power."""
        rad_per_code = config.scanner.range_rad / HELIOS_CODES_A_SIDE
        return cls(rad_per_code, config.laser.max_power_w, config.board.points_per_s)

    @property
    def point_s(self) -> float:
        """The time from one point to the next as the board keeps it, s."""
        return point_ticks(self.points_per_s) / CLOCK_HZ

    def codes(self, angle_rad: FloatArray) -> IntArray:
        """Mirror angle to codes; LocalProtocolError beyond the converter's range. Any shape."""
        return DAC.codes(angle_rad, self.rad_per_code)

    def angles(self, codes: IntArray) -> FloatArray:
        """Codes to mirror angle, rad. Any shape."""
        return DAC.angles(codes, self.rad_per_code)


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
    points = _points(plan, scale)
    return tuple(HeliosFrame.of(points[first:last], scale.points_per_s) for first, last in _cut(points, scale))


def _points(plan: LimitedPlan, scale: PointScale) -> Table:
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
    lit = (level > 0) & (last > first)  # the mirrors do not go where there is no light
    first, last, level = first[lit], last[lit], level[lit]
    x, y = scale.codes(plan.x_rad[lit]), scale.codes(plan.y_rad[lit])
    before = np.concatenate([[0], last[:-1]])[: len(last)]
    pairs = np.column_stack([first - before, last - first]).ravel()
    tail = [TAIL]
    levels = np.repeat(np.append(np.column_stack([np.zeros_like(level), level]).ravel(), 0), np.append(pairs, tail))
    stays = np.append(last - before, tail)
    x, y = (np.repeat(np.append(codes, codes[-1:] if len(codes) else DAC.centre), stays) for codes in (x, y))
    return _packed(x, y, levels)


def _packed(x: IntArray, y: IntArray, level: IntArray) -> Table:
    points = np.empty((len(level), POINT_BYTES), dtype=np.uint8)
    points[:, 0] = x >> 4
    points[:, 1] = (x & 15) << 4 | y >> 8
    points[:, 2] = y & 255
    points[:, 3:] = level[:, None]
    return points


def _cut(points: Table, scale: PointScale) -> Iterator[tuple[int, int]]:
    """Where frames begin and end; a point that ends a frame within a pulse is darkened."""
    most, first = min(POINTS_MAX, int(FRAME_MAX_S / scale.point_s)), 0
    while first < len(points):
        longest = min(first + most, len(points))
        last = _dark_end(points, first, longest)
        if last is None:
            last = longest - 1 if fills_packets(longest - first) else longest
            points[last - 1, 3:] = 0
        yield first, last
        first = last


def _dark_end(points: Table, first: int, longest: int) -> int | None:
    """The latest end of a frame after a dark point, in the later half of what it may hold; None without one."""
    least = first + (longest - first) // 2
    for last in (least + 1 + np.flatnonzero(points[least:longest, 6] == 0))[::-1].tolist():
        if not fills_packets(last - first):
            return int(last)
    return None


def decode(frames: Sequence[bytes], scale: PointScale) -> PointPulses:
    """Read pulses back from the bytes of frames in order; the brightest channel counts. LocalProtocolError if bad."""
    tables, ticks = [], []
    for data in frames:
        table, points_per_s = points_of(data)
        tables.append(table)
        ticks.append(np.full(len(table), point_ticks(points_per_s), dtype=np.int64))
    points = np.concatenate([*tables, np.zeros((1, POINT_BYTES), dtype=np.uint8)]).astype(np.int64)
    begins = np.concatenate([[0], np.cumsum(np.concatenate([*ticks, np.zeros(1, dtype=np.int64)]))[:-1]])
    x, y = points[:, 0] << 4 | points[:, 1] >> 4, (points[:, 1] & 15) << 8 | points[:, 2]
    level = points[:, 3:].max(axis=1)
    changes = np.flatnonzero((np.diff(x) != 0) | (np.diff(y) != 0) | (np.diff(level) != 0)) + 1
    heads = np.concatenate([[0], changes])
    ends = np.append(changes, len(points) - 1)
    lit = level[heads] > 0
    heads, ends = heads[lit], ends[lit]
    return PointPulses(
        start_s=begins[heads] / CLOCK_HZ,
        width_s=(begins[ends] - begins[heads]) / CLOCK_HZ,
        x_rad=scale.angles(x[heads]),
        y_rad=scale.angles(y[heads]),
        power_w=level[heads] / LEVEL_MAX * scale.full_power_w,
    )
