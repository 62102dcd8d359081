"""The planner keeps the record of the display's heat: around light, over its own end, and on a full disk."""

import errno
import os
from types import SimpleNamespace

import pytest

from heat_world import BENCH_PLAN, DISPLAY, MUCH_LIGHT, UIDS, ServeRig, new_world, release
from link_service_rig import WEB
from optodrive.core.errors import InputError, NotReadyError
from optodrive.daemon.engine.kept_heat import KeptHeat
from optodrive.lab.commissioning.exclusive_board import ExclusiveBoard
from optodrive.link.simulator.virtual_run import MemoryLink
from optodrive.planning import heat_record
from planner_rig import InlineExecutor


@pytest.fixture
def world():
    with new_world() as world:
        world.record_cold()
        yield world


@pytest.fixture
def rig(world, monkeypatch):
    return ServeRig(monkeypatch, world).ready()


def read_record(world):
    """Return why the display would be hot for the next process."""
    with heat_record.HeatRecord(heat_record.BOARDS, UIDS[0], DISPLAY, world.clock) as record:
        record.load()
        return record.hot_reason


def push(rig, sequence=MUCH_LIGHT):
    return rig.submit(sequence, rig.remote.epoch).result()


def touch_k(rig):
    """Return the bound on the hottest touch surface now."""
    return float(rig.queue.state.thermal.budget.touch_k.max())


def test_no_light_comes_before_the_record_says_that_the_display_is_in_use(rig, monkeypatch):
    entries = []
    write = heat_record.HeatRecord._write

    def note(record, budget, zero_s):
        entries.append(("free" if budget else "in use", len(rig.log)))
        write(record, budget, zero_s)

    monkeypatch.setattr(heat_record.HeatRecord, "_write", note)
    for _ in range(2):
        rig.arm()
        rig.pass_time(0.02)
        push(rig)
        rig.pass_time(1.0)
        rig.await_result(WEB, rig.request(WEB, "disarm"))
        rig.pass_time(0.1)
    assert [name for name, _ in entries] == ["in use", "free"] * 2
    gates_on = [number for number, event in enumerate(rig.log) if event["event"] == "gate" and event["on"]]
    for began, ended in ((0, 1), (2, 3)):
        during = [number for number in gates_on if entries[began][1] <= number < entries[ended][1]]
        assert during
        gates_on = [number for number in gates_on if number not in during]
    assert not gates_on


def test_a_display_without_a_use_is_not_written(rig, world):
    path = world.folder / "heat" / f"board-{UIDS[0]}"
    before = path.read_bytes()
    rig.pass_time(1.0)
    assert path.read_bytes() == before
    rig.heat.close()
    assert not read_record(world)


def test_a_command_cannot_use_the_display_of_a_daemon(rig, world):
    held = ExclusiveBoard(DISPLAY, MemoryLink(world.core, world.clock), world.clock)
    with pytest.raises(InputError, match=f"board-{UIDS[0]}: got 'in use', expected no other process"):
        held.connect()
    held.close()
    assert rig.heat.may_emit is False


def test_a_daemon_awaits_the_end_of_a_command(world, monkeypatch):
    held = ExclusiveBoard(DISPLAY, MemoryLink(world.core, world.clock), world.clock)
    held.connect()
    record, held._record = held._record, None
    rig = ServeRig(monkeypatch, world).ready()
    rig.pass_time(0.1)
    with pytest.raises(NotReadyError, match="got 'in use', expected no other process"):
        rig.heat.require_known()
    record.close()
    rig.pass_time(2.0)
    rig.heat.require_known()


def test_a_full_disk_ends_plans_with_its_reason_and_emits_nothing(rig, monkeypatch):
    def refuse(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as full:
        full.setattr(heat_record, "os", SimpleNamespace(**(vars(os) | {"pwrite": refuse})))
        rig.arm()
        rig.pass_time(0.02)
        with pytest.raises(
            NotReadyError, match="No space left on device', expected a file that can be written; nothing"
        ):
            push(rig)
        rig.pass_time(0.5)
    assert not [event for event in rig.log if event["event"] == "gate" and event["on"]]
    rig.pass_time(1.5)
    push(rig)
    rig.pass_time(0.5)
    assert [event for event in rig.log if event["event"] == "gate" and event["on"]]


def succeed(rig, continues=True):
    """Replace the planner's part of the record as a planner process that starts again does."""
    release(rig.heat._record)
    heat = KeptHeat(DISPLAY, rig.remote, rig.queue, rig.clock, InlineExecutor(), "a daemon")
    follow = heat.follow
    heat.follow = lambda _: follow(continues)
    rig.heat = heat
    return heat


def light_and_kill(rig):
    """Kill a planner process while its light is on. What its successor knows of the heat counts all of the light."""
    rig.arm()
    rig.pass_time(0.02)
    push(rig)
    rig.pass_time(1.0)
    release(rig.heat._record)
    rig.heat.follow = lambda _: None
    rig.await_result(WEB, rig.request(WEB, "stop"))
    rig.pass_time(0.1)


def test_the_successor_of_a_planner_goes_on_with_its_memory(rig, world):
    light_and_kill(rig)
    before_k = touch_k(rig)
    succeed(rig)
    rig.pass_time(0.1)
    rig.heat.require_known()
    assert touch_k(rig) == before_k
    assert rig.heat.read_cooling() == ("", 0.0)
    rig.heat.close()
    assert not read_record(world)


def test_the_memory_of_a_planner_does_not_count_once_another_process_has_used_the_record(rig, world):
    light_and_kill(rig)
    before_k = touch_k(rig)
    with heat_record.HeatRecord(heat_record.BOARDS, UIDS[0], DISPLAY, world.clock) as record:
        record.load()
        record.begin_use()
    succeed(rig)
    rig.pass_time(0.1)
    assert touch_k(rig) > before_k
    assert "killed" in rig.heat.read_cooling()[0]


def test_a_board_that_replaces_another_one_finds_a_hot_display(rig, world):
    """Its record may say that its former display is cold."""
    world.record_cold(UIDS[1])
    world.use_board(UIDS[1])
    rig.link._core = rig.core = world.core
    rig.pass_time(3.0)
    rig.until(lambda: rig.remote.connected and rig.remote.board.uid == UIDS[1])
    rig.pass_time(0.1)
    assert rig.heat.read_cooling()[0] == "its board was replaced"
    with heat_record.HeatRecord(heat_record.BOARDS, UIDS[0], DISPLAY, world.clock) as record:
        record.load()
        assert not record.hot_reason


def test_an_interrupted_command_counts_as_if_all_of_its_plan_came_at_the_end(world):
    held = ExclusiveBoard(DISPLAY, MemoryLink(world.core, world.clock), world.clock)

    def give_up(_job):
        raise KeyboardInterrupt

    held.connect()
    held.arm()
    with pytest.raises(KeyboardInterrupt):
        held.play(BENCH_PLAN, give_up)
    held.close()
    world.pass_time(0.2)
    with heat_record.HeatRecord(heat_record.BOARDS, UIDS[0], DISPLAY, world.clock) as record:
        assert record.load().at_s > 0.0
        assert not record.hot_reason


def test_a_command_whose_light_was_not_as_planned_leaves_a_hot_display(world):
    held = ExclusiveBoard(DISPLAY, MemoryLink(world.core, world.clock), world.clock)
    held.connect()
    held.arm()
    held._is_known = False
    held.close()
    assert "killed" in read_record(world)


def test_a_command_says_why_its_display_is_hot(world):
    world.do("lose")
    said = []
    held = ExclusiveBoard(DISPLAY, MemoryLink(world.core, world.clock), world.clock, on_warm=said.append)
    held.connect()
    held.close()
    (text,) = said
    assert text.startswith(
        "the display counts as hot, because this machine had no record of its heat; it cools within "
    )
