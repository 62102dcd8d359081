"""Results from the tables of a dataset alone: what counts, what is flagged, and what is refused."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import t

from optodrive.cli.main import run
from optodrive.core.errors import InputError
from optodrive.study.report import StudyResults
from optodrive.study.study_file import EXPERIMENTS
from optodrive.study.trial_table import compute_group_mean, read_tables
from study_tables import LEVELS, answer_levels, write_table, write_thresholds

NOTEBOOK = Path(__file__).parents[3] / "docs" / "examples" / "analyse_study.ipynb"
EXAMPLE = Path(__file__).parents[3] / "docs" / "examples" / "analyse_study.py"
THREE = ("1", "2", "3")
STUDY = """
format = "optodrive-study"
version = 2
name = "felt"
title = "Felt"
seed = 5
pause_s = 0.5

[stimulus]
pattern = "detection"

[factors]
side = ["left", "right"]

[response]
kind = "choice"
question = "On which side?"
answers = ["left", "right"]
correct_factor = "side"
chance_level = 0.5
min_s = 0.7

[procedure]
kind = "constant"
parameter = "power_mw"
levels = [40.0, 60.0, 90.0, 135.0, 200.0]
trials = 40

[catch]
trials = 4

[practice]
trials = 4

[simulation]
observer = "detection"
"""


def judge(folder):
    (table,) = read_tables(folder)
    return StudyResults(table)


def identify(seed, share, keys=None, count=60):
    """Return rows of a person who names 1 of 3, and knows it in a share of the trials."""
    rng, rows = np.random.default_rng(seed), []
    for _ in range(count):
        correct = str(rng.choice(THREE))
        given = correct if rng.random() < share else str(rng.choice(THREE))
        rows.append({"answer": (keys or {}).get(given, given), "correct_answer": correct})
    return rows


@pytest.mark.parametrize("kind", [{"is_catch": 1}, {"phase": "practice"}, {"exclusion": "too_fast"}])
def test_catch_practice_and_excluded_trials_never_enter(tmp_path, kind):
    rows = answer_levels(5)
    write_table(tmp_path / "plain", "01", rows)
    more = [{"level": level, "answer": "left", "correct_answer": "right", **kind} for level in LEVELS * 4]
    write_table(tmp_path / "more", "01", [*more, *rows])
    plain, mixed = judge(tmp_path / "plain"), judge(tmp_path / "more")
    assert plain.thresholds[0].estimate == mixed.thresholds[0].estimate
    assert plain.participants[0].accuracy == mixed.participants[0].accuracy
    name = {"is_catch": "catch", "phase": "practice", "exclusion": "excluded"}[next(iter(kind))]
    assert mixed.participants[0].counts == {**plain.participants[0].counts, name: len(more)}
    assert f"{len(more)} {name}" in list(mixed.list_lines())[1]
    as_main = [{name: cell for name, cell in row.items() if name not in kind} for row in more]
    write_table(tmp_path / "main", "01", [*as_main, *rows])
    assert judge(tmp_path / "main").participants[0].accuracy != plain.participants[0].accuracy


def test_a_threshold_a_bound_and_exchanged_keys_are_stated_as_such(tmp_path):
    results = judge(write_thresholds(tmp_path))
    clear, below, exchanged, other = (one.estimate for one in results.thresholds)
    assert clear.low < 100.0 < clear.high
    assert other.low < 100.0 < other.high
    assert (below.threshold, below.low) == (None, None)
    assert below.high <= 100.0
    assert exchanged[:3] == (None, None, None)
    assert results.participants[2].flags == exchanged.flags == ("exchanged-keys",)
    (mean,) = results.group_thresholds.values()
    assert mean.participants == 2
    assert mean.mean == pytest.approx(np.sqrt(clear.threshold * other.threshold))
    assert "2 of 4 thresholds are bounds or not determined" in "\n".join(results.list_lines())


@pytest.mark.parametrize(
    ("share", "keys", "flags"),
    [
        (0.8, None, ()),
        (0.8, {"1": "2", "2": "3", "3": "1"}, ("exchanged-keys",)),
        (0.8, {"1": "2", "2": "1"}, ("exchanged-keys",)),
        (0.0, None, ("guessing",)),
    ],
)
def test_an_identification_has_its_confusions_and_flags(tmp_path, share, keys, flags):
    flagged = []
    for seed in range(20):
        rows = identify(seed, share, keys)
        write_table(tmp_path / str(seed), "01", rows, answers=THREE, level=None)
        results = judge(tmp_path / str(seed))
        flagged.append(results.participants[0].flags)
        matrix = results.table.count_confusions(results.table.main)
        for row, correct in enumerate(THREE):
            for column, answer in enumerate(THREE):
                count = sum(one["correct_answer"] == correct and one["answer"] == answer for one in rows)
                assert matrix[row, column] == count
        assert results.to_document()["confusion"]["counts"] == matrix.tolist()
    assert sum(each == flags for each in flagged) >= 18, flagged


def test_the_guess_rate_is_that_of_the_design_or_the_participants_own(tmp_path):
    write_table(tmp_path / "three", "01", answer_levels(1, answers=THREE), answers=THREE)
    assert judge(tmp_path / "three").table.guess_rate == pytest.approx(1 / 3)
    rng = np.random.default_rng(3)
    for number in range(4):  # "yes" at every level, with a sixth of false alarms of the participant's own
        rows = [
            {"level": level, "answer": "yes" if is_felt else "no", "correct_answer": "yes"}
            for level in LEVELS * 20
            for is_felt in [rng.random() < 1.0 - (5 / 6) * np.exp(-((level / 100.0) ** 3.0))]
        ]
        write_table(tmp_path / "yes", f"0{number}", rows, answers=("yes", "no"))
    results = judge(tmp_path / "yes")
    assert results.table.guess_rate is None
    holds = [one.estimate.low <= 100.0 <= one.estimate.high for one in results.thresholds]
    assert sum(holds) >= 3


def test_sessions_and_blocks_have_thresholds_of_their_own(tmp_path):
    for session, threshold in ((1, 50.0), (2, 300.0)):
        rows = [{**row, "block": block} for k, block in enumerate("ab") for row in answer_levels(k, threshold)]
        write_table(tmp_path, "01", rows, session=session)
    results = judge(tmp_path)
    assert [one[1:3] for one in results.thresholds] == [("1", "a"), ("1", "b"), ("2", "a"), ("2", "b")]
    low, high = (np.mean([one.estimate.threshold for one in results.thresholds[k : k + 2]]) for k in (0, 2))
    assert 4.0 < high / low < 9.0
    assert [(block, mean.participants) for block, mean in results.group_thresholds.items()] == [("a", 1), ("b", 1)]


def test_answers_are_counted_by_factor(tmp_path):
    rows = [{**row, "block": str(k % 2)} for k, row in enumerate(answer_levels(1))]
    write_table(tmp_path, "01", rows, level=None, Factors=["level", "block"])
    page = judge(tmp_path).to_html()
    for level in LEVELS:
        own = [row for row in rows if row["level"] == level]
        left = sum(row["answer"] == "left" for row in own)
        correct = sum(row["answer"] == row["correct_answer"] for row in own)
        cells = f"<td>{level}</td><td class='n'>{left}</td><td class='n'>{12 - left}</td><td class='n'>{correct} of 12"
        assert cells in page


def test_the_mean_over_participants_has_students_interval():
    values = [0.7, 0.8, 0.75, 0.9]
    found = compute_group_mean(values)
    expected = t.interval(0.95, 3, np.mean(values), np.std(values, ddof=1) / 2.0)
    assert (found.low, found.high) == pytest.approx(expected)
    assert compute_group_mean([0.5]) == (0.5, None, None, 1)


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (lambda path: path.write_text("trial\tlevel\n1\t2\n"), "line 1: got no answer, is_correct, response_time"),
        (lambda path: path.write_text(path.read_text() + "1\t2\n"), "got 2 of 10 cells"),
        (lambda path: path.write_bytes(b"\xff\xfe"), "got another encoding"),
        (lambda path: path.with_suffix(".json").write_text("{"), "got no description"),
        (lambda path: path.unlink(), "got no table of trials"),
    ],
)
def test_a_damaged_dataset_is_refused_in_one_line(tmp_path, capsys, damage, says):
    damage(write_table(tmp_path, "01", answer_levels(1)))
    with pytest.raises(InputError):
        read_tables(tmp_path)
    assert run(["study", "report", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1


def compare_with_the_script(folder, task, report):
    """Assert that the example script finds the thresholds and accuracies of a report; return what it prints."""
    done = subprocess.run([sys.executable, EXAMPLE, folder, task], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    script = json.loads(done.stdout)
    for name, one in script["participants"].items():
        found = report["participants"][name]["accuracy"]
        assert (found["correct"], found["trials"]) == (one["correct"], one["trials"])
        assert found["interval"] == pytest.approx(one["interval"], abs=1e-9)
    assert len(report["thresholds"]) == len(script["thresholds"])
    for found, one in zip(report["thresholds"], script["thresholds"], strict=True):
        assert (found["threshold"] is not None) == one["is_within_levels"]
        for key in ("threshold", "low", "high"):
            assert found[key] is None or found[key] == pytest.approx(one[key], rel=1e-6)
    return script


def compare_with_the_notebook(folder, task, report, monkeypatch):
    """Assert that the notebook finds the accuracies and thresholds of a report."""
    monkeypatch.setenv("STUDY_FOLDER", str(folder))
    monkeypatch.setenv("STUDY_TASK", task)
    cells = json.loads(NOTEBOOK.read_text())["cells"]
    found = {}
    for cell in cells:
        if cell["cell_type"] == "code":
            exec("".join(cell["source"]), found)
    for name, one in report["participants"].items():
        row = found["accuracy"].loc[name]
        assert (row["correct"], row["trials"]) == (one["accuracy"]["correct"], one["accuracy"]["trials"])
        assert (row["low"], row["high"]) == pytest.approx(one["accuracy"]["interval"], abs=1e-9)
    for key in ("mean", "low", "high"):
        assert found["group"][key] == pytest.approx(report["group"]["accuracy"][key])
    assert len(found["thresholds"]) == len(report["thresholds"])
    for row, one in zip(found["thresholds"].to_dict("records"), report["thresholds"], strict=True):
        assert row["is_within_levels"] == (one["threshold"] is not None)
        assert all(one[key] is None or row[key] == pytest.approx(one[key], rel=1e-6) for key in ("threshold", "low"))
        assert one["high"] is None or row["high"] == pytest.approx(one["high"], rel=1e-6)


def test_a_design_with_levels_has_its_thresholds_everywhere(tmp_path, capsys, monkeypatch):
    text = (EXPERIMENTS / "gap-detection.toml").read_text()
    (tmp_path / "study.toml").write_text(text.replace("repetitions = 10", "repetitions = 4"))
    words = [str(tmp_path / "study.toml"), "--out", str(tmp_path), "--participants", "2", "--json"]
    assert run(["study", *words]) == 0
    stated = json.loads(capsys.readouterr().out)
    assert run(["study", "report", str(tmp_path), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)["gapdetection"]
    assert report["level"] == stated["threshold_of"] == "gap_ms"
    compare_with_the_script(tmp_path, "gapdetection", report)
    for one in report["thresholds"]:
        assert all(stated["thresholds"][one["participant"]][key] == one[key] for key in ("threshold", "low", "high"))
    compare_with_the_notebook(tmp_path, "gapdetection", report, monkeypatch)
    page = (tmp_path / "derivatives" / "task-gapdetection_report.html").read_text()
    assert page.count("share correct by gap_ms") >= 2
    assert "gap_ms" in (tmp_path / "derivatives" / "task-gapdetection_trials.tsv").read_text().splitlines()[0].split()


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    folder = tmp_path_factory.mktemp("felt")
    (folder / "felt.toml").write_text(STUDY)
    assert run(["study", str(folder / "felt.toml"), "--out", str(folder / "data"), "--participants", "3"]) == 0
    return folder / "data"


def test_the_report_and_the_example_script_state_the_same_numbers(dataset, capsys):
    assert run(["study", "report", str(dataset), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)["felt"]
    script = compare_with_the_script(dataset, "felt", report)
    assert {name: one["counts"]["practice"] for name, one in report["participants"].items()} == dict.fromkeys(
        script["participants"], 4
    )
    for key in ("mean", "low", "high"):
        assert report["group"]["accuracy"][key] == pytest.approx(script["accuracy"][key])
    assert len(script["thresholds"]) == 3


def test_a_run_states_the_thresholds_of_its_report(dataset, capsys):
    assert (
        run(["study", str(dataset.parent / "felt.toml"), "--out", str(dataset), "--participants", "3", "--json"]) == 0
    )
    stated = json.loads(capsys.readouterr().out)
    assert run(["study", "report", str(dataset), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)["felt"]
    assert stated["excluded"] + stated["judged"] >= 120
    assert stated["judged"] == sum(one["accuracy"]["trials"] for one in report["participants"].values())
    for one in report["thresholds"]:
        assert stated["thresholds"][one["participant"]]["threshold"] == one["threshold"]
    table = (dataset / "derivatives" / "task-felt_trials.tsv").read_text().splitlines()
    assert len(table) == 1 + 3 * 48
    assert {"kind", "power_mw", "requested_onset", "stimulus_onset", "stimulus_height"} <= set(table[0].split("\t"))
