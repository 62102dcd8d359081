"""The table of participants, which a laboratory extends, and identifiers that others are confused with."""

import json
import re
from importlib.resources import files
from pathlib import Path

import pytest

from optodrive.cli.main import run
from optodrive.cli.study_numbers import STUDY_HELP
from optodrive.core.errors import InputError
from optodrive.study.dataset import build_log_path, check_new_participant, write_dataset
from optodrive.study.study_file import list_shipped_studies, load_study
from optodrive.study.trial_log import TrialLog


def begin_session(folder, participant):
    study = load_study("detection")
    with TrialLog(build_log_path(folder, study, participant), study, participant) as log:
        log.begin_run("a test")
        log.begin(0)
    write_dataset(folder)


@pytest.mark.parametrize(
    ("observer", "expected"),
    [
        ("intensity", "an observer whose answers are cw, ccw"),
        ("linear-motion", "an observer whose answers are cw, ccw; those of this one are left, right, up, down"),
        ("oddball", "an observer whose answers are cw, ccw; this one answers"),
    ],
)
def test_a_simulated_participant_gives_only_answers_of_the_study(tmp_path, capsys, observer, expected):
    text, path = files("optodrive.study.experiments").joinpath("experiment-2.toml").read_text(), tmp_path / "study.toml"
    path.write_text(text.replace('observer = "rotation"', f'observer = "{observer}"'))
    command = ["study", str(path), "--out", str(tmp_path / "dataset")]
    assert run(command) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert f"simulation.observer: got '{observer}', expected {expected}" in error
    path.write_text(text)  # the corrected file is accepted by the same command
    assert run(command) == 0


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ('pattern = "experiment-2"', 'pattern = "experiment-9"', "study experiment-2: pattern: got 'experiment-9'"),
        ("[stimulus]", "[stimulus]\nparameters = { sped = 2 }", "pattern experiment-2: got 'sped'"),
        ("[stimulus]", "[stimulus]\nparameters = { centre = 900 }", "centre: got 900, expected a whole number, 0…436"),
    ],
)
def test_a_stimulus_that_the_display_has_not_is_refused_before_the_first_one(tmp_path, capsys, old, new, expected):
    text, path = files("optodrive.study.experiments").joinpath("experiment-2.toml").read_text(), tmp_path / "study.toml"
    assert old in text
    path.write_text(text.replace(old, new, 1))
    assert run(["study", str(path), "--out", str(tmp_path / "dataset")]) == 2
    line = next(k for k, text in enumerate(path.read_text().splitlines(), start=1) if new.splitlines()[-1] in text)
    error = capsys.readouterr().err
    assert expected in error
    assert f"{path}, line {line}: study experiment-2: " in error
    assert not list(tmp_path.glob("dataset/sourcedata/*"))


@pytest.mark.parametrize("answers", [("left", "right"), ("up", "down")])
def test_an_observer_chooses_among_the_answers_of_the_study(tmp_path, answers):
    text = files("optodrive.study.experiments").joinpath("experiment-1.toml").read_text()
    names = ", ".join(f'"{answer}"' for answer in answers)
    for line in [line for line in text.splitlines() if line.startswith(("direction =", "answers =", "chance_level ="))]:
        key = line.partition(" =")[0]
        text = text.replace(line, f"{key} = 0.5" if key == "chance_level" else f"{key} = [{names}]")
    (tmp_path / "two.toml").write_text(text.partition("[published]")[0])
    assert run(["study", str(tmp_path / "two.toml"), "--out", str(tmp_path / "dataset")]) == 0
    (table,) = tmp_path.glob("dataset/sub-sim01/beh/*.tsv")
    head, *rows = [line.split("\t") for line in table.read_text().splitlines()]
    assert {row[head.index("answer")] for row in rows} == set(answers)


def test_columns_and_rows_of_the_laboratory_are_kept(tmp_path):
    begin_session(tmp_path, "01")
    table = tmp_path / "participants.tsv"
    assert table.read_text() == "participant_id\tkind\nsub-01\tperson\n"
    table.write_text("age\tparticipant_id\thand\r\n31\tsub-01\tleft\r\n44\tsub-77\tright\r\n")
    begin_session(tmp_path, "02")
    assert table.read_text() == (
        "age\tparticipant_id\thand\tkind\n31\tsub-01\tleft\tperson\n44\tsub-77\tright\tn/a\nn/a\tsub-02\tn/a\tperson\n"
    )
    write_dataset(tmp_path)
    assert table.read_text().count("\n") == 4


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "line 1: got an empty file"),
        (b"name,age\nsub-01,3\n", "line 1: got 'name,age'"),
        (b"participant_id\tage\tage\n", "line 1: got"),
        (b"participant_id\tage\nsub-02\t3\nsub-01\n", "line 3: got 1 of 2 cells"),
        (b"participant_id\tage\nsub-01\t3\n\nsub-01\t4\n", "line 4: got 'sub-01', expected one row per participant"),
        (b"participant_id\tage\nsub-01\t\xff\n", ": got another encoding"),
    ],
)
def test_a_table_that_cannot_be_extended_is_kept_and_named(tmp_path, capsys, content, says):
    begin_session(tmp_path, "01")
    (tmp_path / "participants.tsv").write_bytes(content)
    with pytest.raises(InputError, match=f"participants.tsv.*{says}"):
        write_dataset(tmp_path)
    assert run(["study", "experiment-1", "--out", str(tmp_path)]) == 2  # before anybody takes part
    assert says in capsys.readouterr().err
    assert not list(tmp_path.glob("sourcedata/sub-sim01"))
    assert (tmp_path / "participants.tsv").read_bytes() == content


def test_a_participant_without_a_stimulus_is_not_listed(tmp_path):
    study = load_study("detection")
    begin_session(tmp_path, "01")
    with TrialLog(build_log_path(tmp_path, study, "02"), study, "02") as log:
        log.begin_run("a test")
    write_dataset(tmp_path)
    assert (tmp_path / "participants.tsv").read_text() == "participant_id\tkind\nsub-01\tperson\n"
    assert not (tmp_path / "sub-02").exists()


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--participants", "3"], "--participants: got 3, expected none beside --participant"),
        (["--config", "display-16"], "--config: got 'display-16', expected none beside --participant"),
    ],
)
def test_an_option_of_simulated_participants_is_refused_beside_a_person(tmp_path, capsys, arguments, says):
    assert run(["study", "detection", "--out", str(tmp_path / "data"), "--participant", "07", *arguments]) == 2
    assert says in capsys.readouterr().err


@pytest.mark.parametrize(
    ("study", "arguments", "says"),
    [
        ("temporal-order", [], "--session: missing, expected 1 to 2"),
        ("temporal-order", ["--session", "3"], "--session: got 3, expected 1 to 2"),
        ("detection", ["--session", "1"], "--session: got 1, expected none: the study has one session"),
        ("height-threshold", [], "--participant: got 'ab', expected a code with a number"),
    ],
)
def test_a_session_that_the_study_has_not_is_refused(tmp_path, capsys, study, arguments, says):
    code = "ab" if study == "height-threshold" else "07"
    assert run(["study", study, "--out", str(tmp_path / "data"), "--participant", code, *arguments]) == 2
    assert says in capsys.readouterr().err
    assert not (tmp_path / "data").exists()


@pytest.mark.parametrize(("option", "value"), [("--page", "0"), ("--lsl", None), ("--hold", None)])
def test_an_option_of_a_person_is_refused_for_a_simulated_participant(tmp_path, capsys, option, value):
    given = [option] if value is None else [option, value]
    assert run(["study", "detection", "--out", str(tmp_path / "data"), *given]) == 2
    assert f"{option}: got" in capsys.readouterr().err


def test_the_help_names_the_shipped_studies():
    experiments = ", ".join(f"experiment-{number}" for number in range(1, 7))
    named = STUDY_HELP.partition(": ")[2].replace("experiment-1 to experiment-6", experiments).removesuffix(".")
    assert named.split(", ") == list_shipped_studies()


def test_an_identifier_in_other_letters_is_refused(tmp_path):
    begin_session(tmp_path, "p1")
    check_new_participant("--participant", tmp_path, "p1")
    check_new_participant("--participant", tmp_path, "p2")
    with pytest.raises(InputError, match="--participant: got 'P1', expected p1, as the dataset spells it"):
        check_new_participant("--participant", tmp_path, "P1")
    (tmp_path / "participants.tsv").write_text("participant_id\tage\nsub-q7\t30\n")  # a row of the laboratory's
    with pytest.raises(InputError, match="--participant: got 'Q7', expected q7, as the dataset spells it"):
        check_new_participant("--participant", tmp_path, "Q7")


def test_the_study_of_the_documentation_can_be_rehearsed(tmp_path, capsys):
    page = (Path(__file__).parents[3] / "docs/how-to/design-a-study.md").read_text()
    study, _ = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    (tmp_path / "study.toml").write_text(study)
    assert run(["study", str(tmp_path / "study.toml"), "--out", str(tmp_path / "data"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["trials"] == 40
