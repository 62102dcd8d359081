"""Messages between host and board, one frozen dataclass each with its fields in wire order.

PROTOCOL.md is the specification. firmware_protocol/messages.toml states the same fields independently, for code
generators; a test compares the two.
"""

import struct
from collections.abc import Mapping
from dataclasses import dataclass, fields
from types import MappingProxyType
from typing import Any, ClassVar, Self

from optodrive.core.errors import RemoteProtocolError
from optodrive.link.protocol.states import BoardState, EventReason

MAJOR = 1
MINOR = 1

STATES = tuple(BoardState)
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
    "CELLS",
    "PULSES",
    "HEAD",
    "SCAN",
)
NAK_REASONS = ("SEQUENCE", "NO_ROOM", "STATE", "INDEX", "NONCE", "KEY_EDGE", "INPUT", "VERSION")
NOT_CONSUMED = ("SEQUENCE", "NO_ROOM")
"""NAK reasons after which the host resends the same frame. Any other reason consumes the frame's sequence number."""
EVENT_REASONS = tuple(EventReason)
INPUTS = ("interlock", "key", "estop")
CAPABILITY_KEY_EDGE, CAPABILITY_XY2_100, CAPABILITY_EXACT_WIDTHS, CAPABILITY_FEEDBACK = 1, 2, 4, 8
HEAD_BITS = {0x8000: "power", 0x4000: "temperature"}
"""Bits of a ready scan head's status, and what is in order then."""

POINT = struct.Struct("<HHHHH")
"""x, y (DAC codes), dark_us (gate off before the pulse), on_us (gate on), duty (1/65535)."""
POINTS_MAX = 24
RECORD = struct.Struct("<IHH")
"""Offset of gate on from base_tick, gate-on time (both ticks), duty (1/65535)."""
RECORDS_MAX = 28


BOARD_TYPE = 0x80
"""Smallest type of a message of the board."""
MESSAGES_BY_TYPE: "dict[int, type[Message]]" = {}


class Message:
    """Base class of all messages. A subclass states its class variables where it is defined, and its fields.

    NAME: message name in PROTOCOL.md
    TYPE: type byte in the frame header, from BOARD_TYPE on for those of the board
    LAYOUT: struct of the fixed-size part of the body
    SEQUENCED: whether the message passes through the go-back-N window
    ENUMS: names for each field that holds an index; a body whose index has no name is rejected
    """

    NAME: ClassVar[str]
    TYPE: ClassVar[int]
    LAYOUT: ClassVar[struct.Struct]
    SEQUENCED: ClassVar[bool]
    ENUMS: ClassVar[Mapping[str, tuple[str, ...]]]

    def __init_subclass__(
        cls,
        name: str,
        type_id: int,
        layout: str,
        sequenced: bool = False,
        enums: Mapping[str, tuple[str, ...]] = MappingProxyType({}),
    ) -> None:
        cls.NAME, cls.TYPE, cls.LAYOUT = name, type_id, struct.Struct(layout)
        cls.SEQUENCED, cls.ENUMS = sequenced, enums
        MESSAGES_BY_TYPE[type_id] = cls

    def encode_body(self) -> bytes:
        """Return the body as bytes."""
        return self.LAYOUT.pack(*(getattr(self, item.name) for item in fields(self)))  # type: ignore[arg-type]

    @classmethod
    def parse(cls, body: bytes) -> Self:
        """Parse a body. Raise RemoteProtocolError if its length is wrong."""
        if len(body) != cls.LAYOUT.size:
            raise RemoteProtocolError(f"{cls.NAME}: {len(body)} bytes of body, expected {cls.LAYOUT.size}")
        return cls(*cls.LAYOUT.unpack(body))


@dataclass(frozen=True)
class Hello(Message, name="HELLO", type_id=0x01, layout="<BBI"):
    """Begin a new session. The board aborts the current one."""

    major: int
    minor: int
    host_nonce: int


@dataclass(frozen=True)
class Limits(Message, name="LIMITS", type_id=0x02, layout="<HHHIIIHHHHHHHH", sequenced=True):
    """Safety limits: the board's own in HELLO_REPLY, or the tighter ones that a host requests."""

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
class HelloReply(Message, name="HELLO_REPLY", type_id=0x81, layout="<BBIHI12sIIHHHHHB"):
    """Identity, capabilities and limits of the board, in answer to HELLO."""

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
    cells: int
    window_pulses: int
    reset_cause: int
    limits: Limits

    def encode_body(self) -> bytes:
        """Return the body as bytes."""
        values = [getattr(self, item.name) for item in fields(self)[:-1]]
        return self.LAYOUT.pack(*values) + self.limits.encode_body()

    @classmethod
    def parse(cls, body: bytes) -> Self:
        """Parse a body. Raise RemoteProtocolError if its length is wrong."""
        fixed_part, rest = body[: cls.LAYOUT.size], body[cls.LAYOUT.size :]
        if len(fixed_part) != cls.LAYOUT.size:
            raise RemoteProtocolError(f"{cls.NAME}: {len(body)} bytes of body")
        values: tuple[Any, ...] = (*cls.LAYOUT.unpack(fixed_part), Limits.parse(rest))
        return cls(*values)


@dataclass(frozen=True)
class ClockRequest(Message, name="CLOCK", type_id=0x03, layout="<I"):
    """Request the board's clock."""

    host_t: int


@dataclass(frozen=True)
class ClockReply(Message, name="CLOCK_REPLY", type_id=0x83, layout="<IQ"):
    """Board tick at which the board received CLOCK."""

    host_t: int
    tick: int


@dataclass(frozen=True)
class Lease(Message, name="LEASE", type_id=0x04, layout="<H"):
    """Permit the board to emit for another `ms` milliseconds."""

    ms: int


@dataclass(frozen=True)
class Data(Message, name="DATA", type_id=0x10, layout="<I", sequenced=True):
    """Append points to the board's queue."""

    first_index: int
    points: bytes

    def encode_body(self) -> bytes:
        """Return the body as bytes."""
        return self.LAYOUT.pack(self.first_index) + self.points

    @classmethod
    def parse(cls, body: bytes) -> Self:
        """Parse a body. Raise RemoteProtocolError if its length is wrong."""
        points = body[cls.LAYOUT.size :]
        if not points or len(points) % POINT.size:
            raise RemoteProtocolError(f"{cls.NAME}: {len(points)} bytes are not a whole number of points")
        (first_index,) = cls.LAYOUT.unpack(body[: cls.LAYOUT.size])
        return cls(first_index, points)


@dataclass(frozen=True)
class Start(Message, name="START", type_id=0x11, layout="<IIQH", sequenced=True):
    """Start a job at start_tick, or immediately if that tick has passed.

    first_index: index of the job's first point
    watermark: number of points that the board must have queued before it starts
    """

    job: int
    first_index: int
    start_tick: int
    watermark: int


@dataclass(frozen=True)
class End(Message, name="END", type_id=0x12, layout="<II", sequenced=True):
    """End a job: its last point is the one before end_index."""

    job: int
    end_index: int


@dataclass(frozen=True)
class Abort(Message, name="ABORT", type_id=0x13, layout="<"):
    """Turn the gate off, drop the queue and go to DISARMED. The board accepts it in any session."""


@dataclass(frozen=True)
class ArmReq(Message, name="ARM_REQ", type_id=0x14, layout="<I", sequenced=True):
    """Request arming. The board answers with ARM_CHALLENGE."""

    host_nonce: int


@dataclass(frozen=True)
class ArmChallenge(Message, name="ARM_CHALLENGE", type_id=0x94, layout="<II"):
    """Nonce that the host must return once, in ARM_CONFIRM."""

    host_nonce: int
    board_nonce: int


@dataclass(frozen=True)
class ArmConfirm(Message, name="ARM_CONFIRM", type_id=0x15, layout="<II", sequenced=True):
    """Confirm arming with both nonces of the challenge."""

    host_nonce: int
    board_nonce: int


@dataclass(frozen=True)
class Disarm(Message, name="DISARM", type_id=0x16, layout="<", sequenced=True):
    """Turn the gate off, drop the queue and go to DISARMED."""


@dataclass(frozen=True)
class ClearFault(Message, name="CLEAR_FAULT", type_id=0x17, layout="<", sequenced=True):
    """Acknowledge a fault whose cause is gone. The board goes to DISARMED."""


@dataclass(frozen=True)
class Get(Message, name="GET", type_id=0x18, layout="<"):
    """Request STATUS."""


@dataclass(frozen=True)
class Flush(Message, name="FLUSH", type_id=0x19, layout="<", sequenced=True):
    """Turn the gate off, drop the queue and go to ARMED."""


@dataclass(frozen=True)
class GetExecuted(Message, name="GET_EXECUTED", type_id=0x1A, layout="<I"):
    """Request the executed records from first_index again."""

    first_index: int


@dataclass(frozen=True)
class StartOnTrigger(Message, name="START_ON_TRIGGER", type_id=0x1B, layout="<IIIH", sequenced=True):
    """Start a job delay_us after the next edge at the trigger input. Without one within wait_ms, the board disarms.

    first_index: index of the job's first point, which must be queued
    """

    job: int
    first_index: int
    delay_us: int
    wait_ms: int


@dataclass(frozen=True)
class GetTriggers(Message, name="GET_TRIGGERS", type_id=0x1C, layout="<"):
    """Request TRIGGERS."""


@dataclass(frozen=True)
class Triggers(Message, name="TRIGGERS", type_id=0x9C, layout="<IQ"):
    """Report the edges at the trigger input since power-up, modulo 2^32, and the last one's tick, 0 without any."""

    count: int
    tick: int


@dataclass(frozen=True)
class Ack(Message, name="ACK", type_id=0x90, layout="<BHIB", enums={"state": STATES}):
    """Acknowledge every sequenced frame before next_seq."""

    next_seq: int
    free_points: int
    done_index: int
    state: int


@dataclass(frozen=True)
class Nak(Message, name="NAK", type_id=0x91, layout="<BB", enums={"reason": NAK_REASONS}):
    """Refuse a sequenced frame. next_seq acknowledges as in ACK."""

    next_seq: int
    reason: int


@dataclass(frozen=True)
class Event(
    Message,
    name="EVENT",
    type_id=0x92,
    layout="<BBBQ",
    enums={"state": STATES, "fault": FAULTS, "reason": EVENT_REASONS},
):
    """Report a change of state."""

    state: int
    fault: int
    reason: int
    tick: int


@dataclass(frozen=True)
class Status(Message, name="STATUS", type_id=0x98, layout="<BBBQIHHHHHQhHHH", enums={"state": STATES, "fault": FAULTS}):
    """Report state, inputs and counters of the board."""

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
    head: int
    mirror_x: int
    mirror_y: int


@dataclass(frozen=True)
class Executed(Message, name="EXECUTED", type_id=0x99, layout="<IQ"):
    """Report executed points from first_index on.

    records: (tick of gate on, gate-on time in ticks, duty) per point
    """

    first_index: int
    records: tuple[tuple[int, int, int], ...]

    def encode_body(self) -> bytes:
        """Return the body as bytes. Offsets count from the first record's tick."""
        base = self.records[0][0]
        packed = (RECORD.pack(on_tick - base, on_ticks, duty) for on_tick, on_ticks, duty in self.records)
        return self.LAYOUT.pack(self.first_index, base) + b"".join(packed)

    @classmethod
    def parse(cls, body: bytes) -> Self:
        """Parse a body. Raise RemoteProtocolError if its length is wrong."""
        fixed_part, rest = body[: cls.LAYOUT.size], body[cls.LAYOUT.size :]
        if (
            len(fixed_part) != cls.LAYOUT.size
            or len(rest) % RECORD.size
            or not 1 <= len(rest) // RECORD.size <= RECORDS_MAX
        ):
            raise RemoteProtocolError(f"{cls.NAME}: {len(body)} bytes are not 1 to {RECORDS_MAX} whole records")
        first_index, base = cls.LAYOUT.unpack(fixed_part)
        records = tuple((base + offset, on, duty) for offset, on, duty in RECORD.iter_unpack(rest))
        return cls(first_index, records)


HOST_MESSAGES = tuple(kind for kind in MESSAGES_BY_TYPE.values() if kind.TYPE < BOARD_TYPE)
BOARD_MESSAGES = tuple(kind for kind in MESSAGES_BY_TYPE.values() if kind.TYPE >= BOARD_TYPE)


def parse_message(type_id: int, body: bytes) -> Message:
    """Parse a frame's type and body. Raise RemoteProtocolError if the type, the length or an enumeration is unknown."""
    message_class = MESSAGES_BY_TYPE.get(type_id)
    if message_class is None:
        raise RemoteProtocolError(f"unknown message type 0x{type_id:02x}")
    message = message_class.parse(body)
    for name, names in message_class.ENUMS.items():
        if getattr(message, name) >= len(names):
            raise RemoteProtocolError(f"{message_class.NAME}: {name} {getattr(message, name)} has no meaning")
    return message
