"""A person's matching on a daemon's display: its answers at a terminal, and the sensitivity map that they make."""

import os
import subprocess

from board_fixtures import board_disarmed, daemon_disarmed  # noqa: F401 - fixtures
from forked_process import OPTODRIVE, start_process
from optodrive.device.config_file import load_config
from optodrive.device.sensitivity_map import load_sensitivity_map, replace_sensitivity_map
from optodrive.study.study_file import EXPERIMENTS
from optodrive.study.trial_log import read_log
from rig import TOKEN

TRIALS = 6


def test_a_persons_answers_make_a_map(board, daemon, tmp_path):
    path = tmp_path / "short.toml"
    path.write_text((EXPERIMENTS / "equalisation.toml").read_text().replace("trials = 1000", f"trials = {TRIALS}"))
    process = start_process(
        [OPTODRIVE, "study", path, "--out", tmp_path / "data", "--participant", "07", "--hold", "--url", daemon.url],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "OPTODRIVE_TOKEN": TOKEN, "XDG_RUNTIME_DIR": str(tmp_path)},
    )
    output, errors = process.communicate("first\nsecond\n" * (TRIALS // 2))
    assert process.returncode == 0, errors
    written = tmp_path / "data/derivatives/sub-07_task-equalisation_sensitivity.toml"
    assert "sensitivity      07: 0." in output
    assert "variation" not in output
    known = load_sensitivity_map(replace_sensitivity_map(load_config(), written))
    assert (known.participant, known.trials) == ("07", TRIALS)
    _, trials = read_log(tmp_path / "data/sourcedata/sub-07/sub-07_task-equalisation_trials.jsonl")
    felt = [record["condition"][record["answer"]] for record in trials[:1]]
    assert known.sensitivity[felt[0]] > 1.0
    shown = {pixel for record in trials for pixel in record["presentations"][-1]["executed"]["pixel"]}
    assert shown == {record["condition"][name] for record in trials for name in ("first", "second")}
    assert board.of("gate")[-1]["on"] is False
