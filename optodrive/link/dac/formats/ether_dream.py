"""Bytes of the Ether Dream protocol: commands, points and status (j4cbo/j4cDAC: common/protocol.h)."""

import struct
from dataclasses import dataclass

import numpy as np

from optodrive.core.errors import LocalProtocolError
from optodrive.device.config_sections import DAC_POWER_STEPS, ETHER_DREAM_CLOCK_HZ
from optodrive.link.dac.formats.base import CHUNK_MAX_S, DacFormat, PointTable

TCP_PORT, BROADCAST_PORT = 7765, 7654
PREPARE, BEGIN, DATA, STOP, CLEAR, PING = b"p", b"b", b"d", b"s", b"c", b"?"
ACCEPTED, FULL, INVALID, STOPPED = b"a", b"F", b"I", b"!"
BEGIN_BODY = struct.Struct("<HI")
"""Low-water mark, which no firmware uses, and points per second."""
DATA_HEADER = struct.Struct("<cH")
POINT = np.dtype([(name, "<i2" if name in "xy" else "<u2") for name in ("control", "x", "y", *"rgbi", "u1", "u2")])
COLOURS = ("r", "g", "b", "i")
"""Channels that carry the level. Documents differ in the order of these four fields, which therefore are equal."""
CODE_STEP = LEVEL_STEP = 16
"""The first hardware drops the last four of 16 bits."""
CENTRE_CODE = 2048
STATUS = struct.Struct("<4B4H2I")
ANSWER_BYTES = 2 + STATUS.size
BROADCAST = struct.Struct("<6s3HI")
"""Hardware address, revisions of hardware and software, buffer capacity, largest rate; a status follows."""
READY_ENGINE, EMERGENCY_STOP = 0, 3
IDLE, PREPARED, PLAYING = 0, 1, 2
ESTOP_BY_PACKET, ESTOP_BY_LINK = 1, 32
CAPACITY_MIN = 1799
"""Points in the buffer of the first hardware."""


@dataclass(frozen=True)
class Status:
    """State of an Ether Dream.

    engine, engine_flags: of the light engine, and why it is in an emergency stop
    playback: IDLE, PREPARED or PLAYING
    fullness: points in the buffer
    points: points played since the last begin
    """

    engine: int
    engine_flags: int
    playback: int
    fullness: int
    points: int

    @classmethod
    def from_bytes(cls, data: bytes) -> "Status":
        """Parse a status of 20 bytes."""
        _, engine, playback, _, engine_flags, _, _, fullness, _, points = STATUS.unpack(data)
        return cls(engine, engine_flags, playback, fullness, points)


class EtherDreamFormat(DacFormat):
    """Data commands, whose points have the rate of the last begin."""

    label = "Ether Dream"
    level_max = DAC_POWER_STEPS["ether_dream"]
    clock_hz = ETHER_DREAM_CLOCK_HZ
    points_max = CAPACITY_MIN // 2
    host_loss_max_s = 2 * CHUNK_MAX_S
    """The buffer holds two chunks at most, and the device stops when it is empty."""
    lag_max_s = CHUNK_MAX_S

    @property
    def point_ticks(self) -> int:
        """Duration of a point in ticks of the first hardware's counter."""
        return self.clock_hz // self.points_per_s

    @property
    def slowest_point_s(self) -> float:
        """Duration with the tick that some count more."""
        return super().slowest_point_s * self.stretch

    @property
    def stretch(self) -> float:
        """One tick more: sources differ in whether the counter includes its last value."""
        return 1.0 + 1.0 / self.point_ticks

    def pack(self, points: PointTable, begin_ticks: int) -> bytes:
        """Return a data command."""
        table = np.zeros(len(points), dtype=POINT)
        table["x"], table["y"] = ((points[:, axis] - CENTRE_CODE) * CODE_STEP for axis in (0, 1))
        for colour in COLOURS:
            table[colour] = points[:, 2] * LEVEL_STEP
        return DATA_HEADER.pack(DATA, len(points)) + table.tobytes()

    def parse(self, data: bytes) -> tuple[PointTable, int]:
        """Return points and ticks of a data command. Raise LocalProtocolError if inconsistent."""
        if len(data) < DATA_HEADER.size + POINT.itemsize:
            raise LocalProtocolError(f"a command of {len(data)} bytes holds no point")
        command, count = DATA_HEADER.unpack_from(data)
        if command != DATA or len(data) != DATA_HEADER.size + count * POINT.itemsize:
            raise LocalProtocolError(f"a command {command!r} of {len(data)} bytes for {count} points")
        table = np.frombuffer(data, dtype=POINT, offset=DATA_HEADER.size)
        if table["control"].any() or table["u1"].any() or table["u2"].any():
            raise LocalProtocolError("a point that changes the rate or drives a user channel")
        x, y = (table[axis].astype(np.int64) // CODE_STEP + CENTRE_CODE for axis in "xy")
        strongest = np.max([table[colour] for colour in COLOURS], axis=0).astype(np.int64)
        return np.column_stack([x, y, -(-strongest // LEVEL_STEP)]), self.point_ticks
