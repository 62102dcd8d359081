"""States, jobs and reports of the simulated board, with explicit time."""

import random
import tomllib
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest
from board_bench import CENTRE, Bench, here, naks

from optodrive.link.protocol import messages as m
from optodrive.link.simulator import board_machine as machine_module
from optodrive.link.simulator.board_core import TICK_HZ
from optodrive.link.simulator.board_limits import DEFAULT_LIMITS
from optodrive.link.simulator.execution_records import RING_RECORDS
from optodrive.link.simulator.guards import DUTY_FULL, WINDOW_US, EmissionGuards, energy_uj


@pytest.fixture
def bench():
    return Bench().ready()


def executed(answers):
    """Return (index, gate-on tick, ticks, duty) of each EXECUTED record."""
    return [
        (message.first_index + k, *record)
        for message in answers
        if isinstance(message, m.Executed)
        for k, record in enumerate(message.records)
    ]


def dim(count, on_us=1000, dark_us=9000):
    return [here(on_us, dark_us=dark_us, duty=1000)] * count


def walk(b):
    """Return the entered states with their reasons."""
    return [(entry["state"], entry["reason"]) for entry in b.of("state")]


def test_the_timing_of_the_contract():
    contract = Path(__file__).parents[4] / "firmware_protocol" / "messages.toml"
    timing = tomllib.loads(contract.read_text())["timing"]
    assert timing == {
        "tick_hz": TICK_HZ,
        "indicator_us": machine_module.INDICATOR_US,
        "arming_timeout_us": machine_module.ARMING_TIMEOUT_US,
        "hold_max_us": machine_module.HOLD_MAX_US,
        "underruns_max": machine_module.UNDERRUNS_MAX,
        "underrun_window_us": machine_module.UNDERRUN_WINDOW_US,
        "mean_window_us": WINDOW_US,
        "executed_ring": RING_RECORDS,
    }


# --- arming ---------------------------------------------------------------------------------------------------------


def test_boot_to_armed_takes_the_indicator_s_two_seconds():
    b = Bench()
    assert walk(b) == [("DISARMED", "boot")]
    assert b.send(m.Get()) == [], "no session, no answer"
    b.hello()
    b.now_us = 500_000
    challenge = b.challenge()
    b.wait(30_000)
    b.send(m.ArmConfirm(challenge.host_nonce, challenge.board_nonce))
    b.wait(1_969_999)
    assert b.state == "ARMING"
    b.wait(1)
    assert b.state == "ARMED"
    assert walk(b)[-2:] == [("ARMING", "arm requested"), ("ARMED", "armed")]


def test_arming_without_confirmation_times_out():
    b = Bench()
    b.hello()
    b.challenge()
    b.wait(9_999_999)
    assert b.state == "ARMING"
    b.wait(1)
    assert walk(b)[-1] == ("DISARMED", "arming timed out")


def test_another_major_version_may_talk_but_not_arm():
    b = Bench()
    assert b.hello(major=2).major == m.MAJOR
    assert b.status().state == m.STATES.index("DISARMED")
    assert naks(b.send(m.ArmReq(1))) == ["VERSION"]
    b.hello()
    b.arm()


@pytest.mark.parametrize(("name", "value"), [("interlock", False), ("key", False), ("estop", True)])
def test_no_arming_with_an_input_that_is_not_safe(name, value):
    b = Bench()
    b.core.machine.inputs[name] = value  # as at power-up, so it is no fault
    b.hello()
    assert naks(b.send(m.ArmReq(1))) == ["INPUT"]


def test_orders_in_the_wrong_state_are_refused_and_change_nothing():
    b = Bench()
    b.hello()
    orders = (b.data(here(1000)), m.Start(1, 0, 0, 1), m.End(1, 0), m.ArmConfirm(1, 2), m.ClearFault(), m.Flush())
    for order in orders:
        assert naks(b.send(order)) == ["STATE"]
        assert b.state == "DISARMED"
    b.arm()
    for order in (DEFAULT_LIMITS, m.ArmReq(1), m.ArmConfirm(1, 2), m.ClearFault(), m.End(1, 0)):
        assert naks(b.send(order)) == ["STATE"]
        assert b.state == "ARMED"


# --- a job ----------------------------------------------------------------------------------------------------------


def test_a_job_runs_as_sent_and_is_reported(bench):
    began_us = bench.now_us
    answers = bench.play(here(4600, dark_us=5000), here(0, dark_us=400), here(2000, dark_us=600, duty=30_000))
    answers += bench.wait(20_000)
    assert bench.edges == [
        (began_us + t, on) for t, on in ((5000, True), (9600, False), (10_600, True), (12_600, False))
    ]
    assert executed(answers) == [
        (0, began_us + 5000, 4600, 65535),
        (1, began_us + 10_000, 0, 0),
        (2, began_us + 10_600, 2000, 30_000),
    ]
    assert walk(bench)[-2:] == [("RUNNING", "start"), ("ARMED", "job done")]
    assert bench.status().laser_on_us == 4600 + 2000 * 30_000 // 65535


def test_a_job_starts_at_its_tick_or_at_once(bench):
    tick = bench.now_us + 123_456
    bench.send(bench.data(here(100)), m.Start(1, 0, tick, 1), m.End(1, 1))
    bench.wait(200_000)
    now_us = bench.now_us
    bench.send(bench.data(here(100, dark_us=7)), m.Start(2, 1, tick, 1), m.End(2, 2))
    bench.wait(200_000)
    assert [on_us for _, on_us, _ in bench.pulses] == [tick, now_us + 7]


def test_the_watermark_holds_a_start_back_and_the_end_lets_it_go(bench):
    bench.send(bench.data(*dim(3)), m.Start(1, 0, 0, 5))
    bench.wait(50_000)
    assert bench.edges == []
    bench.send(bench.data(*dim(1)), m.End(1, 4))
    bench.wait(50_000)
    assert len(bench.pulses) == 4


def test_many_frames_at_once_are_taken_in_their_order(bench):
    answers = bench.send(
        *(bench.data(*dim(24)) for _ in range(5)), m.Start(1, 0, 0, 1), m.End(1, 120), m.Flush(), m.Disarm()
    )
    assert naks(answers) == []
    (ack,) = [x for x in answers if isinstance(x, m.Ack)]
    assert (ack.next_seq, ack.done_index, m.STATES[ack.state]) == (bench.seq, 120, "DISARMED")
    assert walk(bench)[-3:] == [("RUNNING", "start"), ("ARMED", "flush"), ("DISARMED", "disarm")]


def test_a_refusal_within_a_batch_is_reported_and_the_rest_is_accepted(bench):
    answers = bench.send(bench.data(*dim(2)), m.Start(1, 7, 0, 1), m.Start(1, 0, 0, 1), m.End(1, 2))
    assert naks(answers) == ["INDEX"]
    assert [x.next_seq for x in answers if isinstance(x, m.Ack | m.Nak)] == [bench.seq - 2, bench.seq]
    bench.wait(50_000)
    assert len(bench.pulses) == 2


def test_no_room_awaits_the_same_frame_again():
    b = Bench(queue_points=30).ready()
    b.send(b.data(*dim(20)))
    seq, frame = b.seq, b.frame(b.data(*dim(20)))
    assert b.raw(frame) == [m.Nak(seq, m.NAK_REASONS.index("NO_ROOM"))]
    assert naks(b.raw(b.frame(m.End(1, 40), seq=seq + 1))) == ["SEQUENCE"]
    b.raw(b.frame(m.Flush(), seq=seq))
    assert b.status().queued == 0
    b.seq = seq + 1
    assert naks(b.send(b.data(*dim(20)))) == []


def test_start_with_nothing_queued_waits_for_points(bench):
    bench.send(m.Start(1, 0, 0, 1))
    assert bench.state == "RUNNING"
    bench.wait(500_000)
    bench.send(bench.data(*dim(2)), m.End(1, 2))
    bench.wait(50_000)
    assert len(bench.pulses) == 2
    assert bench.state == "ARMED"


def test_start_that_gets_no_points_is_given_up_after_a_second(bench):
    bench.send(m.Start(1, 0, bench.now_us + 300_000, 5), bench.data(*dim(4)))
    bench.wait(1_299_999)
    assert bench.state == "RUNNING"
    bench.wait(1)
    assert walk(bench)[-1] == ("DISARMED", "hold too long")
    assert bench.edges == []


def test_start_names_the_first_point_queued(bench):
    bench.send(bench.data(*dim(2)))
    assert naks(bench.send(m.Start(1, 1, 0, 1))) == ["INDEX"]
    assert naks(bench.send(m.Start(1, 0, 0, 1))) == []
    assert naks(bench.send(m.Start(2, 0, 0, 1))) == ["STATE"]


def test_end_before_its_data_is_refused_and_can_be_repeated(bench):
    bench.send(bench.data(*dim(2)), m.Start(1, 0, 0, 1))
    assert naks(bench.send(m.End(1, 4))) == ["INDEX"]
    assert naks(bench.send(m.End(2, 2))) == ["STATE"], "another job's"
    assert naks(bench.send(bench.data(*dim(2)), m.End(1, 4))) == []
    bench.wait(50_000)
    assert (bench.state, len(bench.pulses)) == ("ARMED", 4)


def test_end_that_comes_late_ends_the_hold(bench):
    bench.play(*dim(2), end=False)
    bench.wait(50_000)
    assert bench.state == "HOLD"
    bench.send(m.End(1, 2))
    assert walk(bench)[-1] == ("ARMED", "job done")


def test_points_behind_the_end_belong_to_the_next_job(bench):
    bench.send(bench.data(*dim(2)), m.Start(1, 0, 0, 1), m.End(1, 2), bench.data(*dim(3)))
    bench.wait(50_000)
    assert (bench.state, len(bench.pulses)) == ("ARMED", 2)
    assert naks(bench.send(m.Start(2, 2, 0, 1), m.End(2, 5))) == []
    bench.wait(50_000)
    assert [index for index, _, _ in bench.pulses] == [0, 1, 2, 3, 4]


# --- hold -----------------------------------------------------------------------------------------------------------


def test_hold_and_resume(bench):
    bench.play(*dim(2), end=False)
    bench.wait(100_000)
    assert bench.state == "HOLD"
    resumed_us = bench.now_us
    bench.send(bench.data(*dim(2)), m.End(1, 4))
    assert bench.state == "RUNNING"
    bench.wait(50_000)
    assert bench.pulses[2][1] == resumed_us + 9000, "its dark time counts from the resumption"
    assert [index for index, _, _ in bench.pulses] == [0, 1, 2, 3]
    assert [state for state, _ in walk(bench)[-4:]] == ["RUNNING", "HOLD", "RUNNING", "ARMED"]
    assert bench.status().underruns == 1


def test_hold_resumes_with_the_watermark_filled(bench):
    bench.send(bench.data(*dim(3)), m.Start(1, 0, 0, 3))
    bench.wait(60_000)
    bench.send(bench.data(*dim(2)))
    assert bench.state == "HOLD"
    bench.send(bench.data(*dim(1)))
    assert bench.state == "RUNNING"


def test_hold_longer_than_a_second_disarms(bench):
    began_us = bench.now_us
    bench.play(*dim(1), end=False)
    bench.wait(10_000 + 999_999)
    assert bench.state == "HOLD"
    bench.wait(1)
    assert bench.of("state")[-1]["t_us"] == began_us + 1_010_000
    assert walk(bench)[-1] == ("DISARMED", "hold too long")
    bench.arm()


@pytest.mark.parametrize(("pause_us", "fault"), [(900_000, "UNDERRUN"), (4_980_000, "UNDERRUN"), (5_100_000, "")])
def test_three_underruns_within_ten_seconds_are_a_fault(bench, pause_us, fault):
    for _ in range(3):
        bench.play(*dim(1), end=False)
        bench.wait(20_000)
        if bench.state == "FAULT":
            break
        assert bench.state == "HOLD"
        bench.send(m.Flush())
        bench.wait(pause_us)
    assert bench.fault == fault
    assert not bench.core.gate


# --- breaking off ---------------------------------------------------------------------------------------------------


def test_a_pulse_cut_short_is_recorded_with_what_it_did(bench):
    began_us = bench.now_us
    bench.play(here(40_000, dark_us=2000, duty=32768), *dim(3))
    bench.wait(12_000)
    answers = bench.send(m.Flush())
    assert executed(answers) == [(0, began_us + 2000, 10_000, 32768)]
    assert bench.pulses == [(0, began_us + 2000, began_us + 12_000)]
    assert bench.edges[-1] == (began_us + 12_000, False)
    assert bench.status().laser_on_us == 10_000 * 32768 // 65535


def test_a_pulse_cut_short_counts_in_full_against_its_cell(bench):
    bench.play(here(40_000, duty=100))
    bench.wait(10_000)
    bench.send(m.Flush())
    bench.play(here(20_000, duty=100))
    assert bench.fault == "ON_TIME"


def test_flush_drops_the_queue_and_stays_armed(bench):
    for state, wait_us in (("RUNNING", 5000), ("HOLD", 20_000)):
        bench.play(*dim(1 if state == "HOLD" else 5), end=False)
        bench.wait(wait_us)
        assert bench.state == state
        assert naks(bench.send(m.Flush())) == []
        assert (bench.state, bench.status().queued, bench.status().done_index) == ("ARMED", 0, bench.index)
    bench.send(bench.data(*dim(3)), m.Flush())
    assert bench.status().queued == 0
    assert naks(bench.play(*dim(2))) == []
    bench.wait(50_000)
    assert bench.state == "ARMED"


def test_after_a_flush_indices_go_on_from_where_they_were_or_further(bench):
    bench.play(*dim(5))
    bench.wait(15_000)
    bench.send(m.Flush())
    behind = m.Data(4, m.POINT.pack(*here(10)))
    assert naks(bench.send(behind)) == ["INDEX"]
    bench.index = 50
    assert naks(bench.play(*dim(2))) == []
    answers = bench.wait(50_000)
    assert [record[0] for record in executed(answers)] == [50, 51]


@pytest.mark.parametrize("order", [m.Abort(), m.Disarm()])
def test_the_same_job_number_again_after_it_was_broken_off(bench, order):
    bench.play(*dim(5))
    bench.wait(15_000)
    bench.send(order)
    assert (bench.state, bench.status().queued) == ("DISARMED", 0)
    bench.arm()
    assert naks(bench.play(*dim(2))) == [], "job 1 once more"
    answers = bench.wait(50_000)
    assert [record[0] for record in executed(answers)] == [5, 6]
    assert bench.state == "ARMED"


def test_abort_needs_no_session_and_no_sequence(bench):
    bench.play(here(40_000))
    bench.wait(1000)
    bench.raw(bench.frame(m.Abort(), session=0, seq=200))
    assert walk(bench)[-1] == ("DISARMED", "abort")
    assert not bench.core.gate


def test_points_dropped_settle_nothing_on_the_next_job(bench):
    bench.play(here(100, x=CENTRE + 30_000))
    bench.wait(10)
    bench.send(m.Flush())
    bench.wait(50_000)
    began_us = bench.now_us
    bench.play(here(100, x=CENTRE + 30_000))
    bench.wait(5000)
    assert bench.pulses[0][1] == began_us, "the mirrors had long arrived"


# --- hello and faults -----------------------------------------------------------------------------------------------


def test_hello_ends_everything_and_restores_the_board_s_own_limits(bench):
    bench.send(m.Disarm(), replace(DEFAULT_LIMITS, lease_ms=50, max_on_us=10_000))
    bench.arm()
    bench.play(*dim(5))
    bench.wait(5000)
    reply = bench.hello(nonce=7)
    assert (reply.host_nonce, reply.limits, bench.state) == (7, DEFAULT_LIMITS, "DISARMED")
    assert walk(bench)[-1] == ("DISARMED", "hello")
    status = bench.status()
    assert (status.queued, status.done_index) == (0, 0)
    bench.arm()
    assert naks(bench.send(bench.data(here(40_000)))) == []


def test_every_session_has_another_number():
    b = Bench()
    sessions = [b.hello().session for _ in range(50)]
    assert 0 not in sessions
    assert all(a != b for a, b in pairwise(sessions))


def test_a_fault_stays_latched_over_hello_and_link_loss_and_only_clear_ends_it(bench):
    bench.send(bench.data(here(60_000)))
    assert (bench.state, bench.fault) == ("FAULT", "ON_TIME")
    bench.core.set_input("interlock", False, bench.now_us)
    bench.core.set_input("interlock", True, bench.now_us)
    assert bench.fault == "ON_TIME", "the first fault is kept"
    bench.hello()
    bench.core.on_link_lost(bench.now_us)
    bench.send(m.Abort(), m.Disarm())
    status = bench.status()
    assert (m.STATES[status.state], m.FAULTS[status.fault]) == ("FAULT", "ON_TIME")
    assert naks(bench.send(m.ArmReq(1))) == ["STATE"]
    bench.send(m.ClearFault())
    assert walk(bench)[-1] == ("DISARMED", "fault cleared")
    assert bench.status().fault == 0


def test_limits_sent_in_a_fault_hold_after_it(bench):
    bench.core.set_input("estop", True, bench.now_us)
    bench.core.set_input("estop", False, bench.now_us)
    bench.hello()
    assert naks(bench.send(replace(DEFAULT_LIMITS, max_on_us=10_000), m.ClearFault())) == []
    bench.arm()
    bench.send(bench.data(here(10_001)))
    assert bench.fault == "ON_TIME"


def test_a_reset_forgets_everything_and_starts_the_clock_again(bench):
    bench.play(*dim(5))
    bench.wait(9500)
    assert bench.core.gate
    bench.core.reset(bench.now_us, cause=2)
    assert not bench.core.gate
    assert bench.edges[-1][0] == bench.now_us
    assert walk(bench)[-1] == ("DISARMED", "boot")
    bench.wait(100_000)
    assert bench.send(m.Get()) == [], "the old session is gone"
    reply = bench.hello()
    assert reply.reset_cause == 2
    (clock,) = bench.send(m.ClockRequest(5))
    assert clock == m.ClockReply(5, 100_000)
    assert bench.status().done_index == 0
    bench.arm()


def test_link_loss_disarms(bench):
    bench.play(*dim(5))
    bench.wait(9500)
    bench.core.on_link_lost(bench.now_us)
    assert walk(bench)[-1] == ("DISARMED", "link lost")
    assert not bench.core.gate


# --- reports --------------------------------------------------------------------------------------------------------


def test_executed_again_when_asked(bench):
    answers = bench.play(*dim(40, on_us=100, dark_us=900)) + bench.wait(60_000)
    all_of_it = executed(answers)
    assert len(all_of_it) == 40
    assert executed(bench.send(m.GetExecuted(0))) == all_of_it[: m.RECORDS_MAX]
    assert executed(bench.send(m.GetExecuted(28))) == all_of_it[28:]
    assert executed(bench.send(m.GetExecuted(39))) == all_of_it[39:]
    assert bench.send(m.GetExecuted(40)) == []


def test_a_report_never_runs_over_a_gap_of_numbers(bench):
    bench.play(*dim(5))
    bench.wait(15_000)
    answers = bench.send(m.Flush())
    bench.index = 100
    answers += bench.play(*dim(2)) + bench.wait(50_000)
    reported = executed(bench.send(m.GetExecuted(0)))
    assert [record[0] for record in reported] == [0]
    assert [record[0] for record in executed(bench.send(m.GetExecuted(1)))] == [100, 101]


def test_a_report_never_runs_over_more_than_32_bits_of_time(bench):
    bench.play(*dim(1))
    bench.wait(20_000)
    bench.send(m.Start(2, 1, bench.now_us + (1 << 32), 1), bench.data(*dim(1)), m.End(2, 2))
    bench.core.machine.lease_until_us = bench.now_us + (1 << 33)  # more than an hour in one step
    bench.now_us += (1 << 32) + 20_000
    bench.core.advance(bench.now_us)
    assert [record[0] for record in executed(bench.take())] == [1]
    assert [record[0] for record in executed(bench.send(m.GetExecuted(0)))] == [0]


def test_status_counts(bench):
    bench.raw(b"\x01\x02\0")
    bench.raw(bench.frame(m.Get(), session=1))
    bench.core.set_input("estop", True, bench.now_us)
    status = bench.status()
    assert status.inputs == 0b111
    assert (status.crc_errors, status.format_errors, status.seq_errors) == (0, 1, 1)
    assert (m.STATES[status.state], m.FAULTS[status.fault], status.tick) == ("FAULT", "ESTOP", bench.now_us)


def test_events_tell_every_change(bench):
    answers = bench.play(*dim(1)) + bench.wait(20_000)
    events = [(m.STATES[x.state], m.EVENT_REASONS[x.reason], x.tick) for x in answers if isinstance(x, m.Event)]
    assert events == [(entry["state"], entry["reason"], entry["t_us"]) for entry in bench.of("state")[-2:]]


# --- the accounts of B5 and B6 --------------------------------------------------------------------------------------


def in_second_before(end_us, pulses):
    """Return gate-on time × duty in the second before end_us."""
    return sum(max(0, min(t + on, end_us) - max(t, end_us - WINDOW_US)) * duty for t, on, duty in pulses)


def test_mean_account_is_the_fullest_second_of_all():
    rng = random.Random(4)
    for _ in range(20):
        guards, pulses, at_us = EmissionGuards(1300), [], 0
        for _ in range(60):
            at_us += rng.randrange(0, 60_000)
            on_us, duty = rng.randrange(1, 50_000), rng.choice([100, 20_000, DUTY_FULL])
            account, before = guards.max_window_duty_us(at_us, on_us, duty), in_second_before(at_us, pulses)
            pulses = [*pulses, (at_us, on_us, duty)]
            kinks = [t + WINDOW_US for t, _, _ in pulses] + [t + on + WINDOW_US for t, on, _ in pulses]
            ends = [at_us + on_us, *rng.choices(range(at_us + 1, at_us + on_us + 1), k=5)]
            ends += [end_us for end_us in kinks if at_us < end_us < at_us + on_us]
            fullest = max(in_second_before(end_us, pulses) for end_us in ends)
            assert account in [in_second_before(end_us, pulses) for end_us in ends]
            assert fullest <= max(account, before)
            guards.record_pulse(DEFAULT_LIMITS, 0, 0, at_us, on_us, duty)
            at_us += on_us


def test_energy_is_rounded_up_and_full_duty_is_full_power():
    assert energy_uj(DEFAULT_LIMITS, 50_000, DUTY_FULL) == 122_500
    assert energy_uj(DEFAULT_LIMITS, 1, 1) == 1
    assert energy_uj(DEFAULT_LIMITS, 0, DUTY_FULL) == 0
