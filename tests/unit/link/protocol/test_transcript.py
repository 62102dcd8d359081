import pytest
from hypothesis import given
from hypothesis import strategies as st

from optodrive.link.protocol import messages as m
from optodrive.link.protocol.framing import Frame, FrameDecoder, encode_frame
from optodrive.link.protocol.transcript import PENDING_MAX, Transcript, describe, describe_reset_cause

DATA = m.Data(7, m.POINT.pack(1, 2, 3, 4, 65535) * 2)
STATUS = m.Status(4, 1, 0b101, 99, 3, 2, 1, 0, 0, 0, 12, 253, 0, 0, 0)


def wire(message, seq=0, session=5):
    return encode_frame(Frame(message.TYPE, seq, session, message.encode_body()))


def test_description_of_messages():
    words = describe(STATUS)
    assert words["state"] == "RUNNING"
    assert words["fault"] == "LINK"
    assert words["inputs"] == ["interlock", "estop"]
    assert words["temperature_c"] == 25.3
    assert describe(DATA) == {
        "first_index": 7,
        "points": 2,
        "x_code": [1, 1],
        "y_code": [2, 2],
        "dark_us": [3, 3],
        "on_us": [4, 4],
        "duty_fraction": [1.0, 1.0],
    }
    assert describe(m.Executed(4, ((1000, 20, 0),))) == {
        "first_index": 4,
        "records": 1,
        "on_tick": [1000],
        "on_ticks": [20],
        "duty_fraction": [0.0],
    }
    assert describe(m.ArmReq(255)) == {"host_nonce": "000000ff"}
    assert describe(m.Event(1, 0, 2, 5)) == {"state": "DISARMED", "fault": None, "reason": "hello", "tick": 5}
    limits = describe(m.Limits(*range(1, 15)))
    assert limits["max_duty_fraction"] == pytest.approx(2 / 65535)
    assert limits["lease_ms"] == 14
    reply = m.HelloReply(1, 0, 1, 2, 0x10000, bytes(12), 0, 1_000_000, 256, 8, 300, 99, 999, 3, m.Limits(*range(1, 15)))
    assert (describe(reply)["reset_cause"], describe(reply)["firmware"]) == ("watchdog", "1.0")
    assert describe(reply)["limits"] == limits
    assert describe_reset_cause(8) == "unknown cause 8"


@given(st.lists(st.integers(1, 40), max_size=20))
def test_entries_do_not_depend_on_the_portions(cuts):
    stream = wire(m.Get()) + b"\x03xx\0" + wire(DATA, 0) + b"\0" + wire(STATUS)
    transcript, lines, at = Transcript(), [], 0
    for k, cut in enumerate([*cuts, len(stream)]):
        lines += transcript.feed(float(k), True, stream[at : at + cut])
        at += cut
    assert [type(line.message) for line in lines] == [m.Get, type(None), m.Data, type(None)]
    assert lines[1].raw == b"\x03xx"
    assert "echo" in lines[3].error
    assert transcript.totals.bad_frames_to_board == 2
    assert transcript.totals.bad_bytes == 3 + len(wire(STATUS)) - 1


@given(st.binary(max_size=2000))
def test_counts_agree_with_the_decoder(data):
    transcript, decoder = Transcript(), FrameDecoder()
    lines = transcript.feed(0.0, False, data + b"\0")
    runs = [run for run in data.split(b"\0") if run]
    assert [line.raw for line in lines if len(line.raw) < PENDING_MAX] == [
        run for run in runs if len(run) < PENDING_MAX
    ]
    assert sum(line.frame is not None for line in lines) == len(list(decoder.feed(data + b"\0")))


def test_a_damaged_frame_has_an_error_text():
    good = wire(m.Get())
    transcript = Transcript()
    crc = bytearray(good)
    crc[-2] ^= 2
    unknown = encode_frame(Frame(0x77, 0, 5, b""))
    lines = transcript.feed(0.0, True, bytes(crc) + unknown)
    assert lines[0].error == "wrong CRC"
    assert lines[1].error == "unknown message type 0x77"


def test_bytes_without_a_delimiter_use_bounded_memory():
    transcript = Transcript()
    lines = [line for k in range(50) for line in transcript.feed(float(k), False, b"\x07" * 100)]
    assert sum(len(line.raw) for line in lines) >= 5000 - PENDING_MAX
    assert all(line.error for line in lines)


def test_silences_and_retransmissions_and_round_trips():
    transcript = Transcript()
    for at_s, to_board, message, seq in [
        (1.0, True, m.Hello(1, 0, 1), 0),
        (1.5, True, DATA, 0),
        (1.6, True, m.ClockRequest(77), 0),
        (1.7, False, m.ClockReply(77, 5), 0),
        (1.8, True, DATA, 0),
        (1.9, True, m.End(1, 9), 1),
        (2.9, False, m.Nak(2, 0), 0),
    ]:
        (line,) = transcript.feed(at_s, to_board, wire(message, seq))
        assert line.retransmitted == (at_s == 1.8)
    totals = transcript.totals.to_dict()
    assert totals["retransmissions"] == totals["naks"] == 1
    assert totals["round_trip_median_s"] == pytest.approx(0.1)
    assert totals["host_silence_s"] == pytest.approx(0.5)
    assert totals["board_silence_s"] == pytest.approx(1.2)
    transcript.reset_link()
    transcript.feed(100.0, False, wire(STATUS))
    assert transcript.totals.board_silence_s == pytest.approx(1.2)
