"""`optodrive wire dump | replay` on a small link capture."""

import json

import pytest

from optodrive.cli.main import run
from optodrive.link.protocol import messages as m
from optodrive.link.protocol.framing import Frame, encode_frame
from optodrive.link.transport.link_capture import CLOSED, FROM_BOARD, OPENED, TO_BOARD, CaptureEntry, LinkCaptureWriter


def encode_message(message, seq=0):
    return encode_frame(Frame(message.TYPE, seq, 5, message.encode_body()))


DATA = m.Data(0, m.POINT.pack(1, 2, 3, 4, 32768) * 20)
ENTRIES = [
    CaptureEntry(OPENED, 10.0),
    CaptureEntry(TO_BOARD, 10.1, b"\0" + encode_message(m.ClockRequest(9)) + encode_message(DATA)),
    CaptureEntry(FROM_BOARD, 10.15, encode_message(m.ClockReply(9, 77))[:4]),
    CaptureEntry(FROM_BOARD, 10.2, encode_message(m.ClockReply(9, 77))[4:] + b"\x05no frame\0"),
    CaptureEntry(TO_BOARD, 10.3, encode_message(DATA)),
    CaptureEntry(FROM_BOARD, 12.3, encode_message(m.Nak(1, 0))),
    CaptureEntry(CLOSED, 12.5),
]


@pytest.fixture
def capture(tmp_path):
    writer = LinkCaptureWriter(tmp_path / "capture", 10.0, pytest.fail)
    for entry in ENTRIES:
        writer.record(entry)
    writer.close()
    with writer.path.open("ab") as file:
        file.write(b"torn")
    return str(writer.path)


def test_dump_as_text(capture, capsys):
    assert run(["wire", "dump", capture]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[:2] == ["    0.000000 -- link opened", "    0.100000 -> CLOCK host_t=00000009"]
    assert lines[2].startswith("    0.100000 -> DATA #0 first_index=0 points=20 x_code=[1,1,1,1,1,1,1,1,…]")
    assert lines[3:5] == [
        "    0.200000 <- CLOCK_REPLY host_t=00000009 tick=77",
        "    0.200000 <- INVALID no COBS frame, 9 bytes: 056e6f206672616d65",
    ]
    assert "-> DATA #0 retransmitted" in lines[5]
    assert lines[6] == "    2.300000 <- NAK next_seq=1 reason=SEQUENCE"
    totals = dict(line.rsplit(maxsplit=1) for line in lines[9:])
    assert totals["retransmissions"] == totals["naks"] == totals["bad frames from board"] == "1"
    assert totals["bad bytes"] == "9"
    assert totals["ignored bytes"] == "4"
    assert totals["round trip median s"] == "0.1"
    assert totals["board silence s"] == "2.1"


def test_dump_as_json_lists_every_point(capture, capsys):
    assert run(["wire", "dump", capture, "--json"]) == 0
    *lines, last = map(json.loads, capsys.readouterr().out.splitlines())
    assert [line.get("message") for line in lines] == [None, "CLOCK", "DATA", "CLOCK_REPLY", None, "DATA", "NAK", None]
    assert lines[2]["fields"]["on_us"] == [4] * 20
    assert [line["retransmitted"] for line in lines if "retransmitted" in line] == [False, True]
    assert last["totals"]["frames_to_board"] == 3
    assert last["totals"]["start_unix_s"] > 1e9


def test_bad_input_is_one_line(capture, tmp_path, capsys):
    assert run(["wire", "dump", str(tmp_path / "none")]) == 2
    assert run(["wire", "replay", capture, "--board", "/dev/none", "--seed", "1"]) == 2
    assert run(["wire", "replay", capture, "--board", "/dev/none"]) == 2
    errors = capsys.readouterr().err.splitlines()
    assert len(errors) == 3
    assert "simulated" in errors[1]
    assert "serial port that exists" in errors[2]


def test_replay_reports_where_a_board_differs(capture, capsys):
    assert run(["wire", "replay", capture, "--board", "simulated"]) == 0, "no state was captured, none differs"
    assert capsys.readouterr().out.startswith("identical\n")
