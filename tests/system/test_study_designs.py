"""Ten published designs: each runs to its end through kill -9 at random moments, and its dataset is valid."""

import csv
import random
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

from forked_process import OPTODRIVE, start_process
from optodrive.study.study_file import list_shipped_studies, load_study
from rig import wait_for
from study_rig import find_defects, read_records

VALIDATOR = Path(sys.executable).with_name("bids-validator-deno")
IN_EVERY_RUN = ("frequency-discrimination", "height-threshold")
DESIGNS = [name for name in list_shipped_studies() if not name.startswith(("experiment-", "detection", "equalisation"))]
KILLS = 2


def start_study(folder, name):
    command = [OPTODRIVE, "study", name, "--out", folder]
    return start_process(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def count_trials(path):
    return sum(record["record"] == "trial" for record in read_records(path))


def has_reached(process, path, count):
    return process.poll() is not None or count_trials(path) >= count


def read_table(path):
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file, delimiter="\t"))


def test_there_are_ten():
    assert len(DESIGNS) == 10


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name in IN_EVERY_RUN else pytest.mark.slow) for name in DESIGNS]
)
def test_a_design_has_every_trial_once_and_a_valid_dataset(tmp_path, name):
    study, rng = load_study(name), random.Random(name)
    ses = "_ses-1" if study.sessions > 1 else ""
    path = tmp_path / f"sourcedata/sub-sim01/sub-sim01{ses}_task-{study.task}_trials.jsonl"
    for _ in range(KILLS):
        process = start_study(tmp_path, name)
        moment = partial(has_reached, process, path, rng.randrange(1, study.trial_count))
        wait_for(moment, "the moment", rng.uniform(0.0, 0.005))
        process.kill()
        process.communicate()
    process = start_study(tmp_path, name)
    _, errors = process.communicate()
    assert process.returncode == 0, errors
    logs = sorted(tmp_path.glob("sourcedata/*/*.jsonl"))
    tables = sorted(tmp_path.glob("sub-sim01/**/*_beh.tsv"))
    assert len(logs) == len(tables) == study.sessions
    for log, table in zip(logs, tables, strict=True):
        check_session(study, read_records(log), read_table(table))
    done = subprocess.run([VALIDATOR, tmp_path, "--max-rows", "-1"], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def check_session(study, records, rows):
    assert find_defects(records) == []
    trials = [record for record in records if record["record"] == "trial"]
    assert sum(trial["phase"] == "main" for trial in trials) == study.trial_count
    for row, trial in zip(rows, sorted(trials, key=lambda trial: trial["trial"]), strict=True):
        listed = records[0]["order"][trial["trial"]]
        assert [row["block"], row["phase"]] == [listed["block"], listed["phase"]]
        assert row["intervals"] == (",".join(listed["intervals"]) or "n/a")
        assert row["is_catch"] == str(int(listed["is_catch"]))
        for factor, value in trial["condition"].items():
            assert row[factor] == str(value)
        if study.response.answers:
            assert row["answer"] in study.response.answers
        else:
            assert float(row["answer"]) > 0.0
        if row["chosen_interval"] != "n/a":
            assert row["chosen_interval"] == listed["intervals"][study.response.answers.index(row["answer"])]
        if study.response.correct_interval and not listed["is_catch"]:
            assert (row["is_correct"] == "1") == (row["chosen_interval"] == study.response.correct_interval)
        assert_within_intervals(trial)


def assert_within_intervals(trial):
    """Assert that pulses come only in intervals that show something, and in every such one."""
    shown = trial["presentations"][-1]
    (*_, last_end_s) = (end_s for _, _, end_s in shown["intervals"])
    assert last_end_s > 0.0
    filled = [
        interval
        for interval, requested in zip(shown["intervals"], trial["requested"], strict=True)
        if requested["pattern"] != "nothing"
    ]
    starts_s = shown["executed"]["start_s"]
    # A pulse by height may begin up to a move of the mirrors late.
    within = [[start_s - 1e-3 <= at_s <= end_s + 5e-3 for at_s in starts_s] for _, start_s, end_s in filled]
    assert all(any(each) for each in within)
    assert all(any(each[k] for each in within) for k in range(len(starts_s)))
