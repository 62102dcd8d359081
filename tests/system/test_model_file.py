"""`--model`: plan, simulate and serve with a parameter set in the format of `diagnose`."""

import json

import pytest

from forked_process import run_process
from rig import OPTODRIVE, Board, Daemon

MODEL = """format = "optodrive-parameters"
version = 1
name = "slow diode"
base = "surroundings"
planner_terms = ["laser_turn_on"]
claims = "for tests"

[terms.laser_turn_on.time]
value = 1.5e-3
unit = "s"
source = "for tests"
"""
FRAMES = {"frames": [{"show_at_s": 0.0, "duration_s": 1.0, "target_um": {"5": 60, "6": 200, "9": 350}}]}


def run(*arguments):
    return run_process([OPTODRIVE, *arguments], capture_output=True, text=True)


@pytest.fixture
def files(tmp_path):
    model, frames = tmp_path / "model.toml", tmp_path / "frames.json"
    model.write_text(MODEL)
    frames.write_text(json.dumps(FRAMES))
    return model, frames


def answer(*arguments):
    finished = run(*arguments, "--config", "display-16", "--json")
    assert finished.returncode == 0, finished.stderr
    return json.loads(finished.stdout)


def test_plan_extends_pulses_of_a_diode_with_a_slow_turn_on(files):
    model, frames = files
    plain, slow = answer("plan", frames), answer("plan", frames, "--model", model)
    assert slow["pulses"] == plain["pulses"] == 3
    assert slow["beam_on_s"] - plain["beam_on_s"] == pytest.approx(3 * 1.5e-3, rel=0.25)
    assert slow["predicted_max_um"] == pytest.approx(350, rel=1e-3)


def test_simulate_shows_the_deviation_of_another_display(files):
    model, frames = files
    looked_at = ("--pixels", "5,6,9", "--dt", "2e-4")
    hidden = answer("simulate", frames, "--truth", model, *looked_at)
    known = answer("simulate", frames, "--truth", model, "--model", model, *looked_at)
    targets = FRAMES["frames"][0]["target_um"]
    for short, right in zip(hidden["pixels"], known["pixels"], strict=True):
        target_um = targets[str(short["pixel"])]
        assert short["measured_max_um"] < 0.97 * target_um
        assert short["predicted_max_um"] == pytest.approx(target_um, rel=1e-3)
        assert right["measured_max_um"] == pytest.approx(target_um, rel=3e-3)
    assert known["simulated_max_um"] == pytest.approx(350, rel=2e-3)


def test_the_daemon_plans_with_the_model_and_reports_it(files, tmp_path):
    model, _ = files
    board = Board(tmp_path)
    try:
        daemon = Daemon(tmp_path, board.port, name="display-16", options=("--model", model))
        try:
            terms = daemon.call("GET", "/v1/config")["pixel_model"]["planner_terms"]
            assert terms == {"laser_turn_on": {"time": 1.5e-3}}
            daemon.arm()
            plan = daemon.call("POST", "/v1/plans", json=FRAMES)
            done = daemon.finished(plan["plan"])
            assert done["status"] == "done"
            assert done["simulated_max_um"] == pytest.approx(350, rel=2e-3)
        finally:
            daemon.stop()
    finally:
        board.stop()


def test_a_model_must_be_a_toml_file(files):
    finished = run("plan", files[1], "--model", "calibrated")
    assert finished.returncode == 2
    assert finished.stderr == "optodrive: --model: got 'calibrated', expected a .toml file\n"
