"""Real-time priority of the planner's thread, by the kernel's word."""

import os
import threading
from math import inf

import pytest

from optodrive.core.processes import PLANNING, set_realtime_priority, use_usual_priority
from optodrive.daemon.engine import planner
from planner_rig import build_frame


def read_priority():
    return os.sched_getparam(0).sched_priority if os.sched_getscheduler(0) == os.SCHED_RR else 0


def is_permitted():
    """Return whether a thread may have the priority. The other threads of this process keep theirs."""
    read = []

    def try_it():
        set_realtime_priority(PLANNING)
        read.append(read_priority())
        use_usual_priority()

    thread = threading.Thread(target=try_it)
    thread.start()
    thread.join()
    return read == [PLANNING]


@pytest.fixture
def priorities(rig):
    """Return the priorities of the thread that plans, at the hand-over of each plan."""
    seen = []
    rig.before_loop_action = lambda: seen.append(read_priority())
    return seen


@pytest.mark.parametrize(("streamed", "expected"), [(True, PLANNING), (False, 0)])
def test_only_streamed_plans_are_made_in_real_time(rig, priorities, monkeypatch, streamed, expected):
    monkeypatch.setattr(planner, "REALTIME_MAX_S", inf)
    rig.submit(build_frame(), rig.remote.epoch, streamed).result()
    assert set(priorities) == {expected if is_permitted() else 0}
    assert read_priority() == 0


def test_a_streamed_plan_that_takes_too_long_goes_on_at_usual_priority(rig, priorities, monkeypatch):
    monkeypatch.setattr(planner, "REALTIME_MAX_S", 0.0)
    rig.submit(build_frame(), rig.remote.epoch, streamed=True).result()
    assert set(priorities) == {0}


def test_the_priority_ends_with_a_refusal(rig, priorities):
    with pytest.raises(Exception, match="target_um"):
        rig.submit(build_frame(height_um=5000.0), rig.remote.epoch, streamed=True).result()
    assert read_priority() == 0
