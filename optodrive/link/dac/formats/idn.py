"""Bytes of the ILDA Digital Network: packets, scan, acknowledgement and wave chunks (DexLogic: idn-stream.h).

Theory of operation. An IDN device notices a dead host after one second, and what it puts out when it runs empty before
that is its own affair: it may hold the last sample. A chunk therefore never ends with light. Three more properties are
those of OpenIDN's server (Grix/helios_openidn), the only one whose source is public:

- It cuts what it receives into slices of 3,780 bytes, 210 of its own points, and plays whole slices. Chunks of exactly
  210 points become one slice each, so that each slice ends dark, and none waits for the next chunk. One also fits an
  Ethernet frame, so that IP does not fragment it.
- It keeps its buffer at 40 ms by playing up to 1.3 times slower or 1.25 times faster. Slower means more energy at the
  same level; levels are 1.3 times lower. Faster would shorten the mirrors' moves; it takes more than 40 ms of points,
  and the driver never sends further ahead than `LEAD_S`.
- A chunk with a time stamp before the end of the one that came last is dropped. Of two late ones in order the second
  may be played again, which only a network without duplicates prevents.
- Samples on a closed channel are dropped. The configuration that opens it is therefore not repeated with the samples:
  what is under way when the host stops emits nothing when it arrives.
"""

import struct

import numpy as np

from optodrive.core.errors import LocalProtocolError
from optodrive.device.config_sections import DAC_POWER_STEPS, IDN_STRETCH
from optodrive.link.dac.formats.base import DacFormat, PointTable

UDP_PORT = 7255
PACKET = struct.Struct(">BBH")
"""Command, flags with the client group, sequence."""
SCAN, SCAN_ANSWER = 0x10, 0x11
MESSAGE_ACKNOWLEDGED, CLOSE_ACKNOWLEDGED, ACKNOWLEDGEMENT = 0x41, 0x45, 0x47
SCAN_BODY = struct.Struct(">4B16s20s")
"""Size, protocol version, status, reserved, unit, host name."""
ACKNOWLEDGEMENT_BODY = struct.Struct(">BBH")
"""Size, result, flags; more may follow."""
ACCEPTED, NOT_CONNECTED, OCCUPIED, EXCLUDED = 0x00, 0xEB, 0xEC, 0xED
MALFUNCTION, OFFLINE = 0x80, 0x40
MESSAGE = struct.Struct(">HHI")
"""Size, content, time stamp in µs."""
WAVE_CONTENT, VOID_CONTENT = 0x8001, 0xC000
"""Samples on channel 0, and a configuration of channel 0 without samples."""
TAGS = (0x4200, 0x4010, 0x4210, 0x4010, 0x51CC, 0x5C10)
"""X and Y of 16 bits, blue and intensity of 8. Without the intensity OpenIDN drives its pin at full level."""
CONFIGURATION = struct.pack(">4B6H", len(TAGS) // 2, 0x01, 0, 0x01, *TAGS)
"""Routed to the default service, as a stream of samples."""
CLOSING = struct.pack(">4B", 0, 0x02, 0, 0)
CHANNEL_CLOSED = 0x2000
"""Flag of an acknowledgement: the samples came on a channel that is closed, and were dropped."""
CHUNK = struct.Struct(">I")
"""Flags and duration in µs."""
HEADER_BYTES = MESSAGE.size + CHUNK.size
SAMPLE = np.dtype([("x", ">i2"), ("y", ">i2"), ("blue", "u1"), ("intensity", "u1")])
CODE_STEP, CENTRE_CODE = 16, 2048
SLICE_POINTS = 210
LEAD_S = 0.025
"""How far ahead of the playing sample the host sends."""


class IdnFormat(DacFormat):
    """Channel messages with a wave chunk, whose duration is in whole µs."""

    label = "IDN device"
    level_max = DAC_POWER_STEPS["idn"]
    clock_hz = 1_000_000
    points_max = SLICE_POINTS
    host_loss_max_s = 0.13
    """The lead, and what a device that plays slower has fallen behind: twice its buffer of 40 ms, 1.3 times slower."""
    lag_max_s = host_loss_max_s
    stops_at_once = False
    fixed_length = True
    settling_points = 1

    @property
    def point_ticks(self) -> int:
        """Duration of a point in µs."""
        return -(-self.clock_hz // self.points_per_s)

    @property
    def stretch(self) -> float:
        """That of OpenIDN's server with an almost empty buffer."""
        return IDN_STRETCH

    def pack(self, points: PointTable, begin_ticks: int) -> bytes:
        """Return a channel message."""
        table = np.zeros(len(points), dtype=SAMPLE)
        table["x"], table["y"] = ((points[:, axis] - CENTRE_CODE) * CODE_STEP for axis in (0, 1))
        table["blue"] = table["intensity"] = points[:, 2]
        header = MESSAGE.pack(HEADER_BYTES + table.nbytes, WAVE_CONTENT, begin_ticks & 0xFFFFFFFF)
        return header + CHUNK.pack(len(points) * self.point_ticks) + table.tobytes()

    def parse(self, data: bytes) -> tuple[PointTable, int]:
        """Return points and ticks of a channel message. Raise LocalProtocolError if inconsistent."""
        samples = (len(data) - HEADER_BYTES) // SAMPLE.itemsize
        if samples < 1 or len(data) != HEADER_BYTES + samples * SAMPLE.itemsize:
            raise LocalProtocolError(f"a message of {len(data)} bytes holds no whole samples")
        size, content, _ = MESSAGE.unpack_from(data)
        if size != len(data) or content != WAVE_CONTENT:
            raise LocalProtocolError(f"a message of content {content:#06x} and size {size} in {len(data)} bytes")
        (duration,) = CHUNK.unpack_from(data, MESSAGE.size)
        if duration >> 24 or duration % samples or not duration:
            raise LocalProtocolError(f"a chunk of {samples} samples and duration {duration:#x} µs")
        table = np.frombuffer(data, dtype=SAMPLE, offset=HEADER_BYTES)
        x, y = (table[axis].astype(np.int64) // CODE_STEP + CENTRE_CODE for axis in "xy")
        level = np.maximum(table["blue"], table["intensity"]).astype(np.int64)
        return np.column_stack([x, y, level]), duration // samples


def decode_name(field: bytes) -> str:
    """Return the text of a field that is padded with zeros."""
    return field.split(b"\0")[0].decode("ascii", "replace")


def name_unit(unit: bytes) -> str:
    """Return the name of a unit by its field, whose first byte is a length."""
    return f"IDN {unit[1 : 1 + unit[0]].hex()}"


def build_configuration(configuration: bytes) -> bytes:
    """Return a channel message with a configuration and without samples."""
    return MESSAGE.pack(MESSAGE.size + len(configuration), VOID_CONTENT, 0) + configuration
