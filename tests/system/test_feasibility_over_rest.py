"""Feasibility check over REST and on the command line, and reduced plans, on a board process."""

import json
import os

import pytest
from PIL import Image

from forked_process import run_process
from optodrive.cli.invocation import DOES_NOT_FIT
from rig import OPTODRIVE, TOKEN, running

PIXELS = [str(pixel) for pixel in range(40)]
LATE = {"frames": [{"id": "late", "show_at_s": 0.0, "duration_s": 0.1, "target_um": dict.fromkeys(PIXELS, 100)}]}
EASY = {"frames": [{"show_at_s": 0.0, "duration_s": 0.5, "target_um": {"17": 50}}]}


@pytest.fixture(scope="module")
def armed(tmp_path_factory):
    with running(tmp_path_factory.mktemp("feasibility")) as (_, daemon):
        daemon.arm()
        yield daemon


def run(*arguments):
    environment = {**os.environ, "OPTODRIVE_TOKEN": TOKEN}
    return run_process([OPTODRIVE, *arguments], capture_output=True, text=True, env=environment)


def test_an_infeasible_sequence_names_the_cause_before_execution(armed):
    before = armed.state()["totals"]
    feasibility = armed.call("POST", "/v1/plans", json=LATE, params={"dry_run": True})["summary"]["feasibility"]
    assert (feasibility["fits"], feasibility["proof"], feasibility["name"]) == (False, "bound", "late")
    assert feasibility["beam_required_s"] > feasibility["beam_available_s"]
    assert feasibility["nearest"]["pixels"]["kept"] < 40
    refused = armed.call("POST", "/v1/plans", status=409, json=LATE, params={"policy": "refuse"})
    assert refused["code"] == "refused"
    assert refused["feasibility"] == feasibility
    assert refused["detail"] == feasibility["message"]
    assert armed.state()["totals"] == before


@pytest.mark.parametrize("fit", ["even", "priority"])
def test_best_effort_is_executed_in_time(armed, fit):
    plan = armed.call("POST", "/v1/plans", json=LATE, params={"fit": fit})["plan"]
    answer = armed.finished(plan)
    assert answer["status"] == "done", answer["error"]
    summary = answer["summary"]
    assert summary["late_messages"] == []
    assert (summary["feasibility"]["height_factor"] < 1.0) == (fit == "even")
    omitted = [pixel for item in summary["feasibility"]["omitted"] for pixel in item["pixels"]]
    assert answer["executed"] == 40 - len(omitted)
    executed = answer["executed_pulses"]
    assert executed["start_s"][-1] + executed["width_s"][-1] <= summary["lead_in_s"] + 0.1 + 1e-4


def test_the_command_line_reports_it_in_one_line(armed, tmp_path):
    path = tmp_path / "frames.json"
    path.write_text(json.dumps(EASY))
    assert run("plan", path).stdout.startswith("fits: yes\n")
    path.write_text(json.dumps(LATE))
    late = run("plan", path).stdout.splitlines()[0]
    assert late.startswith("fits: no, frame late needs 0.2")
    assert "nearest feasible: " in late
    summary = json.loads(run("plan", path, "--json", "--fit", "even").stdout)
    assert summary["late_messages"] == []
    assert summary["feasibility"]["height_factor"] < 1.0
    refused = run("plan", path, "--policy", "refuse")
    assert refused.returncode == 1
    assert "nearest feasible: " in refused.stderr
    pushed = run("push", path, "--fit", "priority", "--dry-run", "--url", armed.url)
    assert "omitted          late: pixels " in pushed.stdout
    assert (pushed.returncode, pushed.stderr) == (DOES_NOT_FIT, "")
    simulated = run("simulate", path, "--pixels", "0").stdout
    assert simulated.splitlines()[0] == late


def test_what_does_not_fit_is_shown_and_has_its_own_exit_status(armed, tmp_path):
    path, film = tmp_path / "frames.json", tmp_path / "film.gif"
    path.write_text(json.dumps(LATE))
    white, grey = (Image.new("L", (32, 32), level) for level in (255, 200))
    white.save(film, save_all=True, append_images=[grey])
    shown = run("push", path, "--url", armed.url)
    assert shown.stdout.startswith("fits: no, ")
    assert "executed         40 of 40 sent" in shown.stdout
    assert (shown.returncode, shown.stderr) == (DOES_NOT_FIT, "")
    fast = run("play", "animation", film, "rate_hz=50", "--dry-run", "--url", armed.url)
    assert fast.stdout.startswith("fits: no, ")
    assert (fast.returncode, fast.stderr) == (DOES_NOT_FIT, "")
    easy = run("play", "pixel", "pixel=17", "height_um=50", "seconds=0.1", "--dry-run", "--url", armed.url)
    assert (easy.stdout[:9], easy.returncode) == ("fits: yes", 0)
