"""The messages: one frozen dataclass each, fields in wire order. PROTOCOL.md says what they mean.

firmware_protocol/messages.toml states the same once more, independently; a test holds the two together.
"""

import struct
from dataclasses import dataclass, fields
from typing import Any, ClassVar, Self

from optodrive.core.errors import RemoteProtocolError

MAJOR = 1
MINOR = 0

STATES = ("BOOT", "DISARMED", "ARMING", "ARMED", "RUNNING", "HOLD", "FAULT")
FAULTS = (
    "",
    "LINK",
    "RANGE",
    "ON_TIME",
    "DUTY",
    "MEAN_POWER",
    "SPOT",
    "UNDERRUN",
    "INTERLOCK",
    "KEY",
    "ESTOP",
    "TICK",
    "READBACK",
)
NAK_REASONS = ("SEQUENCE", "NO_ROOM", "STATE", "INDEX", "NONCE", "KEY_EDGE", "INPUT", "VERSION")
NOT_CONSUMED = ("SEQUENCE", "NO_ROOM")
"""Refusals after which the same frame is sent again; after the others it counts as taken and refused."""
EVENT_REASONS = (
    "",
    "boot",
    "hello",
    "arm requested",
    "armed",
    "start",
    "job done",
    "queue empty",
    "refilled",
    "hold too long",
    "disarm",
    "abort",
    "link lost",
    "arming timed out",
    "fault",
    "fault cleared",
    "flush",
)
INPUTS = ("interlock", "key", "estop")

POINT = struct.Struct("<HHHHH")
"""x, y, dark_us, on_us, duty."""
POINTS_MAX = 24
RECORD = struct.Struct("<IHH")
"""Offset of gate on from base_tick in ticks, gate-on ticks, duty."""
RECORDS_MAX = 28


class Message:
    """A message; TYPE and LAYOUT are the class's, SEQUENCED says whether it goes through the go-back-N window.

    ENUMS: fields that hold an index into names; an index beyond them is no message.
    """

    TYPE: ClassVar[int]
    LAYOUT: ClassVar[struct.Struct]
    SEQUENCED: ClassVar[bool] = False
    ENUMS: ClassVar[dict[str, tuple[str, ...]]] = {}

    def encode_body(self) -> bytes:
        """The body's bytes."""
        return self.LAYOUT.pack(*(getattr(self, item.name) for item in fields(self)))  # type: ignore[arg-type]

    @classmethod
    def parse(cls, body: bytes) -> Self:
        """A message from its body; RemoteProtocolError where the length is wrong."""
        if len(body) != cls.LAYOUT.size:
            raise RemoteProtocolError(f"{cls.__name__}: {len(body)} bytes of body, expected {cls.LAYOUT.size}")
        return cls(*cls.LAYOUT.unpack(body))


@dataclass(frozen=True)
class Hello(Message):
    """Begin a session: whatever went on, ends."""

    TYPE, LAYOUT = 0x01, struct.Struct("<BBI")
    major: int
    minor: int
    host_nonce: int


@dataclass(frozen=True)
class Limits(Message):
    """Limits, the board's own in HELLO_REPLY, or those a host asks it to tighten to."""

    TYPE, LAYOUT, SEQUENCED = 0x02, struct.Struct("<HHHIIIHHHHHHHH"), True
    max_on_us: int
    max_duty: int
    mean_duty: int
    spot_uj: int
    spot_leak_uw: int
    full_power_uw: int
    x_min: int
    x_max: int
    y_min: int
    y_max: int
    settle_us: int
    settle_ns_per_code: int
    rest_us: int
    lease_ms: int


@dataclass(frozen=True)
class HelloReply(Message):
    """Who the board is and what it allows."""

    TYPE = 0x81
    LAYOUT = struct.Struct("<BBIHI12sIIHHHB")
    major: int
    minor: int
    host_nonce: int
    session: int
    firmware: int
    uid: bytes
    capabilities: int
    tick_hz: int
    queue_points: int
    rx_window: int
    cell_codes: int
    reset_cause: int
    limits: Limits

    def encode_body(self) -> bytes:
        """The body's bytes."""
        values = [getattr(self, item.name) for item in fields(self)[:-1]]
        return self.LAYOUT.pack(*values) + self.limits.encode_body()

    @classmethod
    def parse(cls, body: bytes) -> Self:
        """A message from its body."""
        fixed_part, rest = body[: cls.LAYOUT.size], body[cls.LAYOUT.size :]
        if len(fixed_part) != cls.LAYOUT.size:
            raise RemoteProtocolError(f"{cls.__name__}: {len(body)} bytes of body")
        values: tuple[Any, ...] = (*cls.LAYOUT.unpack(fixed_part), Limits.parse(rest))
        return cls(*values)


@dataclass(frozen=True)
class Clock(Message):
    """Ask what the board's clock reads."""

    TYPE, LAYOUT = 0x03, struct.Struct("<I")
    host_t: int


@dataclass(frozen=True)
class ClockReply(Message):
    """The tick at which the question was taken in."""

    TYPE, LAYOUT = 0x83, struct.Struct("<IQ")
    host_t: int
    tick: int


@dataclass(frozen=True)
class Lease(Message):
    """Permit to emit for another ms milliseconds."""

    TYPE, LAYOUT = 0x04, struct.Struct("<H")
    ms: int


@dataclass(frozen=True)
class Data(Message):
    """Points to queue."""

    TYPE, SEQUENCED = 0x10, True
    LAYOUT = struct.Struct("<I")
    first_index: int
    points: bytes

    def encode_body(self) -> bytes:
        """The body's bytes."""
        return self.LAYOUT.pack(self.first_index) + self.points

    @classmethod
    def parse(cls, body: bytes) -> Self:
        """A message from its body."""
        points = body[cls.LAYOUT.size :]
        if not points or len(points) % POINT.size:
            raise RemoteProtocolError(f"{cls.__name__}: {len(points)} bytes are no whole points")
        (first_index,) = cls.LAYOUT.unpack(body[: cls.LAYOUT.size])
        return cls(first_index, points)


@dataclass(frozen=True)
class Start(Message):
    """Execute from first_index at start_tick, or at once where that is past, with watermark points queued."""

    TYPE, LAYOUT, SEQUENCED = 0x11, struct.Struct("<IIQH"), True
    job: int
    first_index: int
    start_tick: int
    watermark: int


@dataclass(frozen=True)
class End(Message):
    """The job's last point is the one before end_index."""

    TYPE, LAYOUT, SEQUENCED = 0x12, struct.Struct("<II"), True
    job: int
    end_index: int


@dataclass(frozen=True)
class Abort(Message):
    """Gate off, queue dropped, DISARMED; in any session, at once."""

    TYPE, LAYOUT = 0x13, struct.Struct("<")


@dataclass(frozen=True)
class ArmReq(Message):
    """Begin to arm."""

    TYPE, LAYOUT, SEQUENCED = 0x14, struct.Struct("<I"), True
    host_nonce: int


@dataclass(frozen=True)
class ArmChallenge(Message):
    """A nonce to be sent back once."""

    TYPE, LAYOUT = 0x94, struct.Struct("<II")
    host_nonce: int
    board_nonce: int


@dataclass(frozen=True)
class ArmConfirm(Message):
    """The nonces of the challenge."""

    TYPE, LAYOUT, SEQUENCED = 0x15, struct.Struct("<II"), True
    host_nonce: int
    board_nonce: int


@dataclass(frozen=True)
class Disarm(Message):
    """Gate off, queue dropped, DISARMED."""

    TYPE, LAYOUT, SEQUENCED = 0x16, struct.Struct("<"), True


@dataclass(frozen=True)
class ClearFault(Message):
    """Acknowledge a fault whose cause is gone; leads to DISARMED only."""

    TYPE, LAYOUT, SEQUENCED = 0x17, struct.Struct("<"), True


@dataclass(frozen=True)
class Get(Message):
    """Ask for STATUS."""

    TYPE, LAYOUT = 0x18, struct.Struct("<")


@dataclass(frozen=True)
class Flush(Message):
    """Gate off, queue dropped, ARMED."""

    TYPE, LAYOUT, SEQUENCED = 0x19, struct.Struct("<"), True


@dataclass(frozen=True)
class GetExecuted(Message):
    """Ask for the executed records from first_index again."""

    TYPE, LAYOUT = 0x1A, struct.Struct("<I")
    first_index: int


@dataclass(frozen=True)
class Ack(Message):
    """Everything before next_seq was taken."""

    TYPE, LAYOUT, ENUMS = 0x90, struct.Struct("<BHIB"), {"state": STATES}
    next_seq: int
    free_points: int
    done_index: int
    state: int


@dataclass(frozen=True)
class Nak(Message):
    """A frame was not taken, or taken and refused; next_seq as in ACK."""

    TYPE, LAYOUT, ENUMS = 0x91, struct.Struct("<BB"), {"reason": NAK_REASONS}
    next_seq: int
    reason: int


@dataclass(frozen=True)
class Event(Message):
    """The state changed."""

    TYPE, LAYOUT = 0x92, struct.Struct("<BBBQ")
    ENUMS: ClassVar = {"state": STATES, "fault": FAULTS, "reason": EVENT_REASONS}
    state: int
    fault: int
    reason: int
    tick: int


@dataclass(frozen=True)
class Status(Message):
    """How the board is."""

    TYPE, LAYOUT = 0x98, struct.Struct("<BBBQIHHHHHQh")
    ENUMS: ClassVar = {"state": STATES, "fault": FAULTS}
    state: int
    fault: int
    inputs: int
    tick: int
    done_index: int
    queued: int
    crc_errors: int
    format_errors: int
    seq_errors: int
    underruns: int
    laser_on_us: int
    temperature_dc: int


@dataclass(frozen=True)
class Executed(Message):
    """What was done to the points from first_index on: (tick of gate on, gate-on ticks, duty)."""

    TYPE = 0x99
    LAYOUT = struct.Struct("<IQ")
    first_index: int
    records: tuple[tuple[int, int, int], ...]

    def encode_body(self) -> bytes:
        """The body's bytes; offsets count from the first record's tick."""
        base = self.records[0][0]
        packed = (RECORD.pack(on_tick - base, on_ticks, duty) for on_tick, on_ticks, duty in self.records)
        return self.LAYOUT.pack(self.first_index, base) + b"".join(packed)

    @classmethod
    def parse(cls, body: bytes) -> Self:
        """A message from its body."""
        fixed_part, rest = body[: cls.LAYOUT.size], body[cls.LAYOUT.size :]
        if (
            len(fixed_part) != cls.LAYOUT.size
            or len(rest) % RECORD.size
            or not 1 <= len(rest) // RECORD.size <= RECORDS_MAX
        ):
            raise RemoteProtocolError(f"{cls.__name__}: {len(body)} bytes are not 1 to {RECORDS_MAX} whole records")
        first_index, base = cls.LAYOUT.unpack(fixed_part)
        records = tuple((base + offset, on, duty) for offset, on, duty in RECORD.iter_unpack(rest))
        return cls(first_index, records)


HOST_MESSAGES: tuple[type[Message], ...] = (
    Hello,
    Limits,
    Clock,
    Lease,
    Data,
    Start,
    End,
    Abort,
    ArmReq,
    ArmConfirm,
    Disarm,
    ClearFault,
    Get,
    Flush,
    GetExecuted,
)
BOARD_MESSAGES: tuple[type[Message], ...] = (
    HelloReply,
    ClockReply,
    ArmChallenge,
    Ack,
    Nak,
    Event,
    Status,
    Executed,
)
MESSAGES_BY_TYPE: dict[int, type[Message]] = {kind.TYPE: kind for kind in HOST_MESSAGES + BOARD_MESSAGES}


def parse_message(type_id: int, body: bytes) -> Message:
    """A message from a frame's type and body; RemoteProtocolError for unknown types, lengths and enumerations."""
    message_class = MESSAGES_BY_TYPE.get(type_id)
    if message_class is None:
        raise RemoteProtocolError(f"unknown message type 0x{type_id:02x}")
    message = message_class.parse(body)
    for name, names in message_class.ENUMS.items():
        if getattr(message, name) >= len(names):
            raise RemoteProtocolError(f"{message_class.__name__}: {name} {getattr(message, name)} has no meaning")
    return message
