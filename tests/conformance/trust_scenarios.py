"""Scenarios of B9 to B11: inputs, limits, arming."""

from itertools import pairwise

from bench import BRIGHT, CENTRE, PATIENT, act, here, set_input
from guard_scenarios import LIMIT_NAMES, is_off_by
from scenario import scenario

INPUTS = {"interlock": False, "key": False, "estop": True}
"""Unsafe levels."""
REPORTED = {"interlock": 0b010, "key": 0b001, "estop": 0b111}
"""Inputs in STATUS while one is unsafe."""
READ_S = 0.001
"""Time in which a board has read an input."""

# --- B9 -------------------------------------------------------------------------------------------------------------


@scenario("B9", {name: name for name in INPUTS})
def unsafe_input_is_latched_until_cleared(bench, name):
    unsafe = INPUTS[name]
    host = bench.ready(set_input(name, unsafe), set_input(name, not unsafe), **BRIGHT)
    board = host.board
    host.shine()
    board.next_step()
    host.wait_for_change("fault")
    (change,), (fault,) = board.of("input"), board.of("fault")
    assert fault["fault"] == name.upper()
    assert 0 <= fault["t_us"] - change["t_us"] <= 1000
    assert board.of("gate")[-1]["t_us"] <= change["t_us"] + 1000
    assert is_off_by(board, board.of("state")[-1])
    assert host.send_checked("CLEAR_FAULT") == ["INPUT"], "cleared while the cause is there"
    board.next_step()
    host.wait(lambda: len(board.of("input")) == 2, "the input's return")
    host.pause(0.05)
    assert host.status().state == "FAULT", "not latched"
    assert host.send_checked("ARM_REQ", host_nonce=1) == ["STATE"]
    assert host.send_checked("CLEAR_FAULT") == []
    assert board.states()[-1] == ("DISARMED", "fault cleared")
    assert host.send_checked("CLEAR_FAULT") == ["STATE"]


@scenario("B9", {name: name for name in INPUTS})
def unsafe_input_in_disarmed_is_ended_only_by_clear_fault(bench, name):
    host = bench.greeted(set_input(name, INPUTS[name]), **PATIENT)
    host.board.next_step()
    host.board.wait(lambda: host.board.changes("fault"), "the fault")
    host.send("ABORT")
    host.hello()
    assert host.order(host.frame("DISARM"), host.frame("CLEAR_FAULT")) == ["INPUT"]
    assert host.send_checked("ARM_REQ", host_nonce=1) == ["STATE"]
    status = host.status()
    assert (status.state, status.fault) == ("FAULT", name.upper())
    assert status.inputs == REPORTED[name]


@scenario("B9", {name: name for name in INPUTS})
def input_unsafe_at_power_up_prevents_arming_without_a_fault(bench, name):
    steps = set_input(name, INPUTS[name]), act("reset"), set_input(name, not INPUTS[name])
    host = bench.greeted(*steps, **PATIENT)
    board = host.board
    board.next_step()
    host.wait_for_change("fault")
    board.next_step()
    host.wait(lambda: [state for state, _ in board.states()] == ["DISARMED", "FAULT", "DISARMED"], "the reset")
    host.hello()
    assert host.send_checked("ARM_REQ", host_nonce=1) == ["INPUT"]
    assert (host.status().state, host.status().inputs) == ("DISARMED", REPORTED[name])
    board.next_step()
    host.wait(lambda: len(board.of("input")) == 2, "the input's return")
    assert host.arm().status().state == "ARMED"
    assert len(board.of("fault")) == 1, "the one from before the reset"


# --- B10 ------------------------------------------------------------------------------------------------------------

OWN = dict(max_on_us=20_000, max_duty=30_000, mean_duty=20_000, spot_uj=90_000, spot_leak_uw=1_000_000)
OWN |= dict(full_power_uw=2_000_000, x_min=100, x_max=62_000, y_min=200, y_max=62_700)
OWN |= dict(settle_us=300, settle_ns_per_code=60, rest_us=700, lease_ms=30_000)
MORE_IS_LOOSER = ("max_on_us", "max_duty", "mean_duty", "spot_uj", "spot_leak_uw", "x_max", "y_max", "lease_ms")
LOOSER = {name: min(65535, 2 * value) if name in MORE_IS_LOOSER else 0 for name, value in OWN.items()}
LEASE_MS = 3000
DIM = dict(duty=3000)
PAUSED = [here(0, dark_us=60_000, duty=0)]
BEYOND = {
    "max_on_us": (10_000, [here(10_001, **DIM)], "ON_TIME"),
    "max_duty": (15_000, [here(100, duty=15_001)], "DUTY"),
    "x_min": (1000, [here(0, x=999, **DIM)], "RANGE"),
    "x_max": (60_000, [here(0, x=60_001, **DIM)], "RANGE"),
    "y_min": (1000, [here(0, y=999, **DIM)], "RANGE"),
    "y_max": (60_000, [here(0, y=60_001, **DIM)], "RANGE"),
    # 20 ms of 3000/65535 are 916 µs of a second at full power, of 1000/65535 allowed: 15259 µs; seventeen are too many.
    "mean_duty": (1000, [here(20_000, dark_us=800, x=2000 * k + 1000, **DIM) for k in range(17)], "MEAN_POWER"),
    # 20 ms at 3000/65535 of 2 W are 1832 µJ.
    "spot_uj": (1831, [here(20_000, **DIM)], "SPOT"),
    "spot_leak_uw": (1000, [here(20_000, dark_us=800, duty=29_000)] * 6, "SPOT"),
    "rest_us": (2000, [here(15_000, **DIM), here(15_000, dark_us=1000, **DIM)], "ON_TIME"),
}


def tightened(**values):
    """Return the board's own limits with some tighter values."""
    return {**OWN, **values}


@scenario("B10", BEYOND)
def tightened_limits_cannot_be_loosened(bench, case):
    tight, points, fault = case
    name = next(key for key, value in BEYOND.items() if value is case)
    host = bench.greeted(**OWN)
    for requested in (tightened(**{name: tight}), LOOSER, OWN, {**LOOSER, "full_power_uw": 1}):
        assert host.send_checked("LIMITS", **requested) == []
    host.arm()
    assert host.send_checked("LIMITS", **LOOSER) == ["STATE"]
    host.play(*points)
    host.wait(lambda: host.board.states()[-1][1] in ("fault", "job done"), "the end")
    assert host.board.faults() == [fault]


@scenario("B10")
def tightened_settling_and_lease_cannot_be_loosened(bench):
    host = bench.greeted(**OWN)
    for requested in (tightened(settle_us=900, settle_ns_per_code=500, lease_ms=LEASE_MS), LOOSER, OWN):
        assert host.send_checked("LIMITS", **requested) == []
    host.arm()
    host.play(here(100, **DIM), here(100, x=CENTRE + 1000, **DIM))
    host.wait(lambda: len(host.board.pulse_numbers()) == 2, "the pulses")
    first, second = host.board.of("pulse")
    assert 0 <= second["on_us"] - first["off_us"] - 1400 <= host.board.late_us
    host.raw(host.frame("LEASE", ms=60_000) + host.frame("CLOCK", host_t=5))
    host.wait(lambda: host.of("EVENT")[-1].state == "FAULT", "the fault", lease=False)
    fault = host.of("EVENT")[-1]
    assert fault.fault == "LINK"
    assert fault.tick <= host.of("CLOCK_REPLY")[-1].tick + LEASE_MS * 1000 + host.board.late_us


@scenario("B10")
def next_session_restores_the_own_limits(bench):
    host = bench.host(bench.board(**OWN))
    reply = host.hello()
    assert {name: getattr(reply, name) for name in LIMIT_NAMES} == OWN
    assert host.send_checked("LIMITS", **tightened(max_on_us=100, x_max=40_000)) == []
    reply = host.hello()
    assert {name: getattr(reply, name) for name in LIMIT_NAMES} == OWN
    assert host.send_checked("LIMITS", **LOOSER) == []
    host.arm()
    host.play(here(20_000, x=62_000, **DIM))
    host.wait(lambda: host.board.states()[-1][1] in ("fault", "job done"), "the end")
    assert host.board.pulse_numbers() == [0]
    host.order(host.data(here(20_001, **DIM)))
    assert host.board.faults() == ["ON_TIME"]


@scenario("B10")
def limits_tightened_in_a_fault_apply_after_it(bench):
    host = bench.greeted(set_input("estop", True), set_input("estop", False), **OWN)
    for count in (1, 2):
        host.board.next_step()
        host.wait(lambda count=count: len(host.board.of("input")) == count, "the emergency stop")
        host.pause(READ_S)
    assert host.status().state == "FAULT"
    limits = host.frame("LIMITS", **tightened(max_on_us=10_000))
    assert host.order(limits, host.frame("CLEAR_FAULT")) == []
    host.arm()
    host.order(host.data(here(10_001, **DIM)))
    assert host.board.faults() == ["ESTOP", "ON_TIME"]


# --- B11 ------------------------------------------------------------------------------------------------------------

WRONG = {
    "another board_nonce": lambda c: (c.host_nonce, c.board_nonce ^ 1),
    "another host_nonce": lambda c: (c.host_nonce ^ 1, c.board_nonce),
}


@scenario("B11", WRONG)
def wrong_confirmation_disarms_and_consumes_the_challenge(bench, wrong):
    host = bench.greeted(**PATIENT)
    challenge = host.challenge()
    host_nonce, board_nonce = wrong(challenge)
    assert host.send_checked("ARM_CONFIRM", host_nonce=host_nonce, board_nonce=board_nonce) == ["NONCE"]
    assert host.board.states()[-1] == ("DISARMED", "disarm")
    right = dict(host_nonce=challenge.host_nonce, board_nonce=challenge.board_nonce)
    assert host.send_checked("ARM_CONFIRM", **right) == ["STATE"]
    again = host.challenge()
    assert again.board_nonce != challenge.board_nonce
    assert host.send_checked("ARM_CONFIRM", **right) == ["NONCE"], "an old challenge"
    host.pause(2.1)
    assert "ARMED" not in [state for state, _ in host.board.states()]


@scenario("B11")
def arming_takes_at_least_two_seconds(bench):
    host = bench.greeted(**PATIENT)
    challenge = host.challenge()
    confirm = dict(host_nonce=challenge.host_nonce, board_nonce=challenge.board_nonce)
    assert host.send_checked("ARM_CONFIRM", **confirm) == []
    assert host.send_checked("ARM_CONFIRM", **confirm) == ["STATE"]
    host.wait(lambda: host.board.states()[-1][0] == "ARMED", "ARMED")
    requested, armed = host.board.of("state")[-2:]
    assert 0 <= armed["t_us"] - requested["t_us"] - 2_000_000 <= host.board.late_us


@scenario("B11")
def unconfirmed_arming_times_out(bench):
    host = bench.greeted(**PATIENT)
    host.challenge()
    host.wait(lambda: host.board.states()[-1][1] == "arming timed out", "the time-out")
    requested, over = host.board.of("state")[-2:]
    assert 0 <= over["t_us"] - requested["t_us"] - 10_000_000 <= host.board.late_us


@scenario("B11")
def key_edge_is_required_before_each_arming(bench):
    turn = set_input("key", False), set_input("key", True)
    host = bench.greeted(*turn, *turn, key_edge=True, **PATIENT)
    assert host.of("HELLO_REPLY")[-1].capabilities & 1
    assert host.send_checked("ARM_REQ", host_nonce=1) == ["KEY_EDGE"], "a key that was on at power-up was not turned"
    for turned in (2, 4):
        for count in (turned - 1, turned):
            host.board.next_step()
            host.wait(lambda count=count: len(host.board.of("input")) == count, "the key")
            host.pause(READ_S)
        assert host.send_checked("CLEAR_FAULT") == []
        host.arm()
        assert host.send_checked("DISARM") == []
        assert host.send_checked("ARM_REQ", host_nonce=1) == ["KEY_EDGE"], "one turn arms once"


@scenario("B11")
def sessions_and_nonces_do_not_repeat(bench):
    nonces, sessions = [], []
    for _ in range(2):
        host = bench.host(bench.board(**PATIENT))
        for _ in range(6):
            sessions.append(host.hello().session)
            nonces.append(host.challenge().board_nonce)
            host.order(host.frame("DISARM"))
    assert len(set(nonces)) == len(nonces)
    assert 0 not in sessions
    assert all(one != other for one, other in pairwise(sessions))
    assert len(set(sessions)) >= len(sessions) - 2, "numbers that come back so soon can be waited for"
    steps = {(other - one) % 65536 for one, other in pairwise(sessions[:6])}
    assert len(steps) > 2, "numbers that count can be predicted"


@scenario("B11", {"the same board": "same", "a new one": "new", "after a reset": "reset"})
def replayed_session_does_not_arm(bench, where):
    host = bench.ready(act("reset"), **PATIENT)
    host.play(here(1000))
    host.wait(lambda: host.board.pulse_numbers() == [0], "the pulse")
    recorded = host.written
    host.close()
    if where == "reset":
        host.board.next_step()
        host.board.wait(lambda: len(host.board.changes("boot")) == 2, "the reset")
    else:
        host.board.wait(lambda: host.board.states()[-1][1] == "link lost", "the loss")
    board = host.board if where != "new" else bench.board(**PATIENT)
    before = len(board.events())
    again = bench.host(board)
    again.hello()
    for data in recorded:
        again.raw(data)
        again.pause(0.01, lease=False)
    for at in range(120):  # leases continue, as in a recording
        again.raw(recorded[at % len(recorded)])
        again.pause(0.02, lease=False)
    states = {entry["state"] for entry in board.events()[before:] if entry["event"] == "state"}
    assert not {"ARMED", "RUNNING"} & states
