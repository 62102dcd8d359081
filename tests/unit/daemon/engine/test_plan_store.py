"""Ended plans keep the content of their reports, in bounded memory."""

import gc
import weakref
from dataclasses import replace

import numpy as np
import pytest

from link_service_rig import OPERATOR
from optodrive.core.errors import InputError
from optodrive.core.types.plans import BudgetState, LimitedPlan
from optodrive.core.types.stimuli import FrameSequence, PulseTrain
from optodrive.daemon.engine import active_plan
from optodrive.link.protocol.quantisation import WirePoints
from optodrive.planning import pulse_table
from optodrive.planning.planned_sequence import PlannedSequence
from planner_rig import DISPLAY, build_frame, build_train

HEAVY = (type(DISPLAY.build_cold_heat()), BudgetState, WirePoints, LimitedPlan, PlannedSequence)
"""Types of what planning and execution need of a plan."""


def submit(rig, sequence, streamed=False):
    return rig.store.find(rig.submit(sequence, rig.remote.epoch, streamed).result().plan)


def list_reachable(root):
    """Return the objects that an object keeps in memory, without classes and modules."""
    found, waiting = {}, [root]
    while waiting:
        item = waiting.pop()
        if id(item) in found or isinstance(item, type) or callable(item):
            continue
        found[id(item)] = item
        waiting += gc.get_referents(item)
    return list(found.values())


def holds_heavy(record):
    return [type(item).__name__ for item in list_reachable(record) if isinstance(item, HEAVY)]


@pytest.mark.parametrize("ending", ["done", "superseded", "stopped", "cancelled", "removed"])
def test_an_ended_plan_leaves_its_report_and_no_thermal_state(rig, ending):
    blocker = submit(rig, build_train(0.3)) if ending == "removed" else None
    record = submit(rig, build_frame(60.0, duration_s=9.0), streamed=ending == "superseded")
    active = rig.queue.state.waiting[-1]
    heat, points = weakref.ref(active.before), weakref.ref(active.points)
    del active
    if blocker is None:
        rig.until(lambda: record.executed_count >= 1)
    if ending == "superseded":
        last = submit(rig, build_frame(80.0), streamed=True)
        rig.until(lambda: last.has_ended)
    elif ending == "stopped":
        rig.await_result(OPERATOR, rig.request(OPERATOR, "stop"))
    elif ending in ("cancelled", "removed"):
        rig.queue.cancel(record)
    rig.until(lambda: record.has_ended)
    rig.queue.accounts.events.clear()  # read by the telemetry
    gc.collect()
    assert record.status == ("cancelled" if ending == "removed" else ending)
    assert holds_heavy(record.newest) == []
    assert (heat(), points()) == (None, None)
    report = record.build_report(0.0)
    assert len(report.pulses.pixel) == report.planned == 16
    if ending != "removed":
        assert len(report.executed_pulses.simulated_um) == report.executed >= 1
        assert report.executed_pulses.simulated_um[0] == pytest.approx(report.pulses.predicted_um[0], rel=0.01)


def test_a_record_that_kept_its_plan_would_be_found(rig):
    record = submit(rig, build_frame())
    record = replace(record.newest, name=rig.queue.state.waiting[0])
    assert {"ActivePlan", "BudgetState"} - set(holds_heavy(record)) == {"ActivePlan"}


def test_the_report_of_a_trimmed_plan_states_its_reasons(rig):
    record = submit(rig, FrameSequence((), (PulseTrain(3, 0.0, 3.0, 0.04, 0.001, 2.4),)))
    plan = rig.queue.state.waiting[0].planned.plan
    columns = record.build_report(0.0).pulses
    assert columns.reason == plan.reason.tolist()
    assert len(set(columns.reason)) > 1
    np.testing.assert_array_equal(columns.trimmed_j, plan.trimmed_j)
    assert columns.target_um == [None] * len(plan)


def test_old_plans_make_room_for_newer_ones(rig, monkeypatch):
    first, second = (submit(rig, build_frame()) for _ in range(2))
    rig.until(lambda: second.has_ended)
    monkeypatch.setattr(active_plan, "BYTES_MAX", int(2.5 * second.nbytes))
    third = submit(rig, build_frame())
    rig.until(lambda: third.has_ended)
    with pytest.raises(InputError, match="one of the latest that ended"):
        rig.store.find(first.plan_id)
    assert rig.store.list_recent() == [second, third]


def test_a_plan_of_many_pulses_keeps_its_summary_only(rig, monkeypatch):
    monkeypatch.setattr(pulse_table, "PULSES_LISTED_MAX", 10)
    monkeypatch.setattr("optodrive.daemon.engine.plan_record.PULSES_LISTED_MAX", 10)
    record = submit(rig, build_frame())
    rig.until(lambda: record.has_ended)
    report = record.build_report(0.0)
    assert (report.pulses, report.executed_pulses, report.executed) == (None, None, 16)
    assert report.executed_complete
    assert report.simulated_max_um == pytest.approx(60.0, rel=0.01)
    assert report.max_target.simulated_um == pytest.approx(60.0, rel=0.01)
    assert record.nbytes < 2000
