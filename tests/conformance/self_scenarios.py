"""Scenarios of B14 to B16: a board with an internal fault or a broken scan head turns the gate off and reports it."""

from bench import BRIGHT, PATIENT, act, here
from guard_scenarios import is_off_by
from link_scenarios import assert_no_session
from scenario import scenario

WATCHDOG = 3
"""Reset cause in HELLO_REPLY."""


def failing(bench, action, *steps, **limits):
    """Run a job of nine seconds and break a part of the board. steps: that follow"""
    host = bench.ready(act(action), *steps, **BRIGHT, **limits)
    assert host.play(*[here(10_000, dark_us=10_000, duty=2000)] * 450, end=False) == []
    host.wait(host.board.is_gate_on, "light")
    host.board.next_step()
    return host


# --- B14 ------------------------------------------------------------------------------------------------------------


@scenario("B14", {"a late tick": ("late_tick", "TICK"), "a gate that sticks": ("stick_gate", "READBACK")})
def internal_fault_is_immediate_and_latched(bench, case):
    action, fault = case
    host = failing(bench, action)
    board = host.board
    host.wait(lambda: board.states()[-1][0] != "RUNNING", "the fault")
    assert board.states()[-1] == ("FAULT", "fault")
    assert board.faults() == [fault]
    assert is_off_by(board, board.of("state")[-1])
    assert host.send_checked("ARM_REQ", host_nonce=1) == ["STATE"]
    assert (host.status().state, host.status().fault) == ("FAULT", fault)


@scenario("B14")
def tick_that_stops_is_a_fault_before_the_watchdog_bites(bench):
    """The loop alone carries out nothing that the missing tick should have."""
    host = failing(bench, "stop_tick")
    board = host.board
    board.wait(lambda: board.states()[-1] == ("DISARMED", "boot"), "the reset")
    assert board.states()[-2] == ("FAULT", "fault")
    assert board.faults() == ["TICK"]
    assert is_off_by(board, board.changes("fault")[-1])
    assert_no_session(host)
    assert host.hello().reset_cause == WATCHDOG


@scenario("B14")
def gate_stuck_on_is_a_fault_in_dark_gaps_of_two_ticks(bench):
    host = bench.ready(act("stick_gate"), **BRIGHT)
    assert host.play(*[here(10_000, dark_us=200, duty=2000)] * 900, end=False) == []
    host.wait(host.board.is_gate_on, "light")
    host.board.next_step()
    host.wait_for_change("fault")
    assert host.board.faults() == ["READBACK"]
    assert is_off_by(host.board, host.board.of("state")[-1])


@scenario("B14")
def gate_stuck_off_is_a_fault_at_the_next_pulse(bench):
    host = bench.ready(act("stick_gate"), **BRIGHT)
    host.board.next_step()
    host.pause(0.2)
    assert host.board.of("fault") == [], "it reads as it was told, until now"
    host.play(here(60_000, duty=2000), end=False)
    host.wait_for_change("fault")
    assert host.board.faults() == ["READBACK"]
    assert is_off_by(host.board, host.board.of("state")[-1])


# --- B15 ------------------------------------------------------------------------------------------------------------


@scenario("B15")
def stopped_main_loop_ends_in_a_reset_that_hello_reports(bench):
    host = failing(bench, "stop_loop")
    board = host.board
    host.wait(lambda: board.states()[-1] == ("DISARMED", "boot"), "the reset")
    assert not board.is_gate_on()
    assert_no_session(host)
    assert host.hello().reset_cause == WATCHDOG
    assert host.status().state == "DISARMED"
    assert host.arm().status().state == "ARMED"


# --- B16 ------------------------------------------------------------------------------------------------------------

HEADS = {"a head that falls silent": "silence_head", "a head that reports a fault": "fail_head"}
DIGITAL = dict(interface="xy2-100")
HEAD_READY = 0xC000


def repair_head(host):
    """Carry out the step that repairs the head, and wait for a status that says so."""
    assert host.status().head & HEAD_READY != HEAD_READY
    host.board.next_step()
    host.wait(lambda: host.status().head & HEAD_READY == HEAD_READY, "a head that is ready")


@scenario("B16", HEADS)
def head_that_is_not_ready_is_a_fault_until_it_is_again(bench, action):
    host = failing(bench, action, act("repair"), **DIGITAL)
    host.wait_for_change("fault")
    assert host.board.faults() == ["HEAD"]
    assert is_off_by(host.board, host.board.of("state")[-1])
    assert (host.status().state, host.status().fault) == ("FAULT", "HEAD")
    assert host.send_checked("CLEAR_FAULT") == ["INPUT"]
    repair_head(host)
    assert (host.status().state, host.status().fault) == ("FAULT", "HEAD"), "latched"
    assert host.send_checked("CLEAR_FAULT") == []
    assert host.arm().status().state == "ARMED"


@scenario("B16", HEADS)
def head_that_is_not_ready_at_power_up_prevents_arming_without_a_fault(bench, action):
    host = bench.greeted(act(action), act("reset"), act("repair"), **PATIENT, **DIGITAL)
    board = host.board
    board.next_step()
    host.wait_for_change("fault")
    board.next_step()
    host.wait(lambda: [state for state, _ in board.states()] == ["DISARMED", "FAULT", "DISARMED"], "the reset")
    assert host.hello().capabilities & 2
    assert host.send_checked("ARM_REQ", host_nonce=1) == ["INPUT"]
    repair_head(host)
    assert host.arm().status().state == "ARMED"
    assert board.faults() == ["HEAD"], "the one from before the reset"
