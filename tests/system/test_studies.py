"""The paper's six studies from the command line, with simulated participants, judged by the BIDS validator."""

import json
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

from optodrive.cli.main import run
from optodrive.device.config_file import load_config
from optodrive.device.sensitivity_map import load_sensitivity_map, replace_sensitivity_map
from optodrive.study.study_file import EXPERIMENTS, load_study
from optodrive.study.trial_log import read_log

VALIDATOR = Path(sys.executable).with_name("bids-validator-deno")
TRIALS = {1: 20, 2: 36, 3: 45, 4: 72, 5: 24, 6: 30}


def validate(folder):
    """Run the validator on a dataset and return its exit status and its output."""
    done = subprocess.run([VALIDATOR, folder, "--max-rows", "-1"], capture_output=True, text=True)
    return done.returncode, done.stdout + done.stderr


def run_study(capsys, name, folder, *arguments):
    assert run(["study", name, "--out", str(folder), "--json", *arguments]) == 0
    return json.loads(capsys.readouterr().out)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return tmp_path_factory.mktemp("studies") / "data"


@pytest.mark.parametrize("number", range(1, 7))
def test_an_experiment_runs_to_the_end(dataset, capsys, number):
    name = f"experiment-{number}"
    report = run_study(capsys, name, dataset)
    assert report["participants"] == {"sim01": TRIALS[number]}
    assert report["trials"] == TRIALS[number]
    head, trials = read_log(dataset / f"sourcedata/sub-sim01/sub-sim01_task-experiment{number}_trials.jsonl")
    study = load_study(name)
    assert Counter(str(record["condition"]) for record in trials) == {
        str(condition): study.repetitions for condition in study.conditions
    }
    assert [record["condition"] for record in trials] == [trial["condition"] for trial in head["order"]]
    onsets = [record["presentations"][0]["onset_s"] for record in trials]
    assert onsets == sorted(onsets)
    table = (dataset / f"sub-sim01/beh/sub-sim01_task-experiment{number}_beh.tsv").read_text().splitlines()
    assert len(table) == 1 + TRIALS[number]
    # Another run finds nothing to do and changes nothing.
    before = [(path, path.read_bytes()) for path in sorted(dataset.rglob("*")) if path.is_file()]
    assert run_study(capsys, name, dataset) == report
    assert [(path, path.read_bytes()) for path, _ in before] == before


def test_the_dataset_is_valid(dataset):
    status, output = validate(dataset)
    assert status == 0, output
    assert "BIDS compatible" in output or "[ERROR]" not in output
    assert (dataset / "participants.tsv").read_text() == "participant_id\tkind\nsub-sim01\tsimulated\n"


@pytest.mark.parametrize(
    ("path", "old", "new"),
    [
        ("participants.tsv", "sub-sim01", "sub-sim02"),
        ("dataset_description.json", '"BIDSVersion"', '"Version"'),
        ("sub-sim01/beh/sub-sim01_task-experiment1_beh.tsv", "\tleft\t", "\t"),
    ],
)
def test_the_validator_finds_a_broken_dataset(dataset, path, old, new):
    text = (dataset / path).read_text()
    try:
        (dataset / path).write_text(text.replace(old, new, 1))
        assert validate(dataset)[0] != 0
    finally:
        (dataset / path).write_text(text)


def test_a_matching_writes_the_sensitivity_map_of_each_participant(tmp_path, capsys):
    path, data = tmp_path / "short.toml", tmp_path / "data"
    path.write_text((EXPERIMENTS / "equalisation.toml").read_text().replace("trials = 1000", "trials = 30"))
    report = run_study(capsys, str(path), data, "--participants", "2")
    assert report["participants"] == {"sim01": 30, "sim02": 30}
    for name, found in report["sensitivity"].items():
        known = load_sensitivity_map(replace_sensitivity_map(load_config(), Path(found["written"])))
        assert (known.participant, known.trials) == (name, 30)
        assert found["low"] == pytest.approx(known.sensitivity.min(), rel=1e-3)
        assert 0.15 < found["variation"] < 0.35
    first, second = (found["variation"] for found in report["sensitivity"].values())
    assert first != second
    table = (data / "sub-sim01/beh/sub-sim01_task-equalisation_beh.tsv").read_text().splitlines()
    assert len(table) == 31
    assert table[0].split("\t")[6:10] == ["first", "second", "first_intensity", "second_intensity"]
    assert validate(data)[0] == 0
    assert run_study(capsys, str(path), data, "--participants", "2") == report


@pytest.mark.slow
@pytest.mark.parametrize("number", range(1, 7))
def test_ten_participants_have_the_papers_number_of_trials(tmp_path, capsys, number):
    report = run_study(capsys, f"experiment-{number}", tmp_path / "data", "--participants", "10")
    assert report["trials"] == report["published"]["trials"] == 10 * TRIALS[number]
    assert validate(tmp_path / "data")[0] == 0


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["experiment-1", "--participant", "John Smith"], "a code and not a name"),
        (["experiment-1", "--participant", "sim07"], "does not begin with 'sim'"),
        (["experiment-1", "--participants", "0"], "--participants: got 0"),
        (["experiment-9"], "study: got 'experiment-9'"),
    ],
)
def test_wrong_arguments_are_told_in_one_line(tmp_path, capsys, arguments, says):
    assert run(["study", *arguments, "--out", str(tmp_path / "data")]) == 2
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1
    assert not (tmp_path / "data").exists()
