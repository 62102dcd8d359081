"""Scenarios of what an implementation from PROTOCOL.md alone once had to guess, and of statements at their limits."""

import struct
import zlib

from bench import BRIGHT, CENTRE, PATIENT, here
from guard_scenarios import INSTANT
from scenario import scenario
from wire_format import cobs

DIM = dict(duty=999)
UNLIMITED = {**BRIGHT, **INSTANT}
LAST = 2**32 - 1
SECOND = [here(0, dark_us=50_000)] * 20


def play_to_the_end(host, *points):
    """Play points until the job is done or refused. Return the faults and the number of pulses."""
    board = host.board
    host.play(*points)
    host.wait(lambda: board.states()[-1][1] in ("fault", "job done"), "the end")
    return board.faults(), len(board.pulse_numbers())


# --- link -----------------------------------------------------------------------------------------------------------


@scenario("B13")
def crc_is_checked_before_type_and_length(bench):
    host = bench.greeted(**PATIENT)
    before = host.status()
    for kind in (0x7F, 0x18):
        raw = struct.pack("<BBHB", kind, 0, host.session, 1)
        _, after = host.request(cobs(raw + struct.pack("<I", zlib.crc32(raw) ^ 1)) + b"\0")
    assert (after.crc_errors, after.format_errors) == (before.crc_errors + 2, before.format_errors)


@scenario("sessions")
def frames_before_a_session_count_as_of_another_one(bench):
    host = bench.host(bench.board(**PATIENT))
    host.board.wait(lambda: host.board.of("port") and host.board.changes("boot"), "the board")
    host.pause(0.2)  # a computer enumerates a device on USB only then
    for name, fields in (("GET", {}), ("LEASE", {"ms": 1}), ("ABORT", {})):
        host.send(name, **fields)
    host.pause(0.05)
    host.hello()
    assert host.status().seq_errors == 2


@scenario("sessions")
def session_survives_a_lost_link(bench):
    host = bench.greeted(**PATIENT)
    host.close()
    host.board.wait(lambda: len(host.board.of("port")) == 2, "the loss")
    again = bench.host(host.board)
    again.session = host.session
    assert again.status().state == "DISARMED"


@scenario("go-back-N")
def frame_behind_is_acknowledged_before_any_was_consumed(bench):
    host = bench.greeted(**PATIENT)
    answers, _ = host.request(host.frame("DISARM", seq=255))
    assert [(message.name, message.next_seq) for message in answers] == [("ACK", 0)]


@scenario("go-back-N")
def repeated_arm_req_gets_no_second_challenge(bench):
    host = bench.greeted(**PATIENT)
    request = host.frame("ARM_REQ", host_nonce=4)
    answers, _ = host.request(request)
    assert [message.name for message in answers if message.name != "EVENT"] == ["ARM_CHALLENGE", "ACK"]
    answers, _ = host.request(request)
    assert [message.name for message in answers] == ["ACK"]


# --- points and jobs ------------------------------------------------------------------------------------------------


@scenario("B8")
def first_failed_check_names_the_fault(bench):
    """Of a frame, the first point that fails; of a point, field before gate-on time before duty."""
    limits = dict(x_min=1000, max_duty=1000, **PATIENT)
    for points, fault in (
        ([here(65_000, x=999)], "RANGE"),
        ([here(65_000)], "ON_TIME"),
        ([here(1, duty=1001), here(1, x=999)], "DUTY"),
    ):
        host = bench.ready(**limits)
        assert host.order(host.data(*points)) == ["STATE"]
        assert host.board.faults() == [fault]
    host = bench.ready(queue_points=24, **limits)
    assert host.order(host.data(*[here(0, duty=1)] * 4), host.data(*[here(1, x=999)] * 21)) == ["NO_ROOM"], (
        "points without room are not looked at"
    )
    assert host.board.faults() == []


@scenario("B12", {"the last one": (LAST - 1, []), "one more": (LAST, ["INDEX"])})
def last_number_leaves_one_for_the_end(bench, case):
    last, reasons = case
    host = bench.ready(**BRIGHT)
    assert host.send_checked("DATA", first_index=last - 1, points=[here(0)] * 2) == reasons


@scenario("credits")
def done_index_and_queue_around_a_running_point(bench):
    host = bench.ready(queue_points=24, **{**BRIGHT, "settle_ns_per_code": 65_000})
    far = [here(0, x=CENTRE + 32_000)] * 24  # a move of two seconds
    assert host.order(host.frame("DATA", first_index=100, points=far)) == []
    ack = host.of("ACK")[-1]
    assert (ack.done_index, ack.free_points) == (100, 0), "numbers that were left out count as done"
    assert host.send_checked("START", job=1, first_index=100, start_tick=0, watermark=1) == []
    host.pause(0.05)
    status = host.status()
    assert (status.done_index, status.queued) == (100, 23), "the running point is neither done nor queued"


@scenario("jobs")
def end_may_be_repeated_and_the_last_one_counts(bench):
    host = bench.ready(**BRIGHT)
    assert host.play(*[here(60_000, **DIM)] * 40) == []
    assert host.order(host.data(here(10, **DIM))) == []
    assert host.send_checked("END", job=1, end_index=41) == []
    assert host.send_checked("END", job=1, end_index=40) == ["INDEX"]
    host.wait_for_change("job done")
    assert host.board.pulse_numbers() == list(range(41))


@scenario("jobs")
def job_without_points_is_done_at_its_end(bench):
    host = bench.ready(**BRIGHT)
    later = host.status().tick + 10_000_000
    start = host.frame("START", job=1, first_index=0, start_tick=later, watermark=5)
    assert host.order(start, host.frame("END", job=1, end_index=0)) == []
    assert host.board.states()[-1] == ("ARMED", "job done")


@scenario("jobs")
def watermark_of_zero_waits_for_a_point(bench):
    host = bench.ready(**BRIGHT)
    assert host.send_checked("START", job=1, first_index=0, start_tick=0, watermark=0) == []
    host.pause(0.05)
    assert host.status().state == "RUNNING"
    host.order(host.data(here(10)))
    host.wait(lambda: host.board.pulse_numbers() == [0], "the pulse")


@scenario("HOLD")
def underruns_count_over_sessions(bench):
    host = bench.ready(**UNLIMITED)
    for count in (1, 2):
        host.play(here(100, **DIM), end=False)
        host.wait_for_change("queue empty", count)
        assert host.send_checked("FLUSH") == []
    host.hello()
    host.arm()
    host.play(here(100, **DIM), end=False)
    host.wait(lambda: len(host.board.pulse_numbers()) == 3 and not host.board.is_gate_on(), "the third underrun")
    host.wait(lambda: host.status().state != "RUNNING", "its consequence")
    first, _, third = host.board.of("pulse")
    expected = ["UNDERRUN"] if third["off_us"] - first["off_us"] <= 10_000_000 else []
    assert host.board.faults() == expected


# --- accounts -------------------------------------------------------------------------------------------------------

FULL = dict(spot_uj=80_000, spot_leak_uw=0)
"""After 30 ms at full power, 73.5 mJ, each further pulse is too much."""
TOO_MUCH = {
    "cells first": (dict(cells=1, max_on_us=50_000), here(30_000, x=CENTRE + 650), "CELLS"),
    "then gate-on time": (dict(mean_duty=2500, window_pulses=1, **FULL), here(30_000), "ON_TIME"),
    "then power": (dict(mean_duty=2500, window_pulses=1, **FULL), here(15_000), "MEAN_POWER"),
    "then energy": (dict(window_pulses=1, **FULL), here(15_000), "SPOT"),
    "then pulses": (dict(window_pulses=1), here(5000), "PULSES"),
}


@scenario("B6", TOO_MUCH)
def pulse_that_exceeds_several_limits_has_one_fault(bench, case):
    limits, second, fault = case
    host = bench.ready(**INSTANT, **PATIENT, **limits)
    assert play_to_the_end(host, here(30_000, x=CENTRE + 649), second) == ([fault], 1)


PART = {"just enough": (5243, [], 2), "just too little": (5242, ["MEAN_POWER"], 1)}
"""30 ms of the first pulse and the 50 ms of the second are within a second: 80 ms, 5242.8/65535 of it."""


@scenario("B5", PART)
def only_the_part_of_a_pulse_within_the_second_counts(bench, case):
    mean_duty, faults, count = case
    host = bench.ready(mean_duty=mean_duty, **UNLIMITED)
    points = [here(60_000), *SECOND[:18], here(0, dark_us=20_000), here(50_000, x=CENTRE + 2000)]
    assert play_to_the_end(host, *points) == (faults, count)


@scenario("B5", {"a second after its end": (0, [], 2), "before": (1, ["PULSES"], 1)})
def pulse_is_remembered_for_a_second_after_its_end(bench, case):
    early_us, faults, count = case
    host = bench.ready(window_pulses=1, **UNLIMITED)
    points = [here(60_000, **DIM), *SECOND[:19], here(1000, dark_us=50_000 - early_us, **DIM)]
    assert play_to_the_end(host, *points) == (faults, count)


@scenario("B5")
def interrupted_pulse_counts_its_whole_power(bench):
    host = bench.ready(mean_duty=3900, **UNLIMITED)  # 59.5 ms of a second
    host.play(here(50_000))
    host.wait(host.board.is_gate_on, "light")
    assert host.send_checked("FLUSH") == []
    host.play(here(20_000, x=CENTRE + 2000))
    host.wait(lambda: host.board.states()[-1][1] in ("fault", "job done"), "the end")
    (cut, *_), (_, second) = host.board.of("pulse"), host.board.changes("start")
    is_forgotten = second["t_us"] + 20_000 >= cut["on_us"] + 1_010_500
    assert is_forgotten or host.board.faults() == ["MEAN_POWER"]


DRAINED = {"each time a whole µJ": (999, [], 40), "never a whole µJ": (998, ["SPOT"], 10)}
"""Pulses of 0.04 nJ, a microsecond long, in a bucket of 10 µJ that leaks a microjoule in a millisecond."""


@scenario("B6", DRAINED)
def bucket_is_kept_in_whole_microjoules(bench, case):
    dark_us, faults, count = case
    host = bench.ready(**{**UNLIMITED, "spot_uj": 10, "spot_leak_uw": 1000})
    assert play_to_the_end(host, *[here(1, duty=1, dark_us=dark_us)] * 40) == (faults, count)
