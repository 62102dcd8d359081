"""Planner and link process with a board whose reports are falsified: nothing raises, and the next plan is executed.

The clock that the planner is told stays that of the board while a proxy falsifies CLOCK_REPLY and EXECUTED.
"""

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from test_false_reports import FALSIFICATIONS, Falsification

from link_service_rig import OPERATOR, WEB
from optodrive.link.session.report_check import ReportCheck
from planner_rig import PlannerRig, build_train
from tampered_link import FIELDS, TamperedLink

CLOCK_ERROR_MAX_S = 0.01
REPORTED = [field for field in FIELDS if field.message in ("EXECUTED", "CLOCK_REPLY", "ACK", "STATUS")]


def play(rig, seconds):
    """Arm and play a train. Return its record."""
    rig.arm()
    rig.run(0.01)
    record = rig.store.find(rig.submit(build_train(seconds), rig.remote.epoch).result().plan)
    rig.until(lambda: rig.core.state == "RUNNING")
    return record


def play_with_false_reports(monkeypatch, fields, falsification, for_s):
    """Falsify reports during a train, and play another one when they are honest again."""
    rig = PlannerRig(monkeypatch, link_type=TamperedLink).ready()
    play(rig, 1.0)
    rig.run(0.1)
    rig.link.tamper(fields, falsification.build(), for_s)
    until_s = rig.clock.now_s() + for_s + 2.6
    while rig.clock.now_s() < until_s:
        rig.run(0.01)
        if rig.remote.connected:
            assert abs(rig.remote.board_s() - rig.clock.now_s()) < CLOCK_ERROR_MAX_S
    rig.until(lambda: rig.remote.connected)
    rig.await_result(OPERATOR, rig.request(OPERATOR, "stop"))
    rig.await_result(WEB, rig.request(WEB, "disarm"))
    record = play(rig, 0.1)
    rig.until(lambda: record.status not in ("queued", "running"))
    assert record.status == "done", record.error


@pytest.fixture
def patch(monkeypatch):
    return monkeypatch


@settings(
    max_examples=settings.default.max_examples // 6,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(
    fields=st.lists(st.sampled_from(REPORTED), min_size=1, max_size=2),
    falsification=FALSIFICATIONS,
    for_s=st.sampled_from([0.02, 0.2, 1.2]),
)
def test_no_false_report_ends_the_planner(patch, fields, falsification, for_s):
    play_with_false_reports(patch, fields, falsification, for_s)


FOUND = {
    "a tick that no integer holds": ("base_tick", Falsification("set", 2**63)),
    "points before the plan": ("base_tick", Falsification("set", 0)),
    "points to come": ("base_tick", Falsification("add", 10**8)),
    "a clock of centuries": ("tick", Falsification("set", 2**64 - 1)),
}


def find_fields(name):
    return [field for field in REPORTED if field.name == name and field.message in ("EXECUTED", "CLOCK_REPLY")]


@pytest.mark.parametrize("name", FOUND)
def test_reports_that_have_ended_a_process_end_the_link(monkeypatch, name):
    field, falsification = FOUND[name]
    play_with_false_reports(monkeypatch, find_fields(field), falsification, 1.2)


@pytest.mark.parametrize("name", ["a tick that no integer holds", "points to come", "a clock of centuries"])
def test_without_the_check_they_do(monkeypatch, name):
    """Mutant."""
    monkeypatch.setattr(ReportCheck, "accept", lambda *_: True)
    field, falsification = FOUND[name]
    with pytest.raises((AssertionError, OverflowError, ValueError)):
        play_with_false_reports(monkeypatch, find_fields(field), falsification, 1.2)
