"""Frame format of the Helios DAC, and the rules that every transmitted frame obeys."""

import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from optodrive.core.errors import LocalProtocolError

CLOCK_HZ = 112_000_000
POINT_BYTES = 7
TRAILER = struct.Struct("<HHB")
"""Points per second, number of points, flags."""
PLAY_ONCE = 2
POINTS_MAX = 4095
RATE_MIN, RATE_MAX = 7, 65_535
PACKET_BYTES = 64
FRAME_MAX_S = 0.025
HOST_LOSS_EMISSION_MAX_S = 2 * FRAME_MAX_S
"""Maximum emission after the host stops sending: the playing frame and the queued one."""

PointTable = NDArray[np.uint8]


def point_ticks(points_per_s: int) -> int:
    """Return the duration of a point in clock ticks of the DAC at a requested rate."""
    return CLOCK_HZ // points_per_s + 1


def is_whole_packets(points: int) -> bool:
    """Return whether a frame fills whole USB packets, which stalls the DAC because the transfer never ends."""
    return (points * POINT_BYTES + TRAILER.size) % PACKET_BYTES == 0


@dataclass(frozen=True, eq=False)
class HeliosFrame:
    """Frame that is safe to send. from_bytes() validates it.

    data: bytes on the wire
    duration_s: playing time
    """

    data: bytes
    duration_s: float

    @classmethod
    def from_points(cls, points: PointTable, points_per_s: int) -> "HeliosFrame":
        """Build a frame of points [n, 7] that plays once."""
        return cls.from_bytes(points.tobytes() + TRAILER.pack(points_per_s, len(points), PLAY_ONCE))

    @classmethod
    def from_bytes(cls, data: bytes) -> "HeliosFrame":
        """Build a frame from its bytes. Raise LocalProtocolError if it could leave the laser on or stall the DAC."""
        table, points_per_s = parse_points(data)
        flags, duration_s = data[-1], len(table) * point_ticks(points_per_s) / CLOCK_HZ
        if flags != PLAY_ONCE:
            raise LocalProtocolError(
                f"a frame with flags {flags} instead of {PLAY_ONCE}: it must play once, after the previous one"
            )
        if table[-1, 3:].any():
            raise LocalProtocolError("a frame whose last point is not blank")
        if duration_s > FRAME_MAX_S:
            raise LocalProtocolError(f"a frame of {duration_s:.4f} s, the maximum is {FRAME_MAX_S:g} s")
        if is_whole_packets(len(table)):
            raise LocalProtocolError(f"a frame of {len(table)} points fills whole packets, on which the DAC stalls")
        return cls(data, duration_s)


def parse_points(data: bytes) -> tuple[PointTable, int]:
    """Return points [n, 7] and rate of a frame as the DAC reads them. Raise LocalProtocolError if inconsistent."""
    if len(data) < POINT_BYTES + TRAILER.size:
        raise LocalProtocolError(f"a frame of {len(data)} bytes holds no point")
    points_per_s, count, _ = TRAILER.unpack(data[-TRAILER.size :])
    if len(data) != count * POINT_BYTES + TRAILER.size or count > POINTS_MAX:
        raise LocalProtocolError(f"a frame of {len(data)} bytes for {count} points, at most {POINTS_MAX}")
    if not RATE_MIN <= points_per_s <= RATE_MAX:
        raise LocalProtocolError(f"a frame at {points_per_s} points/s, the DAC accepts {RATE_MIN} to {RATE_MAX}")
    return np.frombuffer(data[: -TRAILER.size], dtype=np.uint8).reshape(-1, POINT_BYTES), points_per_s
