"""Pause and resume of a real daemon on a board process, judged from the board's log."""

import os
import time

import pytest

from forked_process import run_process
from optodrive.client import Display
from rig import OPTODRIVE, TOKEN, long_train, running, wait_for

ON_US = 10_000
WATCH_S = 20 * 0.02
"""Time of twenty pulses, of which a pause shows none."""


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    folder = tmp_path_factory.mktemp("kept")
    audit = ("lease_s = 1.0", f'lease_s = 1.0\n[daemon]\naudit = "{folder}/audit.jsonl"\n#')
    with running(folder, replace=[audit]) as board_and_daemon:
        yield board_and_daemon


@pytest.fixture
def board(kept):
    return kept[0]


@pytest.fixture
def daemon(kept):
    daemon = kept[1]
    daemon.call("POST", "/v1/stop")
    kept[0].forget()
    daemon.arm()
    return daemon


def start_train(daemon, board, seconds):
    """Start a train and return its plan once it emits."""
    plan = daemon.call("POST", "/v1/plans", json=long_train(seconds=seconds))["plan"]
    wait_for(lambda: len(board.of("pulse")) > 5, "light")
    return plan


def is_dark(board):
    return not any(event["on"] for event in board.of("gate")[-1:])


def check_paused(daemon, board, plan):
    """Require the state of an answered pause, and no light since. Return the number of pulses so far."""
    emitted = len(board.of("pulse"))
    state = daemon.state()
    (active,) = state["queue"]["active"]
    assert (state["board"]["state"], state["queue"]["paused"]) == ("ARMED", True)
    assert 0 < state["queue"]["pause_ends_in_s"] <= 300
    assert (active["plan"], active["status"], active["ends_in_s"]) == (plan, "paused", None)
    assert (state["queue"]["running"], state["queue"]["waiting"]) == (plan, 0)

    def find_paused():
        """Return the plan's report once the planner knows of the pause, which the board has confirmed already."""
        report = daemon.call("GET", f"/v1/plans/{plan}")
        return report["status"] == "paused" and report

    report = wait_for(find_paused, "the report of a paused plan")
    assert (report["executed"], report["sent"]) == (emitted, emitted)
    time.sleep(WATCH_S)
    assert len(board.of("pulse")) == emitted
    assert is_dark(board)
    return emitted


def test_pauses_are_dark_at_once_and_resume_plays_exactly_the_rest(daemon, board):
    plan = start_train(daemon, board, seconds=3.0)
    for _ in range(3):
        daemon.call("POST", "/v1/pause")
        emitted = check_paused(daemon, board, plan)
        daemon.call("POST", "/v1/resume")
        wait_for(lambda count=emitted: len(board.of("pulse")) > count + 5, "light after the resumption")
    report = daemon.finished(plan)
    pulses = board.of("pulse")
    assert report["status"] == "done"
    assert len(pulses) == report["executed"] == report["planned"] == 150
    assert report["executed_complete"]
    cut = [event for event in pulses if event["off_us"] - event["on_us"] != ON_US]
    assert len(cut) <= 3
    widths_us = [event["off_us"] - event["on_us"] for event in pulses]
    assert report["executed_pulses"]["width_s"] == pytest.approx([1e-6 * width_us for width_us in widths_us])
    assert {event["state"] for event in board.of("state")} == {"ARMED", "RUNNING", "ARMING"}
    assert daemon.state()["queue"]["paused"] is False


def test_frames_that_are_pushed_as_the_newest_are_refused_and_others_wait(daemon, board):
    plan = start_train(daemon, board, seconds=1.0)
    with Display(daemon.url, TOKEN) as display:
        state = display.pause()
        assert (state.queue.paused, state.queue.active[0].status) == (True, "paused")
        problem = daemon.call("POST", "/v1/plans", 409, json=long_train(), params={"newest": True})
        assert problem["code"] == "not_ready"
        assert "the light is paused" in problem["detail"]
        waiting = daemon.call("POST", "/v1/plans", json=long_train(pixel=100, seconds=0.2))["plan"]
        assert daemon.state()["queue"]["waiting"] == 1
        assert display.resume().queue.paused is False
        for plan_id, pulses in ((plan, 50), (waiting, 10)):
            report = daemon.finished(plan_id)
            assert (report["status"], report["executed"]) == ("done", pulses)
    assert len(board.of("pulse")) == 60


def test_commands_pause_and_resume(daemon, board):
    plan = start_train(daemon, board, seconds=1.0)
    environment = os.environ | {"OPTODRIVE_URL": daemon.url, "OPTODRIVE_TOKEN": TOKEN}
    for command, expected in (("pause", "dark until `optodrive resume`; disarms in"), ("resume", "running")):
        ended = run_process([OPTODRIVE, command], env=environment, capture_output=True, text=True)
        assert (ended.returncode, ended.stderr) == (0, "")
        assert expected in ended.stdout
    assert daemon.finished(plan)["executed"] == 50
