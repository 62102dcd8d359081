"""B1 to B15 of the C core: the checks of the simulated board for B1 to B13, and detection of each disabled guard."""

from functools import partial
from itertools import pairwise

import pytest
import test_board_guards as python_board
from board_bench import CENTRE, here, naks
from c_board import CBench

from c_core import CBoard
from optodrive.link.protocol import messages as m

CHECKS = {n: getattr(python_board, f"check_b{n}") for n in range(1, 14)}


def check_b14(make):
    for late_us, fault in ((600, ""), (601, "TICK")):
        b = make().ready()
        b.play(here(40_000))
        b.wait(1000)
        b.core.tick(b.now_us + late_us)
        b.now_us += late_us
        assert (b.fault, b.core.gate_output) == (fault, not fault)
    assert b.pulses[-1] == (0, b.now_us - 1601, b.now_us), "the record tells how long it really was lit"

    for pulsed in (False, True):
        b = make().ready()
        b.play(here(40_000, dark_us=0 if pulsed else 40_000))
        b.wait(1000)
        b.core.stick(True, not pulsed)
        began_us = b.now_us
        b.wait(200)
        assert b.fault == "", "it may differ for 100 µs, seen from the first tick that notices"
        b.wait(100)
        assert (b.state, b.fault) == ("FAULT", "READBACK")
        assert b.of("fault")[-1]["t_us"] - began_us == 300
        assert not b.core.relay
    b = make().ready()
    b.core.stick(True, True)
    b.wait(200)
    b.core.stick(False)
    b.wait(1000)
    b.core.stick(True, True)
    b.wait(200)
    assert b.state == "ARMED", "each difference counts by itself"


def check_b15(make):
    b = make().ready()
    assert b.now_us - b.core.fed_us <= 100, "fed while loop and tick run"
    stopped_us = b.now_us
    b.core.advance(stopped_us + 60_000, loop=False)
    assert b.core.fed_us <= stopped_us + 100, "fed by the tick alone"
    b = make().ready()
    stopped_us = b.now_us
    for _ in range(5):
        b.core._library.shim_receive(b.core._handle, b"", 0)
    assert b.core.fed_us <= stopped_us, "fed by the loop alone"


CHECKS |= {14: check_b14, 15: check_b15}


@pytest.mark.parametrize("n", CHECKS)
def test_the_core_keeps(make, n):
    CHECKS[n](make)


@pytest.mark.parametrize("n", CHECKS)
def test_a_core_without_the_guard_is_detected(libraries, n):
    without = partial(CBench, libraries(n))
    with pytest.raises(AssertionError):
        CHECKS[n](without)


# --- latency of gate off, by the time of the HAL's call --------------------------------------------------------------


def running(make, on_us=40_000, end=True, **limits):
    b = make(limits).ready()
    b.play(here(on_us), end=end)
    b.wait(1000)
    assert b.core.gate_output
    return b


def gate_off_us(b):
    assert not b.core.gate_output
    return b.core.gate_edges[-1][0]


def test_an_underrun_turns_the_gate_off_within_100_us(make):
    b = running(make, on_us=12_345, end=False)
    b.wait(20_000)
    assert b.state == "HOLD"
    assert 0 <= gate_off_us(b) - (b.core.gate_edges[0][0] + 12_345) <= 100


@pytest.mark.parametrize(("name", "unsafe"), [("interlock", False), ("key", False), ("estop", True)])
def test_an_input_turns_the_gate_off_within_1_ms(make, name, unsafe):
    b = running(make)
    b.core.inputs[name] = unsafe
    bits = sum(1 << k for k, known in enumerate(m.INPUTS) if b.core.inputs[known])
    opened_us = b.now_us
    b.core._library.shim_set_inputs(b.core._handle, bits)  # without a tick: the next one detects it
    b.wait(1000)
    assert gate_off_us(b) - opened_us <= 1000
    assert b.fault == name.upper()


def test_a_missing_lease_turns_the_gate_off_within_101_ms(make):
    b = make({"max_on_us": 65_535, "lease_ms": 100, "spot_uj": 2**32 - 1}).ready()
    b.play(*[here(60_000, x=1000 + 2000 * k) for k in range(20)])
    b.send(m.Lease(100))
    last_us = b.now_us
    b.wait(150_000, lease=False)
    assert 100_000 <= gate_off_us(b) - last_us <= 101_000
    assert b.fault == "LINK"


@pytest.mark.parametrize("what", ["abort", "link lost"])
def test_abort_and_a_lost_link_turn_the_gate_off_at_once(make, what):
    b = running(make)
    if what == "abort":
        b.raw(b.frame(m.Abort(), session=0))
    else:
        b.core.on_link_lost(b.now_us)
    assert gate_off_us(b) == b.now_us
    assert b.state == "DISARMED"


OFF_IN_TIME = {
    1: partial(test_abort_and_a_lost_link_turn_the_gate_off_at_once, what="abort"),
    2: test_an_underrun_turns_the_gate_off_within_100_us,
    3: test_a_missing_lease_turns_the_gate_off_within_101_ms,
    9: partial(test_an_input_turns_the_gate_off_within_1_ms, name="interlock", unsafe=False),
}


@pytest.mark.parametrize("n", OFF_IN_TIME)
def test_a_core_that_turns_the_gate_off_late_is_detected(libraries, n):
    with pytest.raises(AssertionError):
        OFF_IN_TIME[n](partial(CBench, libraries(n)))


# --- what ports rely on ---------------------------------------------------------------------------------------------


def test_indicator_relay_and_mirrors(make):
    b = make()
    b.hello()
    assert not b.core.indicator
    challenge = b.challenge()
    assert b.core.indicator
    b.send(m.ArmConfirm(challenge.host_nonce, challenge.board_nonce))
    b.wait(2_000_000)
    assert (b.core.indicator, b.core.relay) == (True, True)
    b.play(here(1000, x=CENTRE + 700, y=CENTRE - 900))
    b.wait(100)
    assert b.core.mirrors == (CENTRE + 700, CENTRE - 900)
    b.core.set_input("interlock", False, b.now_us)
    assert (b.core.indicator, b.core.relay) == (False, False)
    b.core.reset(b.now_us)
    assert b.core.mirrors == (CENTRE, CENTRE), "where the core takes them to be"


def test_ticks_are_late_only_after_the_first(library):
    core = CBoard(library)
    core.tick(20_000)  # board_init took a chip that long
    assert core.state == "DISARMED"
    core.tick(20_601)
    assert core.fault == "TICK"


@pytest.mark.parametrize(("name", "unsafe"), [("interlock", False), ("key", False), ("estop", True)])
def test_an_input_unsafe_at_power_up_does_not_let_arm(make, name, unsafe):
    b = make()
    b.core.set_input(name, unsafe, b.now_us)
    b.core.reset(b.now_us)
    b.hello()
    assert (b.state, naks(b.send(m.ArmReq(1)))) == ("DISARMED", ["INPUT"])
    b.core.set_input(name, not unsafe, b.now_us)
    b.arm()


def test_an_entropy_that_repeats_itself_does_not_stop_the_board(library):
    b = CBench(library)
    b.core = CBoard(library, entropy=[7])
    sessions = [b.hello().session for _ in range(3)]
    assert 0 not in sessions
    assert all(one != other for one, other in pairwise(sessions))
