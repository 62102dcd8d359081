"""Frame format of the Helios DAC."""

import struct

import numpy as np

from optodrive.core.errors import LocalProtocolError
from optodrive.device.config_sections import DAC_POWER_STEPS
from optodrive.link.dac.formats.base import CHUNK_MAX_S, Chunk, DacFormat, PointTable

VENDOR_ID, PRODUCT_ID = 0x1209, 0xE500
POINT_BYTES = 7
TRAILER = struct.Struct("<HHB")
"""Points per second, number of points, flags."""
PLAY_ONCE = 2
RATE_MIN, RATE_MAX = 7, 65_535
PACKET_BYTES = 64


class HeliosFormat(DacFormat):
    """Frames of points of 7 bytes, each followed by rate, length and flags."""

    label = "Helios"
    level_max = DAC_POWER_STEPS["helios"]
    clock_hz = 112_000_000
    points_max = 4095
    host_loss_max_s = 2 * CHUNK_MAX_S
    """The playing frame and the queued one."""

    @property
    def point_ticks(self) -> int:
        """Duration of a point in clock ticks."""
        return self._count_ticks(self.points_per_s)

    def _count_ticks(self, points_per_s: int) -> int:
        return self.clock_hz // points_per_s + 1

    def accepts_length(self, points: int) -> bool:
        """Return False for whole USB packets, which stall the DAC because the transfer never ends."""
        return (points * POINT_BYTES + TRAILER.size) % PACKET_BYTES != 0

    def pack(self, points: PointTable, begin_ticks: int) -> bytes:
        """Return a frame that is played once."""
        x, y, level = points.T
        table = np.empty((len(points), POINT_BYTES), dtype=np.uint8)
        table[:, 0] = x >> 4
        table[:, 1] = (x & 15) << 4 | y >> 8
        table[:, 2] = y & 255
        table[:, 3:] = level[:, None]
        return table.tobytes() + TRAILER.pack(self.points_per_s, len(points), PLAY_ONCE)

    def parse(self, data: bytes) -> tuple[PointTable, int]:
        """Return points and ticks of a frame as the DAC reads them. Raise LocalProtocolError if inconsistent."""
        if len(data) < POINT_BYTES + TRAILER.size:
            raise LocalProtocolError(f"a frame of {len(data)} bytes holds no point")
        points_per_s, count, _ = TRAILER.unpack(data[-TRAILER.size :])
        if len(data) != count * POINT_BYTES + TRAILER.size or count > self.points_max:
            raise LocalProtocolError(f"a frame of {len(data)} bytes for {count} points, at most {self.points_max}")
        if not RATE_MIN <= points_per_s <= RATE_MAX:
            raise LocalProtocolError(f"a frame at {points_per_s} points/s, the DAC accepts {RATE_MIN} to {RATE_MAX}")
        table = np.frombuffer(data[: -TRAILER.size], dtype=np.uint8).reshape(-1, POINT_BYTES).astype(np.int64)
        x, y = table[:, 0] << 4 | table[:, 1] >> 4, (table[:, 1] & 15) << 8 | table[:, 2]
        return np.column_stack([x, y, table[:, 3:].max(axis=1)]), self._count_ticks(points_per_s)

    def check(self, data: bytes) -> Chunk:
        """Return the frame with these bytes. Raise LocalProtocolError if it could leave the laser on or stall it."""
        chunk = super().check(data)
        if data[-1] != PLAY_ONCE:
            raise LocalProtocolError(
                f"a frame with flags {data[-1]} instead of {PLAY_ONCE}: it must play once, after the previous one"
            )
        return chunk
