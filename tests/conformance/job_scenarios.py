"""Scenarios of jobs: HOLD and refill, FLUSH, cleared faults, reports."""

from bench import BRIGHT, CENTRE, here, set_input
from scenario import scenario

DIM = dict(duty=999)


def start(host, first=0, watermark=1, job=1, start_tick=0):
    """Send START. Return the reasons of its NAKs."""
    return host.send_checked("START", job=job, first_index=first, start_tick=start_tick, watermark=watermark)


def reported(host):
    """Return the records of all EXECUTED messages, by number."""
    return {m.first_index + k: record for m in host.of("EXECUTED") for k, record in enumerate(m.records)}


# --- beginning and ending -------------------------------------------------------------------------------------------


@scenario("jobs", {"too few points": 2, "no points": 0})
def job_begins_at_its_watermark(bench, count):
    host = bench.ready(**BRIGHT)
    host.order(*[host.data(here(100, **DIM)) for _ in range(count)])
    assert start(host, watermark=3) == []
    host.pause(0.1)
    assert host.status().state == "RUNNING"
    assert host.board.of("gate") == []
    host.order(host.data(*[here(100, **DIM)] * (3 - count)))
    host.wait(lambda: host.board.pulse_numbers() == [0, 1, 2], "the points")
    host.wait_for_change("queue empty")


@scenario("jobs")
def job_begins_when_all_its_points_are_queued(bench):
    host = bench.ready(**BRIGHT)
    host.order(host.data(here(100, **DIM)))
    assert start(host, watermark=48) == []
    host.pause(0.05)
    assert host.board.of("gate") == []
    assert host.send_checked("END", job=1, end_index=2) == ["INDEX"]
    assert host.send_checked("END", job=2, end_index=1) == ["STATE"]
    assert host.send_checked("END", job=1, end_index=1) == []
    host.wait_for_change("job done")
    assert host.board.pulse_numbers() == [0]


@scenario("jobs")
def points_after_end_belong_to_the_next_job(bench):
    host = bench.ready(**BRIGHT)
    host.order(host.data(here(100, dark_us=60_000, **DIM)))
    assert start(host) == []
    assert host.send_checked("END", job=1, end_index=1) == []
    assert host.order(host.data(here(200, **DIM), here(300, **DIM))) == []
    host.wait_for_change("job done")
    host.pause(0.05)
    assert host.board.pulse_numbers() == [0]
    assert host.status().queued == 2
    assert start(host, first=0) == ["INDEX"]
    assert start(host, first=1) == []
    assert start(host, first=1) == ["STATE"]
    assert host.send_checked("END", job=1, end_index=3) == []
    host.wait_for_change("job done", count=2)
    assert host.board.pulse_numbers() == [0, 1, 2]


@scenario("jobs", {"at once": 0, "at a later tick": 2_000_000})
def missing_points_disarm_a_second_after_the_start(bench, ahead_us):
    host = bench.ready(**BRIGHT)
    tick = ahead_us and host.status().tick + ahead_us
    assert start(host, watermark=5, start_tick=tick) == []
    host.order(host.data(*[here(100, **DIM)] * 4))
    over = host.wait_for_change("hold too long")
    host.status()
    (began,) = [m for m in host.of("EVENT") if m.reason == "start"]
    (ended,) = [m for m in host.of("EVENT") if m.reason == "hold too long"]
    assert 0 <= ended.tick - max(began.tick, tick) - 1_000_000 <= host.board.late_us
    assert over["state"] == "DISARMED"
    assert host.board.of("gate") == []


@scenario("jobs")
def job_whose_tick_has_passed_begins_at_once(bench):
    host = bench.ready(**BRIGHT)
    assert host.play(here(100, dark_us=7, **DIM), start_tick=host.status().tick) == []
    host.wait_for_change("job done")
    (began,), (pulse,) = host.board.changes("start"), host.board.of("pulse")
    assert 0 <= pulse["on_us"] - began["t_us"] - 7 <= host.board.late_us


# --- HOLD -----------------------------------------------------------------------------------------------------------


@scenario("HOLD")
def hold_ends_at_the_watermark_and_dark_us_counts_from_then(bench):
    host = bench.ready(**BRIGHT)
    host.order(host.data(here(100, **DIM), here(100, **DIM)))
    assert start(host, watermark=2) == []
    host.wait_for_change("queue empty")
    host.order(host.data(here(100, dark_us=7000, **DIM)))
    host.pause(0.05)
    assert host.status().state == "HOLD"
    host.order(host.data(here(100, dark_us=7000, **DIM)))
    host.wait(lambda: len(host.board.pulse_numbers()) == 4, "the points")
    (refilled,) = host.board.changes("refilled")
    assert 0 <= host.board.of("pulse")[2]["on_us"] - refilled["t_us"] - 7000 <= host.board.late_us
    host.wait_for_change("queue empty", count=2)
    assert host.send_checked("END", job=1, end_index=4) == []
    assert host.board.states()[-1] == ("ARMED", "job done")


@scenario("HOLD")
def hold_of_a_second_disarms(bench):
    host = bench.ready(**BRIGHT)
    host.play(here(100, **DIM), end=False)
    hold = host.wait_for_change("queue empty")
    over = host.wait_for_change("hold too long")
    assert 0 <= over["t_us"] - hold["t_us"] - 1_000_000 <= host.board.late_us
    assert over["state"] == "DISARMED"
    host.arm()


@scenario("HOLD")
def third_underrun_is_a_fault_and_clearing_resets_the_count(bench):
    host = bench.ready(**BRIGHT)
    host.play(here(100, **DIM), end=False)
    host.wait_for_change("queue empty")
    host.order(host.data(here(100, **DIM)))
    host.wait_for_change("queue empty", count=2)
    host.order(host.data(here(100, **DIM)))
    host.wait_for_change("fault")
    assert host.board.faults() == ["UNDERRUN"]
    assert host.status().underruns == 3
    assert host.send_checked("CLEAR_FAULT") == []
    host.arm()
    host.play(here(100, **DIM), end=False)
    host.wait_for_change("queue empty", count=3)
    assert host.status().underruns == 4


@scenario("HOLD", {"within ten seconds": 4.9, "over more than ten seconds": 5.1})
def only_underruns_within_ten_seconds_are_a_fault(bench, pause_s):
    host = bench.ready(**BRIGHT)
    for count in (1, 2):
        host.play(here(100, **DIM), end=False)
        host.wait_for_change("queue empty", count)
        assert host.send_checked("FLUSH") == []
        host.pause(pause_s)
    host.play(here(100, **DIM), end=False)
    host.wait(lambda: len(host.board.pulse_numbers()) == 3 and not host.board.is_gate_on(), "the third underrun")
    host.wait(lambda: host.status().state != "RUNNING", "its consequence")
    first, _, third = host.board.of("pulse")
    expected = ["UNDERRUN"] if third["off_us"] - first["off_us"] <= 10_000_000 else []
    assert host.board.faults() == expected


# --- FLUSH and ABORT ------------------------------------------------------------------------------------------------


@scenario("FLUSH")
def flush_drops_the_queue_and_stays_armed(bench):
    host = bench.ready(**BRIGHT)
    count = host.shine(**DIM)
    assert host.send_checked("FLUSH") == []
    status = host.status()
    assert (status.state, status.queued, status.done_index) == ("ARMED", 0, count)
    cut = host.board.of("pulse")[-1]
    flushed = host.board.of("state")[-1]
    assert (flushed["state"], flushed["reason"]) == ("ARMED", "flush")
    assert cut["off_us"] == flushed["t_us"]
    assert cut["off_us"] - cut["on_us"] <= 60_000
    # A host that dropped points continues its own count, never a smaller one.
    assert host.send_checked("DATA", first_index=count - 1, points=[here(100)]) == ["INDEX"]
    host.index = count + 6
    assert host.play(here(100, **DIM)) == []
    host.wait_for_change("job done")
    assert host.board.pulse_numbers()[-1] == count + 6
    assert host.status().done_index == count + 7


@scenario("FLUSH")
def flush_in_hold_and_before_the_start(bench):
    host = bench.ready(**BRIGHT)
    host.play(here(100, **DIM), end=False)
    host.wait_for_change("queue empty")
    host.order(host.frame("FLUSH"), host.data(here(100, **DIM), here(100, **DIM)))
    assert host.board.states()[-1] == ("ARMED", "flush")
    assert host.status().queued == 2
    assert host.send_checked("FLUSH") == []
    status = host.status()
    assert (status.state, status.queued, status.done_index) == ("ARMED", 0, 3)
    assert host.play(here(100, **DIM)) == []
    host.wait_for_change("job done")
    assert host.board.pulse_numbers() == [0, 3]


@scenario("ABORT", {"ABORT": "abort", "DISARM": "disarm"})
def abort_and_disarm_drop_everything(bench, reason):
    host = bench.ready(**BRIGHT)
    sent = host.shine(**DIM)
    _, status = host.request(host.frame(reason.upper()))
    assert (status.state, status.queued) == ("DISARMED", 0)
    assert host.board.states()[-1] == ("DISARMED", reason)
    count = len(host.board.pulse_numbers())
    host.arm()
    assert host.status().queued == 0
    assert len(host.board.pulse_numbers()) == count
    assert host.play(here(100, **DIM)) == [], "a job of the same number"
    host.wait_for_change("job done")
    assert host.board.pulse_numbers()[count:] == [sent]


@scenario("ABORT")
def fault_persists_over_all_but_clear_fault(bench):
    host = bench.ready(set_input("interlock", False), set_input("interlock", True), **BRIGHT)
    board = host.board
    host.order(host.data(here(65_001)))
    assert board.states()[-1] == ("FAULT", "fault")
    for count in (1, 2):
        board.next_step()
        host.wait(lambda count=count: len(board.of("input")) == count, "the interlock")
    host.send("ABORT")
    assert host.send_checked("DISARM") == []
    host.close()
    board.wait(lambda: len(board.of("port")) == 2, "the loss")
    host = bench.host(board)
    host.hello()
    assert host.send_checked("ARM_REQ", host_nonce=1) == ["STATE"]
    status = host.status()
    assert (status.state, status.fault) == ("FAULT", "ON_TIME")
    assert host.send_checked("CLEAR_FAULT") == []
    assert board.states()[-1] == ("DISARMED", "fault cleared")
    assert host.status().fault == ""


# --- reports --------------------------------------------------------------------------------------------------------


@scenario("reports")
def each_point_is_reported_and_can_be_requested_again(bench):
    host = bench.ready(**BRIGHT)
    points = [here(100 + k if k % 5 else 0, dark_us=300, duty=1000 + k, x=CENTRE + 40 * k) for k in range(60)]
    assert host.play(*points) == []
    host.wait(lambda: len(reported(host)) == 60, "the reports")
    records = reported(host)
    pulses = {entry["index"]: entry for entry in host.board.of("pulse")}
    assert set(pulses) == {k for k in range(60) if k % 5}
    shift = {pulse["on_us"] - records[k][0] for k, pulse in pulses.items()}
    assert len(shift) == 1
    for k, (_, on, duty) in records.items():
        assert (on, duty) == ((100 + k, 1000 + k) if k % 5 else (0, 0))
        assert k == 0 or 0 <= records[k][0] - sum(records[k - 1][:2]) - 300 <= host.board.late_us
    for first in (0, 37, 59):
        answers, _ = host.request(host.frame("GET_EXECUTED", first_index=first))
        (again,) = answers
        assert again.first_index == first
        assert len(again.records) == min(28, 60 - first)
        assert again.records == [records[first + k] for k in range(len(again.records))]
    assert host.request(host.frame("GET_EXECUTED", first_index=60))[0] == []


@scenario("reports")
def interrupted_pulse_is_reported_with_its_actual_width(bench):
    host = bench.ready(settle_ns_per_code=65_000, **BRIGHT)
    count = host.shine(**DIM)
    assert host.send_checked("FLUSH") == []
    cut = host.board.of("pulse")[-1]
    host.wait(lambda: cut["index"] in reported(host), "its report")
    assert reported(host)[cut["index"]][1:] == (cut["off_us"] - cut["on_us"], 999)
    emitted_us = sum(pulse["off_us"] - pulse["on_us"] for pulse in host.board.of("pulse"))
    assert abs(host.status().laser_on_us - emitted_us * 999 / 65535) <= 1
    assert cut["index"] + 1 not in reported(host)
    host.play(here(100, x=CENTRE + 32_000, **DIM), here(100, **DIM), end=False)  # moves for two seconds
    assert host.send_checked("FLUSH") == []
    host.index = later = count + 16
    host.play(*[here(100, x=CENTRE + 32_000, **DIM)] * 2)
    host.wait(lambda: later + 1 in reported(host), "the reports")
    assert count not in reported(host)
    (report,) = host.request(host.frame("GET_EXECUTED", first_index=cut["index"]))[0]
    assert (report.first_index, len(report.records)) == (cut["index"], 1), "a gap in the numbers ends a report"
    (report,) = host.request(host.frame("GET_EXECUTED", first_index=cut["index"] + 1))[0]
    assert (report.first_index, len(report.records)) == (later, 2)
    host.hello()
    assert host.request(host.frame("GET_EXECUTED", first_index=0))[0] == [], "records are the session's"
