"""Policies over REST on a board process: trim, delay or refuse pulses that exceed a cap."""

import pytest

from rig import running

LOW = (("touch_max_c = 48.0", "touch_max_c = 23.0"),)
FRAMES = {
    "frames": [{"show_at_s": 0.1 * k, "duration_s": 0.1, "target_um": {"200": 300, "201": 300}} for k in range(6)]
}


@pytest.fixture(scope="module")
def armed(tmp_path_factory):
    with running(tmp_path_factory.mktemp("policies"), replace=LOW) as (_, daemon):
        daemon.arm()
        yield daemon


def test_trim_names_pixel_cap_and_the_time_after_which_all_fits(armed):
    shortfall = armed.call("POST", "/v1/plans", json=FRAMES, params={"dry_run": True})["summary"]["shortfall"]
    assert shortfall["pixel"] in (200, 201)
    assert shortfall["cap"] == "touch_temperature"
    assert shortfall["margin_j"] > 0
    assert 0 < shortfall["fits_after_s"] < 10


def test_refuse_is_a_problem_document_without_execution(armed):
    answer = armed.call("POST", "/v1/plans", status=409, json=FRAMES, params={"policy": "refuse"})
    assert answer["code"] == "over_budget"
    assert answer["cap"] == "touch_temperature"
    assert answer["pixel"] in (200, 201)
    assert "the whole fits" in answer["detail"]
    totals = armed.state()["totals"]
    assert totals.pop("timing_error") is None
    assert set(totals) >= {"planned", "sent", "executed", "frames_shown"}
    assert not any(totals.values())


def test_delayed_frames_reach_their_targets(armed):
    plan = armed.call("POST", "/v1/plans", json=FRAMES, params={"policy": "delay"})["plan"]
    answer = armed.finished(plan)
    assert answer["status"] == "done", answer["error"]
    assert answer["executed"] == 12
    assert answer["summary"]["trimmed"]["pulses"] == 0
    delays = answer["summary"]["delays"]
    assert {delay["cap"] for delay in delays} == {"touch_temperature"}
    # The board executes the delays of the plan.
    starts = answer["executed_pulses"]["start_s"]
    assert starts[-1] > 0.5 + sum(delay["wait_s"] for delay in delays) - 0.1


def test_a_wrong_policy_is_rejected(armed):
    assert armed.call("POST", "/v1/plans", status=422, json=FRAMES, params={"policy": "perhaps"})["code"] == "bad_input"
