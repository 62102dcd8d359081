"""The C core's calls of its HAL and the tolerances of B14 and B15, which ports rely on and the wire does not show."""

from functools import partial
from itertools import pairwise

import pytest
from bench import BRIGHT, CENTRE, PATIENT, Bench, here
from virtual_board import VirtualKind

from c_core import CBoard, SeededCBoard


@pytest.fixture
def bench(library, tmp_path):
    return Bench(VirtualKind("c", partial(SeededCBoard, library)), tmp_path)


def emit(bench, dark_us=0):
    """Return a core that emits a pulse or waits for one, its board's log and the time of its last tick."""
    host = bench.ready(**BRIGHT)
    host.play(here(60_000, dark_us=dark_us), end=False)
    host.pause(0.01)
    assert host.board.is_gate_on() == (dark_us == 0)
    return host.board.core, host.board, host.clock.now_us()


# --- B14 ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("run", [CBoard.tick, CBoard.loop], ids=["tick", "loop"])
@pytest.mark.parametrize(("late_us", "fault"), [(600, ""), (601, "TICK")])
def test_a_tick_may_be_half_a_millisecond_late(bench, late_us, fault, run):
    core, board, now_us = emit(bench)
    run(core, now_us + late_us)
    assert (core.fault, core.gate_output) == (fault, not fault)
    pulses = [(pulse["index"], pulse["off_us"]) for pulse in board.of("pulse")]
    assert pulses == ([(0, now_us + late_us)] if fault else []), "the record tells how long it really was lit"


def test_ticks_are_late_only_after_the_first(library):
    core = CBoard(library)
    core.tick(20_000)  # board_init took a chip that long
    assert core.state == "DISARMED"
    core.tick(20_601)
    assert core.fault == "TICK"


@pytest.mark.parametrize("dark_us", [0, 60_000], ids=["on", "off"])
def test_a_gate_may_differ_from_its_command_for_a_tick(bench, dark_us):
    core, board, now_us = emit(bench, dark_us)
    core.stick(True, not core.gate_output)
    core.advance(now_us + 200)
    assert core.fault == "", "it may differ for 100 µs, seen from the first tick that notices"
    core.advance(now_us + 300)
    assert (core.state, core.fault, core.relay) == ("FAULT", "READBACK", False)
    assert board.of("fault")[-1]["t_us"] == now_us + 300


def test_each_difference_of_the_gate_counts_by_itself(bench):
    core, _, now_us = emit(bench, dark_us=60_000)
    core.stick(True, True)
    core.advance(now_us + 200)
    core.stick(False)
    core.advance(now_us + 1200)
    core.stick(True, True)
    core.advance(now_us + 1400)
    assert core.fault == ""


def check_short_gaps(bench):
    host = bench.ready(**BRIGHT)
    host.play(*[here(1000, dark_us=200)] * 200, end=False)
    host.pause(0.01)
    core, now_us = host.board.core, host.clock.now_us()
    core.stick(True, True)
    core.advance(now_us + 10_000)
    assert core.fault == "READBACK"


def test_a_gate_stuck_on_is_noticed_over_dark_gaps_of_two_ticks(bench):
    check_short_gaps(bench)


def test_a_readback_that_each_pulse_excuses_is_detected(libraries, tmp_path):
    bench = Bench(VirtualKind("c", partial(SeededCBoard, libraries(106))), tmp_path)
    with pytest.raises(AssertionError):
        check_short_gaps(bench)


# --- B15 ------------------------------------------------------------------------------------------------------------


def check_watchdog(bench):
    core, _, now_us = emit(bench)
    core.advance(now_us)
    assert now_us - core.fed_us <= 100, "fed while loop and tick run"
    for _ in range(5):
        core.run_loop()
    assert core.fed_us == now_us, "fed by the loop alone"
    core.advance(now_us + 60_000, loop=False)
    assert core.fed_us <= now_us + 100, "fed by the tick alone"


def test_loop_and_tick_feed_the_watchdog_together(bench):
    check_watchdog(bench)


def test_a_watchdog_fed_by_the_tick_alone_is_detected(libraries, tmp_path):
    bench = Bench(VirtualKind("c", partial(SeededCBoard, libraries(15))), tmp_path)
    with pytest.raises(AssertionError, match="fed by the tick alone"):
        check_watchdog(bench)


# --- B9 -------------------------------------------------------------------------------------------------------------


def check_unsafe_tick(bench):
    core, board, _ = emit(bench, dark_us=60_000)
    due_us = board.changes("start")[0]["t_us"] + 60_000
    core.set_input("interlock", False, due_us - 50)
    core.tick(due_us + 40)
    assert core.fault == "INTERLOCK"
    assert core.gate_edges == []


def test_no_pulse_begins_in_the_tick_that_sees_an_unsafe_input(bench):
    check_unsafe_tick(bench)


def test_a_pulse_that_begins_with_an_unsafe_input_is_detected(libraries, tmp_path):
    bench = Bench(VirtualKind("c", partial(SeededCBoard, libraries(105))), tmp_path)
    with pytest.raises(AssertionError):
        check_unsafe_tick(bench)


# --- outputs and entropy --------------------------------------------------------------------------------------------


def test_indicator_relay_and_mirrors(bench):
    host = bench.greeted(**PATIENT)
    core = host.board.core
    assert not core.indicator
    host.challenge()
    assert core.indicator
    host.order(host.frame("DISARM"))
    assert not core.indicator
    host.arm()
    assert (core.indicator, core.relay) == (True, True)
    host.play(here(1000, x=CENTRE + 700, y=CENTRE - 900))
    host.pause(0.01)
    assert core.mirrors == (CENTRE + 700, CENTRE - 900)
    core.set_input("interlock", False, host.clock.now_us())
    host.pause(0.01)
    assert (core.indicator, core.relay) == (False, False)
    core.reset(host.clock.now_us())
    assert core.mirrors == (CENTRE, CENTRE), "where the core takes them to be"


def test_an_entropy_that_repeats_itself_does_not_stop_the_board(library, tmp_path):
    def make_core(settings, sink, seed):
        return CBoard(library, settings, sink, entropy=[7])

    host = Bench(VirtualKind("c", make_core), tmp_path).greeted()
    sessions = [host.hello().session for _ in range(3)]
    assert 0 not in sessions
    assert all(one != other for one, other in pairwise(sessions))


# --- the trigger ----------------------------------------------------------------------------------------------------


def start_after_an_edge(library, tmp_path):
    """Let an edge come that no tick has seen yet, then START_ON_TRIGGER without a tick between. Return the board."""
    host = Bench(VirtualKind("c", partial(SeededCBoard, library)), tmp_path).ready(**BRIGHT)
    host.order(host.data(here(300, duty=999)))
    core, now_us = host.board.core, host.clock.now_us()
    library.shim_trigger(core._handle, now_us - 50)
    core.run_loop(host.frame("START_ON_TRIGGER", job=1, first_index=0, delay_us=1000, wait_ms=100))
    core.advance(now_us + 10_000)
    return host.board


def test_an_edge_that_precedes_its_job_is_not_its_trigger(library, tmp_path):
    board = start_after_an_edge(library, tmp_path)
    assert (board.core.state, board.of("gate")) == ("RUNNING", [])


def test_a_board_that_takes_an_earlier_edge_is_seen(libraries, tmp_path):
    assert start_after_an_edge(libraries(107), tmp_path).of("gate")


def test_an_edge_of_the_future_is_one_of_now(library, tmp_path):
    """A port whose capture is wrong delays no job beyond its delay."""
    host = Bench(VirtualKind("c", partial(SeededCBoard, library)), tmp_path).ready(**BRIGHT)
    host.order(host.data(here(300, duty=999)))
    core, now_us = host.board.core, host.clock.now_us()
    core.run_loop(host.frame("START_ON_TRIGGER", job=1, first_index=0, delay_us=1000, wait_ms=100))
    library.shim_trigger(core._handle, now_us + 50)
    core.advance(now_us + 10_000)
    (pulse,) = host.board.of("pulse")
    assert pulse["on_us"] <= now_us + 1000 + 100
