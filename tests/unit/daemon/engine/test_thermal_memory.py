"""A planner process leaves heat and budget to its successor, never less than may have been emitted."""

import numpy as np
import pytest

from optodrive.daemon.engine.active_plan import PlanStore
from optodrive.daemon.engine.plan_queue import HOLD_MAX_S, PlanQueue
from optodrive.daemon.engine.plan_rest import HEADER, LENGTH, ThermalMemory
from optodrive.planning.limiter.cap_checks import compute_levels
from planner_rig import DISPLAY, InlineExecutor, build_frame, build_train


def submit(rig, sequence):
    return rig.store.find(rig.submit(sequence, rig.remote.epoch).result().plan)


def restart(rig, later_s=0.0):
    """Restart the queue from the content of a dead one's memory.

    later_s: time without a planner
    """
    memory = ThermalMemory()
    memory.save(rig.queue.build_saved_state(rig.clock.now_s()))
    rig.run(later_s)
    successor = PlanQueue(DISPLAY, rig.remote, PlanStore(), InlineExecutor())
    successor.restore(memory.load(), rig.clock.now_s())
    return successor


def levels(queue, rig):
    snapshot = queue.make_snapshot(streamed=False, planning_time_s=0.0)
    return compute_levels(snapshot.before.budget, DISPLAY.budget, 0.0), snapshot.start_s - rig.remote.board_s()


def test_a_successor_knows_the_heat_of_ended_plans(rig):
    plan = submit(rig, build_train(2.0))
    rig.until(lambda: plan.has_ended)
    now_s, known = rig.remote.board_s(), rig.queue.make_snapshot(streamed=False, planning_time_s=0.0)
    inherited = restart(rig).make_snapshot(streamed=False, planning_time_s=0.0)
    before = compute_levels(known.before.budget, DISPLAY.budget, now_s - known.start_s)
    # Pulses count as if the board had emitted them as late as it may.
    after = compute_levels(inherited.before.budget, DISPLAY.budget, now_s + HOLD_MAX_S - inherited.start_s)
    assert before[1].max() > 10.0
    np.testing.assert_allclose(after, before, rtol=1e-9, atol=1e-12)


def test_a_running_plan_counts_up_to_now_and_not_to_its_end(rig):
    plan = submit(rig, build_train(60.0))
    rig.until(lambda: plan.executed_count > 50)
    inherited, starts_in_s = levels(restart(rig), rig)
    assert starts_in_s < 2.0
    cold, _ = levels(PlanQueue(DISPLAY, rig.remote, PlanStore(), InlineExecutor()), rig)
    assert inherited[1].max() > 10.0 > cold[1].max()


def test_time_without_a_planner_cools_the_display(rig):
    plan = submit(rig, build_frame(90.0))
    rig.until(lambda: plan.has_ended)
    at_once, _ = levels(restart(rig), rig)
    later, _ = levels(restart(rig, later_s=3.0), rig)
    assert later[1].max() < at_once[1].max()


class EndedError(Exception):
    """In place of the end of the process."""


class EndingLength:
    """LENGTH of a process that ends before it writes a part."""

    size, unpack_from = LENGTH.size, LENGTH.unpack_from

    def __init__(self, part):
        self._left = part

    def pack_into(self, *where):
        """Write a length, or end."""
        if not self._left:
            raise EndedError
        self._left -= 1
        LENGTH.pack_into(*where)


@pytest.mark.parametrize("part", range(12))
def test_a_state_that_was_written_in_part_leaves_the_one_before(rig, monkeypatch, part):
    memory = ThermalMemory()
    assert memory.load() is None
    states = [rig.queue.build_saved_state(float(k)) for k in range(4)]
    for state in states[:3]:
        memory.save(state)
    with monkeypatch.context() as ending:
        ending.setattr("optodrive.daemon.engine.plan_rest.LENGTH", EndingLength(part))
        with pytest.raises(EndedError):
            memory.save(states[3])
    loaded = memory.load()
    assert loaded.host_s == 2.0
    np.testing.assert_array_equal(loaded.estimate.budget.rise_k, states[2].estimate.budget.rise_k)
    memory.save(states[3])
    assert memory.load().host_s == 3.0


def test_a_state_beyond_its_room_is_refused(rig, monkeypatch):
    monkeypatch.setattr("optodrive.daemon.engine.plan_rest.SLOT_BYTES", HEADER.size + 10)
    memory = ThermalMemory()
    with pytest.raises(ValueError, match="exceeds its room"):
        memory.save(rig.queue.build_saved_state(1.0))
