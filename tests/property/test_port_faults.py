"""A port fails with any exception of its libraries, at any call: that is a lost link, and ends no process.

The faults stand below the real serial transport. The light is judged by the board's own log, the message by the error
that was injected. `tests/system/test_terminal_faults.py` shows the same with a real terminal.
"""

import random
from contextlib import contextmanager
from types import SimpleNamespace

import pytest

from link_service_rig import CONFIG, PLANNER, WEB, ServiceRig
from optodrive.core.errors import LinkError
from optodrive.link.protocol.states import BoardState
from optodrive.link.transport import serial_port
from planner_rig import build_frame
from port_fault_rig import OPENING, OTHERS, RUNNING, FaultyPort, draw_fault, install
from stage_loss_rig import LossRig
from wire_points import build_points

FAULTS = [20, pytest.param(1000, marks=pytest.mark.slow)]
STAGE_FAULTS = [(5, 2), *(pytest.param(50, seed, marks=pytest.mark.slow) for seed in range(3, 23))]
LEASE_S = CONFIG.board.lease_s
EXCHANGE_S = 0.005
CLOCK_ERROR_S = 0.001


def draw_case(rng):
    """Draw the fault that ends the link, and those that meet its closing, the look for its cause, and its return."""
    ending, at_return = draw_fault(rng, RUNNING), draw_fault(rng, OPENING)
    besides = [draw_fault(rng, [call]) for call in ("close", "stat", "holders") if rng.random() < 0.4]
    return SimpleNamespace(ending=ending, besides=besides, at_return=at_return if rng.random() < 0.6 else None)


def is_stated(fault, message):
    return fault.shown in message and message.isprintable() and "\n" not in message


def await_emission(rig):
    pulses = len(rig.list_emitted())
    rig.until(lambda: len(rig.list_emitted()) > pulses + 3)


def judge_alone(rig, case):
    """Lose the only board's link, and get it back."""
    await_emission(rig)
    broken_s = rig.clock.now_s()
    rig.link.break_board(case.ending, *case.besides)
    rig.until(lambda: not rig.boards.connected)
    error = rig.boards.link_error
    assert is_stated(case.ending, str(error)), (case, str(error))
    if case.at_return is not None:
        rig.link.repair()
        rig.link.break_board(case.at_return)
        rig.until(lambda: rig.link.raised)
        rig.run()
        assert is_stated(case.at_return, str(rig.boards.link_error)), (case, str(rig.boards.link_error))
    rig.link.repair()
    rig.run(LEASE_S + EXCHANGE_S)
    rig.core.advance(rig.link._now_us())
    emitted_s = [entry["off_us"] * 1e-6 for entry in rig.log if entry["event"] == "pulse"]
    assert max(emitted_s) <= broken_s + LEASE_S + EXCHANGE_S, "light after the lease"
    assert not rig.core.gate
    rig.connect()
    assert rig.boards.state in (BoardState.DISARMED, BoardState.FAULT), "armed by itself"
    assert rig.boards.link_error is None
    if rig.boards.state == BoardState.FAULT:
        assert rig.await_result(WEB, rig.request(WEB, "disarm"))["error"] is None


def forget_messages(rig):
    """Drop what clients have received, so that a search takes no longer from case to case."""
    for client, messages in rig.received.items():
        if client != PLANNER:
            messages.clear()


def run_alone(monkeypatch, count, seed=1):
    rng, rig = random.Random(seed), ServiceRig(link_type=FaultyPort)
    install(monkeypatch)
    rig.hello_all().connect()
    for _ in range(count):
        rig.arm()
        rig.begin(build_points(2000, 1000))
        judge_alone(rig, draw_case(rng))
        rig.log.clear()
        forget_messages(rig)


@pytest.mark.parametrize("count", FAULTS)
def test_any_exception_at_a_port_is_a_lost_link(monkeypatch, count):
    run_alone(monkeypatch, count)


# --- one of two stages


def draw_frames(rig):
    """Keep the beams busy, and return the number of pulses of each board."""
    if all(record.has_ended for record in rig.store.list_recent()):
        rig.push(build_frame(60.0))
    return [sum(entry["event"] == "pulse" for entry in log) for log in rig.logs]


def judge_one_of_two(rig, rng):
    """Lose the link of one stage, let its port fail again at its return, and check that the other draws on."""
    case, stage = draw_case(rng), rng.randrange(2)
    link, began = rig.links[stage], draw_frames(rig)
    rig.until(lambda: min(now - was for now, was in zip(draw_frames(rig), began, strict=True)) > 0)
    link.break_board(case.ending, *case.besides)
    rig.until(lambda: rig.boards.lost is not None)
    assert rig.boards.lost.stage == stage
    assert is_stated(case.ending, rig.boards.lost.reason), (case, rig.boards.lost.reason)
    rig.until(lambda: not rig.boards.sessions[stage].connected)  # a port that is only full may have room again
    link.repair()
    if case.at_return is not None:
        link.break_board(case.at_return)
        rig.until(lambda: link.raised)
        rig.run()
        stated = rig.boards.list_stages()[stage]["error"]
        assert is_stated(case.at_return, stated), (case, stated)
        link.repair()
    rig.until(lambda: rig.clock.now_s() > rig.boards.lost.dark_s)
    went_on = draw_frames(rig)[1 - stage]
    rig.until(lambda: draw_frames(rig)[1 - stage] > went_on + 3)
    assert rig.boards.lost is not None
    rig.cores[stage].advance(link._now_us())
    emitted_s = [entry["off_us"] * 1e-6 for entry in rig.logs[stage] if entry["event"] == "pulse"]
    dark_s = max(end_s for _, end_s in link.grants)
    assert link.board_clock.find_true_s(max(emitted_s)) <= dark_s + CLOCK_ERROR_S, "light after the lease"
    rig.stop()
    rig.restore(stage)


@pytest.mark.parametrize(("count", "seed"), STAGE_FAULTS)
def test_any_exception_at_the_port_of_a_stage_loses_that_stage_alone(monkeypatch, count, seed):
    install(monkeypatch)
    rng, rig = random.Random(seed), LossRig(monkeypatch, 2, link_type=FaultyPort)
    for _ in range(count):
        judge_one_of_two(rig, rng)
        forget_messages(rig)


# --- mutants


@contextmanager
def guard_system_errors(name):
    """Mutant: only errors of the operating system are caught."""
    try:
        yield
    except OSError as error:
        raise LinkError(f"link to {name} lost: {error}") from None


@pytest.mark.parametrize("guard", ["guard_port", "guard_opening"])
def test_a_transport_that_catches_only_errors_of_the_system_is_caught(monkeypatch, guard):
    monkeypatch.setattr(serial_port, guard, lambda name, key="": guard_system_errors(name))
    with pytest.raises(tuple({type(error) for error in OTHERS} - {OSError})):
        run_alone(monkeypatch, 30)
