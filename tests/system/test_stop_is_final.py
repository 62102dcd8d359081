"""Nothing accepted before a STOP or a disarm is lit after it, judged from the board's log."""

import time

import pytest

from floods import build_full_frames
from pushes import RawPush, sent_dry_run, suspend_dry_runs
from rig import wait_for
from stop_rig import PIXELS, StopRig, is_gate_on

LARGE_FRAMES = 400
SMALL = b'{"frames":[{"show_at_s":0,"duration_s":1,"target_um":{"17":60,"18":60,"19":60}}]}'


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    rig = StopRig(tmp_path_factory.mktemp("final"))
    yield rig
    rig.close()


def end_and_arm_again(rig, ending):
    """Send STOP or disarm, arm, and return the number of events that the board had logged between the two."""
    assert rig.client.post(f"/v1/{ending}").json()["board"]["state"] == "DISARMED"
    rig.tail.read()
    begin = len(rig.tail.events)
    rig.client.post("/v1/arm").raise_for_status()
    return begin


def assert_only_a_later_push_lights(rig, begin):
    """Push, and check by the log from index `begin` on that only this push lights.

    An earlier accepted push would be in front of it.
    """
    report = rig.client.post("/v1/plans", content=SMALL).json()
    assert {plan["plan"] for plan in rig.daemon.state()["queue"]["active"]} <= {report["plan"]}
    assert rig.daemon.finished(report["plan"])["status"] == "done"
    rig.client.post("/v1/stop")
    rig.tail.read()
    assert sum(map(is_gate_on, rig.tail.events[begin:])) == report["planned"] > 0


@pytest.mark.parametrize("ending", ["stop", "disarm"])
@pytest.mark.parametrize("attempt", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in (1, 2))])
def test_a_large_push_from_before_never_lights(rig, ending, attempt):
    """400 full frames take seconds to plan. The end comes while they are read, built or planned."""
    rig.arm()
    body = build_full_frames(LARGE_FRAMES, PIXELS)
    with RawPush(rig.daemon, len(body)) as push:
        push.send(body)
        time.sleep(0.15 * attempt)
        begin = end_and_arm_again(rig, ending)
        status, answer = push.receive()
    assert_only_a_later_push_lights(rig, begin)
    assert (status, answer["code"]) == (409, "stopped")


@pytest.mark.parametrize("ending", ["stop", pytest.param("disarm", marks=pytest.mark.slow)])
def test_a_small_push_behind_dry_runs_never_lights_afterwards(rig, ending):
    """It may have been planned and lit before the end. The first dry run is suspended for as long as anything waits."""
    rig.arm()
    preview = build_full_frames(2, PIXELS)
    with RawPush(rig.daemon, len(preview), "/v1/plans?dry_run=true") as waiting:
        with sent_dry_run(rig.daemon, build_full_frames(LARGE_FRAMES, PIXELS)):
            wait_for(lambda: suspend_dry_runs(rig.daemon), "a dry run")
            waiting.send(preview)
            with RawPush(rig.daemon, len(SMALL)) as push:
                push.send(SMALL)
                begin = end_and_arm_again(rig, ending)
                push.receive()
            assert_only_a_later_push_lights(rig, begin)
        assert waiting.receive()[0] in (200, 422)  # the latter if it takes more than a minute, on a slow computer
