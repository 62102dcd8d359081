"""Scenarios of B14 and B15: a board with an internal fault turns the gate off and reports it."""

from bench import BRIGHT, here
from guard_scenarios import is_off_by
from scenario import scenario

FAILS_S = 6.0
"""Time of scripted faults, after the host has armed; an emulated watchdog may take as long again."""
WATCHDOG = 3
"""Reset cause in HELLO_REPLY."""


def failing(bench, action):
    """Run a job until a scripted internal fault turns the gate off."""
    host = bench.ready(f'[[step]]\nat_s = {FAILS_S}\ndo = "{action}"\n', **BRIGHT)
    assert host.play(*[here(10_000, dark_us=10_000, duty=2000)] * 450, end=False) == []
    host.wait(host.board.is_gate_on, "light")
    return host


# --- B14 ------------------------------------------------------------------------------------------------------------


@scenario("B14", {"a late tick": ("late_tick", "TICK"), "a gate that sticks": ("stick_gate", "READBACK")})
def internal_fault_is_immediate_and_latched(bench, case):
    action, fault = case
    host = failing(bench, action)
    board = host.board
    host.wait(lambda: board.states()[-1][0] != "RUNNING" and board.of("fault"), "the fault")
    assert board.states()[-1] == ("FAULT", "fault")
    assert [entry["fault"] for entry in board.of("fault")] == [fault]
    assert is_off_by(board, board.of("state")[-1])
    assert host.send_checked("ARM_REQ", host_nonce=1) == ["STATE"]
    assert (host.status().state, host.status().fault) == ("FAULT", fault)


@scenario("B14")
def gate_stuck_off_is_a_fault_at_the_next_pulse(bench):
    host = bench.ready('[[step]]\nat_s = 0.5\ndo = "stick_gate"\n', **BRIGHT)
    assert host.board.of("fault") == [], "it reads as it was told, until now"
    host.play(here(60_000, duty=2000), end=False)
    host.wait(lambda: host.board.of("fault") and host.board.states()[-1][0] == "FAULT", "the fault")
    assert [entry["fault"] for entry in host.board.of("fault")] == ["READBACK"]
    assert is_off_by(host.board, host.board.of("state")[-1])


# --- B15 ------------------------------------------------------------------------------------------------------------


@scenario("B15")
def stopped_main_loop_ends_in_a_reset_that_hello_reports(bench):
    host = failing(bench, "stop_loop")
    board = host.board
    host.wait(lambda: board.states()[-1] == ("DISARMED", "boot"), "the reset")
    assert not board.is_gate_on()
    host.pause(0.2, lease=False)  # earlier answers may still be in transit
    host.received.clear()
    host.send("GET")
    host.pause(0.2, lease=False)
    assert host.received == [], "a session that outlived the reset"
    assert host.hello().reset_cause == WATCHDOG
    assert host.status().state == "DISARMED"
    assert host.arm().status().state == "ARMED"
