"""Scenarios of B14 to B17: a fault of the board, of its scan head or of a mirror turns the gate off and is reported."""

from bench import BRIGHT, CENTRE, PATIENT, act, here
from guard_scenarios import is_off_by
from link_scenarios import assert_no_session
from scenario import scenario

WATCHDOG = 3
"""Reset cause in HELLO_REPLY."""


def failing(bench, action, *steps, **limits):
    """Run a job of nine seconds and break a part of the board. steps: that follow"""
    host = bench.greeted(act(action), *steps, **BRIGHT, **limits)
    host.pause(0.01)  # for mirrors that are measured, the move to the centre
    host.arm()
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


# --- B17 ------------------------------------------------------------------------------------------------------------

MEASURED = dict(feedback_codes=650)
NOISE_CODES = 300
LEFT, RIGHT = 22_768, 42_768
MOVES = [here(4_000, duty=2000, x=x) for x in (LEFT, RIGHT)]
MIRRORS = {"a mirror that is stuck": "stick_mirror", "a slow mirror": "slow_mirror", "a cut wire": "unplug_mirror"}


def is_at(host, *codes):
    """Return whether mirror x is measured at one of some codes, within the noise of a converter."""
    return min(abs(host.status().mirror_x - code) for code in codes) < NOISE_CODES


def repair_mirror(host):
    """Carry out the step that repairs the mirror, and wait until it is measured where it was sent."""
    host.board.next_step()
    host.wait(lambda: is_at(host, CENTRE, LEFT, RIGHT), "a mirror where it was sent")
    host.pause(0.01)  # settled, too


@scenario("B17", MIRRORS)
def mirror_that_does_not_follow_is_a_fault_until_it_does_again(bench, action):
    """No pulse begins beside its position."""
    host = bench.greeted(act(action), act("repair"), **BRIGHT, **MEASURED)
    board = host.board
    host.pause(0.01)  # the move to the centre
    host.arm()
    assert host.play(*MOVES * 400, end=False) == []
    host.wait(board.is_gate_on, "light")
    host.pause(0.05)
    assert board.faults() == []
    board.next_step()
    host.wait_for_change("fault")
    assert board.faults() == ["SCAN"]
    assert is_off_by(board, board.of("state")[-1])
    if action == "unplug_mirror":
        assert host.status().mirror_x == 65535, "out of range"
    else:
        host.pause(0.03)  # a slow mirror arrives in the end
        number = [int(entry["reason"].split()[1]) for entry in board.of("gate") if entry["on"]][-1]
        is_there = is_at(host, MOVES[number % 2][0])
        assert is_there == (action == "stick_mirror"), "light beside its position"
    assert host.status().fault == "SCAN"
    if action != "slow_mirror":
        assert host.send_checked("CLEAR_FAULT") == ["INPUT"]
    repair_mirror(host)
    assert (host.status().state, host.status().fault) == ("FAULT", "SCAN"), "latched"
    assert host.send_checked("CLEAR_FAULT") == []
    assert host.arm().status().state == "ARMED"


@scenario("B17")
def position_output_cut_during_a_pulse_turns_the_gate_off(bench):
    host = failing(bench, "unplug_mirror", **MEASURED)
    host.wait_for_change("fault")
    assert host.board.faults() == ["SCAN"]
    assert is_off_by(host.board, host.board.of("state")[-1])


@scenario("B17")
def mirror_that_does_not_follow_at_power_up_prevents_arming_without_a_fault(bench):
    host = bench.greeted(act("unplug_mirror"), act("reset"), act("repair"), **PATIENT, **MEASURED)
    board = host.board
    host.pause(0.01)
    board.next_step()
    host.wait_for_change("fault")
    board.next_step()
    host.wait(lambda: [state for state, _ in board.states()] == ["DISARMED", "FAULT", "DISARMED"], "the reset")
    assert host.hello().capabilities & 8
    assert host.send_checked("ARM_REQ", host_nonce=1) == ["INPUT"]
    repair_mirror(host)
    assert host.arm().status().state == "ARMED"
    assert board.faults() == ["SCAN"], "the one from before the reset"
