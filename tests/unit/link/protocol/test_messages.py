"""Compare the Python messages with messages.toml, the test vectors and the frames to refuse."""

import re
import struct
import tomllib
from dataclasses import fields
from pathlib import Path

import pytest

from optodrive.core.errors import RemoteProtocolError
from optodrive.link.protocol import connection, framing
from optodrive.link.protocol import messages as m

CONTRACT = Path(__file__).parents[4] / "firmware_protocol"
PAGE = (CONTRACT / "PROTOCOL.md").read_text()
TOML = tomllib.loads((CONTRACT / "messages.toml").read_text())
STRUCTS = TOML["struct"]
CODES = {"u8": "B", "u16": "H", "u32": "I", "u64": "Q", "i16": "h", "bytes12": "12s"}
ENUMS = {
    "state": m.STATES,
    "fault": m.FAULTS,
    "nak_reason": m.NAK_REASONS,
    "reason": m.EVENT_REASONS,
    "input_bit": m.INPUTS,
}
STATED = {entry["name"]: entry for entry in TOML["message"]}
VECTORS = {path.stem: tomllib.loads(path.read_text()) for path in sorted((CONTRACT / "vectors").glob("*.toml"))}
REFUSED = tomllib.loads((CONTRACT / "refused.toml").read_text())["case"]


KINDS = {message.NAME: message for message in m.MESSAGES_BY_TYPE.values()}


def codes(entries):
    """Return the struct format of fields, nested structs expanded."""
    return "".join(CODES.get(entry["type"]) or codes(STRUCTS[entry["type"]]) for entry in entries)


def names(entries):
    return [entry["name"] for entry in entries]


def test_every_message_is_stated_on_both_sides():
    assert {entry["id"]: entry["name"] for entry in TOML["message"]} == {
        type_id: message.NAME for type_id, message in m.MESSAGES_BY_TYPE.items()
    }
    assert len(TOML["message"]) == len(STATED) == len(m.HOST_MESSAGES) + len(m.BOARD_MESSAGES)


@pytest.mark.parametrize("name", STATED)
def test_id_direction_and_sequenced(name):
    stated, kind = STATED[name], KINDS[name]
    assert stated["id"] == kind.TYPE
    assert stated["sequenced"] is kind.SEQUENCED
    assert stated["from"] == ("host" if kind in m.HOST_MESSAGES else "board")
    assert bool(stated["id"] & 0x80) == (stated["from"] == "board")


@pytest.mark.parametrize("name", [name for name in STATED if name not in ("LIMITS", "HELLO_REPLY", "DATA", "EXECUTED")])
def test_fields_names_order_and_widths(name):
    stated, kind = STATED[name]["fields"], KINDS[name]
    assert names(stated) == [item.name for item in fields(kind)]
    assert "<" + codes(stated) == kind.LAYOUT.format


@pytest.mark.parametrize("name", STATED)
def test_enumerated_fields(name):
    stated = {entry["name"]: ENUMS[entry["enum"]] for entry in STATED[name]["fields"] if "enum" in entry}
    assert stated == KINDS[name].ENUMS


def test_limits_in_limits_and_hello_reply():
    assert names(STRUCTS["limits"]) == [item.name for item in fields(m.Limits)]
    assert "<" + codes(STATED["LIMITS"]["fields"]) == m.Limits.LAYOUT.format
    hello = STATED["HELLO_REPLY"]["fields"]
    assert names(hello) == [item.name for item in fields(m.HelloReply)]
    assert "<" + codes(hello) == m.HelloReply.LAYOUT.format + m.Limits.LAYOUT.format[1:]


def test_points_and_records_fill_a_frame():
    data, executed = STATED["DATA"], STATED["EXECUTED"]
    assert "<" + codes(STRUCTS["point"]) == m.POINT.format
    assert "<" + codes(data["fields"][:-1]) == m.Data.LAYOUT.format
    assert "<" + codes(STRUCTS["record"]) == m.RECORD.format
    assert "<" + codes(executed["fields"][:-1]) == m.Executed.LAYOUT.format
    for stated, item, count_max in ((data, m.POINT, m.POINTS_MAX), (executed, m.RECORD, m.RECORDS_MAX)):
        assert stated["repeat"] == {"min": 1, "max": count_max}
        assert KINDS[stated["name"]].LAYOUT.size + count_max * item.size <= framing.BODY_MAX


def test_enumerations_and_framing():
    for name, stated in TOML["enumerations"].items():
        assert tuple(stated) == (m.NOT_CONSUMED if name == "not_consumed" else ENUMS[name])
    frame = TOML["frame"]
    assert "<" + codes(frame["header"]) == framing.HEADER.format
    assert "<" + CODES[frame["crc"]] == framing.CRC.format
    assert (frame["raw_max"], frame["window"], frame["seq_modulus"]) == (
        framing.RAW_MAX,
        connection.WINDOW,
        connection.SEQ_MODULUS,
    )
    assert TOML["protocol"] == {"major": m.MAJOR, "minor": m.MINOR}


def offsets(entries):
    """Return (offset, type, name) of each field as in PROTOCOL.md, where a struct has no type."""
    at, placed = 0, []
    for entry in entries:
        placed.append((str(at), entry["type"].replace("bytes12", "u8[12]"), entry["name"]))
        at += struct.calcsize("<" + codes([entry]))
    return placed


def written(text):
    return re.findall(r"(\d+) (u8\[12\]|[ui]\d+) (\w+)", text)


@pytest.mark.parametrize("name", STATED)
def test_the_table_in_the_specification_agrees(name):
    row = re.search(rf"^\| (\w\w) \| {name} \| (S?) ?\| (.*) \|$", PAGE, re.MULTILINE)
    assert row, "no row"
    assert (int(row[1], 16), row[2] == "S") == (STATED[name]["id"], STATED[name]["sequenced"])
    assert written(row[3]) == [place for place in offsets(STATED[name]["fields"]) if place[1] not in STRUCTS]


@pytest.mark.parametrize("name", STRUCTS)
def test_the_structs_in_the_specification_agree(name):
    text = re.search(rf"^    {name}:(.*\n(?:     +.*\n)*)", PAGE, re.MULTILINE)
    assert written(re.sub(r"\(.*?\)", "", text[1])) == offsets(STRUCTS[name])


@pytest.mark.parametrize("name", ["nak_reason", "fault", "reason"])
def test_the_enumerations_in_the_specification_agree(name):
    for number, word in enumerate(TOML["enumerations"][name]):
        if word:
            assert re.search(rf"\b{number}(?: \|)? {word}\b", PAGE), word


# --- vectors --------------------------------------------------------------------------------------------------------


def build(name, values):
    """Build a message from the fields of a test vector."""
    values = dict(values)
    if name == "LIMITS":
        return m.Limits(**values["limits"])
    if name == "HELLO_REPLY":
        values["limits"] = m.Limits(**values["limits"])
        values["uid"] = bytes.fromhex(values["uid"])
    elif name == "DATA":
        values["points"] = b"".join(struct.pack("<HHHHH", *point.values()) for point in values["points"])
    elif name == "EXECUTED":
        base = values.pop("base_tick")
        values["records"] = tuple((base + r["offset"], r["on_ticks"], r["duty"]) for r in values["records"])
    return KINDS[name](**values)


def test_every_message_has_a_vector():
    assert {vector["message"] for vector in VECTORS.values()} == set(STATED)


@pytest.mark.parametrize("stem", VECTORS)
def test_vector_encodes(stem):
    vector = VECTORS[stem]
    message = build(vector["message"], vector["fields"])
    frame = framing.Frame(message.TYPE, vector["seq"], vector["session"], message.encode_body())
    assert vector["type"] == message.TYPE
    assert framing.encode_frame(frame).hex() == vector["wire"]
    assert framing.cobs_encode(bytes.fromhex(vector["raw"])).hex() + "00" == vector["wire"]


@pytest.mark.parametrize("portion", [1, 5, 1000], ids=["byte by byte", "by fives", "whole"])
@pytest.mark.parametrize("stem", VECTORS)
def test_vector_decodes(stem, portion):
    vector, decoder = VECTORS[stem], framing.FrameDecoder()
    wire = bytes.fromhex(vector["wire"]) + b"\x03tr"
    frames = [frame for at in range(0, len(wire), portion) for frame in decoder.feed(wire[at : at + portion])]
    assert [frame[:3] for frame in frames] == [(vector["type"], vector["seq"], vector["session"])]
    assert m.parse_message(frames[0].type, frames[0].body) == build(vector["message"], vector["fields"])


@pytest.mark.parametrize("case", REFUSED, ids=lambda case: case["what"])
def test_refused_frames_only_count(case):
    host = connection.HostConnection()
    assert host.receive_bytes(bytes.fromhex(case["wire"]), 0.0) == []
    counted = {name: getattr(host.counters, name) for name in ("crc_errors", "format_errors")}
    assert counted == {"crc_errors": 0, "format_errors": 0} | {case["counter"]: 1}


# --- bodies ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("stem", VECTORS)
def test_every_other_length_of_body_is_refused(stem):
    vector = VECTORS[stem]
    body = build(vector["message"], vector["fields"]).encode_body()
    for length in range(len(body)):
        try:
            shorter = m.parse_message(vector["type"], body[:length])
        except RemoteProtocolError:
            continue
        assert vector["message"] in ("DATA", "EXECUTED")  # a whole number of points
        assert shorter.encode_body() == body[:length]
    with pytest.raises(RemoteProtocolError):
        m.parse_message(vector["type"], body + b"\x01")


def test_names_beyond_the_enumerations_are_refused():
    for message in (m.Nak(0, 8), m.Ack(0, 0, 0, 7), m.Event(0, 17, 0, 0), m.Event(0, 0, 17, 0)):
        with pytest.raises(RemoteProtocolError, match="has no meaning"):
            m.parse_message(message.TYPE, message.encode_body())


def test_unknown_type_is_refused():
    with pytest.raises(RemoteProtocolError, match="0x7f"):
        m.parse_message(0x7F, b"")
