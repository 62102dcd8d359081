"""Independent implementation of the wire format, written from PROTOCOL.md only."""

import struct
import zlib
from types import SimpleNamespace

DATA_POINTS_MAX = 24
POINT = struct.Struct("<5H")
RECORD = struct.Struct("<IHH")
LIMITS = ("max_on_us", "max_duty", "mean_duty", "spot_uj", "spot_leak_uw", "full_power_uw")
LIMITS += ("x_min", "x_max", "y_min", "y_max", "settle_us", "settle_ns_per_code", "rest_us", "lease_ms")
LIMITS_CODES = "HHHIIIHHHHHHHH"

HOST = {
    "HELLO": (0x01, "BBI", ("major", "minor", "host_nonce")),
    "LIMITS": (0x02, LIMITS_CODES, LIMITS),
    "CLOCK": (0x03, "I", ("host_t",)),
    "LEASE": (0x04, "H", ("ms",)),
    "DATA": (0x10, "I", ("first_index",)),
    "START": (0x11, "IIQH", ("job", "first_index", "start_tick", "watermark")),
    "END": (0x12, "II", ("job", "end_index")),
    "ABORT": (0x13, "", ()),
    "ARM_REQ": (0x14, "I", ("host_nonce",)),
    "ARM_CONFIRM": (0x15, "II", ("host_nonce", "board_nonce")),
    "DISARM": (0x16, "", ()),
    "CLEAR_FAULT": (0x17, "", ()),
    "GET": (0x18, "", ()),
    "FLUSH": (0x19, "", ()),
    "GET_EXECUTED": (0x1A, "I", ("first_index",)),
    "START_ON_TRIGGER": (0x1B, "IIIH", ("job", "first_index", "delay_us", "wait_ms")),
    "GET_TRIGGERS": (0x1C, "", ()),
}
SEQUENCED = (
    "LIMITS",
    "DATA",
    "START",
    "START_ON_TRIGGER",
    "END",
    "ARM_REQ",
    "ARM_CONFIRM",
    "DISARM",
    "CLEAR_FAULT",
    "FLUSH",
)
HELLO_REPLY = ("major", "minor", "host_nonce", "session", "firmware", "uid", "capabilities", "tick_hz", "queue_points")
HELLO_REPLY += ("rx_window", "cell_codes", "cells", "window_pulses", "reset_cause", *LIMITS)
STATUS = ("state", "fault", "inputs", "tick", "done_index", "queued", "crc_errors", "format_errors", "seq_errors")
STATUS += ("underruns", "laser_on_us", "temperature_dc", "head", "mirror_x", "mirror_y")
BOARD = {
    0x81: ("HELLO_REPLY", "BBIHI12sIIHHHHHB" + LIMITS_CODES, HELLO_REPLY),
    0x83: ("CLOCK_REPLY", "IQ", ("host_t", "tick")),
    0x90: ("ACK", "BHIB", ("next_seq", "free_points", "done_index", "state")),
    0x91: ("NAK", "BB", ("next_seq", "reason")),
    0x92: ("EVENT", "BBBQ", ("state", "fault", "reason", "tick")),
    0x94: ("ARM_CHALLENGE", "II", ("host_nonce", "board_nonce")),
    0x9C: ("TRIGGERS", "IQ", ("count", "tick")),
    0x98: ("STATUS", "BBBQIHHHHHQhHHH", STATUS),
}
EXECUTED = 0x99
STATES = ("BOOT", "DISARMED", "ARMING", "ARMED", "RUNNING", "HOLD", "FAULT")
FAULTS = ("", "LINK", "RANGE", "ON_TIME", "DUTY", "MEAN_POWER", "SPOT", "UNDERRUN", "INTERLOCK", "KEY", "ESTOP")
FAULTS += ("TICK", "READBACK", "CELLS", "PULSES", "HEAD", "SCAN")
REASONS = ("", "boot", "hello", "arm requested", "armed", "start", "job done", "queue empty", "refilled")
REASONS += ("hold too long", "disarm", "abort", "link lost", "arming timed out", "fault", "fault cleared", "flush")
NAKS = ("SEQUENCE", "NO_ROOM", "STATE", "INDEX", "NONCE", "KEY_EDGE", "INPUT", "VERSION")
NAMES = {"state": STATES, "fault": FAULTS}


def cobs(raw):
    """Encode at most 252 bytes as COBS, without the delimiter."""
    out = bytearray()
    run = bytearray()
    for byte in raw:
        if byte:
            run.append(byte)
        else:
            out += bytes([len(run) + 1]) + run
            run = bytearray()
    return bytes(out + bytes([len(run) + 1]) + run)


def uncobs(coded):
    """Decode COBS."""
    raw, at = bytearray(), 0
    while at < len(coded):
        code = coded[at]
        raw += coded[at + 1 : at + code] + b"\0"
        at += code
    assert at == len(coded), "a board sends whole frames"
    return bytes(raw[:-1])


def frame(kind, seq=0, session=0, body=b""):
    """Encode a frame with its delimiter."""
    raw = struct.pack("<BBH", kind, seq, session) + body
    return cobs(raw + struct.pack("<I", zlib.crc32(raw))) + b"\0"


def body_of(name, **fields):
    """Encode the body of a host's message. DATA takes points as tuples of five."""
    _, codes, names = HOST[name]
    points = b"".join(POINT.pack(*point) for point in fields.pop("points", ()))
    return struct.pack("<" + codes, *(fields.pop(field) for field in names)) + points


def understood(raw):
    """Decode a board's frame as a namespace: name, session and fields. Enumerations are decoded by name."""
    *_, session = struct.unpack_from("<BBH", raw)
    content, body = raw[:-4], raw[4:-4]
    assert struct.unpack("<I", raw[-4:])[0] == zlib.crc32(content), "a board's frame with a wrong CRC"
    if raw[0] == EXECUTED:
        first, base = struct.unpack_from("<IQ", body)
        records = [(base + offset, on, duty) for offset, on, duty in RECORD.iter_unpack(body[12:])]
        assert 1 <= len(records) <= 28
        return SimpleNamespace(name="EXECUTED", session=session, first_index=first, records=records)
    name, codes, names = BOARD[raw[0]]
    reported = dict(zip(names, struct.unpack("<" + codes, body), strict=True))
    for field, words in {**NAMES, "reason": NAKS if name == "NAK" else REASONS}.items():
        if field in reported:
            reported[field] = words[reported[field]]
    reported["session"] = reported.get("session", session)
    return SimpleNamespace(name=name, **reported)


class MessageReader:
    """Splits a board's bytes into messages."""

    def __init__(self):
        self._rest = b""

    def take(self, data):
        """Return the messages completed by data."""
        *pieces, self._rest = (self._rest + data).split(b"\0")
        return [understood(uncobs(piece)) for piece in pieces if piece]
