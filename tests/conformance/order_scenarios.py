"""Scenarios of B12 and B13: each point once and in order, and invalid frames change only counters."""

import tomllib
from itertools import pairwise
from pathlib import Path

from bench import BRIGHT, PATIENT, here
from scenario import scenario
from wire_format import HOST, body_of, frame

REFUSED = tomllib.loads((Path(__file__).parents[2] / "firmware_protocol" / "refused.toml").read_text())["case"]

# --- B12 ------------------------------------------------------------------------------------------------------------


@scenario("B12")
def each_point_executes_once_and_in_order(bench):
    host = bench.ready(**BRIGHT)
    four = [here(100, dark_us=900, duty=999)] * 4
    first = host.data(*four)
    assert host.order(first) == []
    assert host.order(first + first) == []
    assert host.status().queued == 4, "duplicates are answered, no more"
    ahead = host.frame("DATA", seq=(host.seq + 1) % 256, first_index=4, points=four)
    assert host.order(ahead) == ["SEQUENCE"]
    later = host.status().tick + 2_000_000  # so that the queue does not run empty meanwhile
    assert host.send_checked("START", job=1, first_index=0, start_tick=later, watermark=1) == []
    for index in (0, 2, 5, 0xFFFF_FFFD):
        assert host.send_checked("DATA", first_index=index, points=four) == ["INDEX"], index
    assert host.order(first) == ["INDEX"], "behind: as the last one was answered"
    host.index = 4
    assert host.order(host.data(*four)) == []
    assert host.send_checked("DATA", first_index=4, points=four) == ["INDEX"]
    assert host.send_checked("END", job=1, end_index=8) == []
    host.wait(lambda: host.board.states()[-1] == ("ARMED", "job done"), "the job")
    assert host.send_checked("DATA", first_index=0, points=four) == ["INDEX"], "nor when the job is over"
    assert host.send_checked("DATA", first_index=0xFFFF_FFFD, points=four) == ["INDEX"], "numbers do not wrap"
    assert host.board.pulse_numbers() == list(range(8))
    pulses = host.board.of("pulse")
    assert all(one["off_us"] <= other["on_us"] for one, other in pairwise(pulses))


@scenario("B12")
def frame_repeated_256_later_is_detected_by_its_index(bench):
    host = bench.ready(**BRIGHT)
    old = host.data(here(100, duty=999))
    assert host.order(old, *[host.data(here(0, dark_us=200)) for _ in range(255)]) == []
    assert host.order(old) == ["INDEX"]
    host.seq = (host.seq + 1) % 256  # the frame had the expected number
    assert host.status().queued == 256
    start = host.frame("START", job=1, first_index=0, start_tick=0, watermark=1)
    assert host.order(start, host.frame("END", job=1, end_index=256)) == []
    host.wait(lambda: host.board.states()[-1] == ("ARMED", "job done"), "the job")
    assert host.board.pulse_numbers() == [0]


# --- B13 ------------------------------------------------------------------------------------------------------------


def damaged(whole):
    """Return a frame truncated at each position and with each single bit flipped."""
    cut = [whole[:at] + b"\0" for at in range(1, len(whole) - 1)]
    at_bits = [(at, bit) for at in range(len(whole) - 1) for bit in range(8)]
    flipped = [bytes((*whole[:at], whole[at] ^ 1 << bit, *whole[at + 1 :])) for at, bit in at_bits]
    return cut + flipped


@scenario("B13")
def invalid_frames_change_only_counters(bench):
    host = bench.ready(**BRIGHT)
    board = host.board
    points = [here(60_000, duty=999)] * 250
    host.play(*points)
    host.wait(board.is_gate_on, "light")
    before, log = host.status(), len(board.of("state"))
    answered = len(host.received)
    junk = [bytes.fromhex(case["wire"]) for case in REFUSED]
    for name in ("ABORT", "FLUSH", "DISARM", "GET"):
        junk += damaged(host.frame(name, seq=host.seq))
    junk += damaged(host.frame("END", seq=host.seq, job=1, end_index=1))[::3]
    junk += [frame(kind, host.seq, host.session, b"") for kind in (0x00, 0x05, 0x1B, 0x7F, 0xFF)]  # undefined types
    junk += [frame(HOST[name][0], host.seq, host.session, bytes(3)) for name in ("ABORT", "GET", "FLUSH", "DISARM")]
    junk += [frame(HOST["HELLO"][0], 0, 0, body_of("HELLO", major=1, minor=0, host_nonce=1) + b"\1")]
    junk += [frame(HOST["DATA"][0], host.seq, host.session, bytes(4) + bytes(n)) for n in (0, 9, 11)]
    junk += [bytes(range(1, 256)) + b"\0", b"\xff" * 3000 + b"\0"]
    for at in range(0, len(junk), 40):
        host.raw(b"".join(junk[at : at + 40]))
        host.lease()
        host.receive()
    after = host.status()
    counted = [getattr(after, name) - getattr(before, name) for name in ("crc_errors", "format_errors")]
    assert sum(counted) >= len(junk)
    assert after.seq_errors == before.seq_errors
    answers = [m for m in host.received[answered:] if m.name not in ("STATUS", "EXECUTED")]
    assert answers == [], "junk was answered"
    assert after.state == "RUNNING"
    assert len(board.of("state")) == log
    host.wait(lambda: board.states()[-1] == ("ARMED", "job done"), "the job")
    assert board.pulse_numbers() == list(range(len(points)))
    assert {entry["off_us"] - entry["on_us"] for entry in board.of("pulse")} == {60_000}


@scenario("B13")
def refused_frames_count_as_specified(bench):
    host = bench.greeted(**PATIENT)
    for case in REFUSED:
        before = host.status()
        answers, after = host.request(bytes.fromhex(case["wire"]))
        assert answers == [], case["what"]
        names = ("crc_errors", "format_errors", "seq_errors")
        grown = {name for name in names if getattr(after, name) != getattr(before, name)}
        assert grown == {case["counter"]}, case["what"]
        assert getattr(after, case["counter"]) == getattr(before, case["counter"]) + 1, case["what"]
    assert host.board.of("rx_error")[-1]["bad_frames"] == after.crc_errors + after.format_errors


@scenario("B13")
def empty_pieces_count_nothing_and_a_long_one_once(bench):
    host = bench.greeted(**PATIENT)
    before = host.status()
    answers, after = host.request(bytes(500))
    assert answers == []
    assert after.format_errors == before.format_errors
    answers, after = host.request(b"\x01" * 254 * 20 + b"\0")
    assert answers == []
    assert after.format_errors == before.format_errors + 1
