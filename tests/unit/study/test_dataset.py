"""The table of participants, which a laboratory extends, and identifiers that others are confused with."""

from importlib.resources import files

import pytest

from optodrive.cli.main import run
from optodrive.core.errors import InputError
from optodrive.study.dataset import build_log_path, check_new_participant, write_dataset
from optodrive.study.session import draw_order
from optodrive.study.study_file import load_study
from optodrive.study.trial_log import TrialLog


def begin_session(folder, participant):
    study = load_study("detection")
    with TrialLog(
        build_log_path(folder, study, participant), study, participant, draw_order(study, participant)
    ) as log:
        log.begin_run("a test")
    write_dataset(folder)


@pytest.mark.parametrize(
    ("observer", "expected"),
    [
        ("intensity", "an observer whose answers are cw, ccw; this one"),
        ("linear-motion", "an observer of experiment-2"),
    ],
)
def test_a_simulated_participant_gives_only_answers_of_the_study(tmp_path, capsys, observer, expected):
    text = files("optodrive.study.experiments").joinpath("experiment-2.toml").read_text()
    (tmp_path / "wrong.toml").write_text(text.replace('observer = "rotation"', f'observer = "{observer}"'))
    assert run(["study", str(tmp_path / "wrong.toml"), "--out", str(tmp_path / "dataset")]) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert f"simulation.observer: got '{observer}', expected {expected}" in error


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
    "content", [b"", b"name,age\nsub-01,3\n", b"participant_id\tage\nsub-01\n", b"participant_id\tage\nsub-01\t\xff\n"]
)
def test_a_table_that_cannot_be_extended_is_kept_and_named(tmp_path, content):
    begin_session(tmp_path, "01")
    (tmp_path / "participants.tsv").write_bytes(content)
    with pytest.raises(InputError, match=r"participants\.tsv: got another"):
        write_dataset(tmp_path)
    assert (tmp_path / "participants.tsv").read_bytes() == content


def test_an_identifier_in_other_letters_is_refused(tmp_path):
    begin_session(tmp_path, "p1")
    check_new_participant("--participant", tmp_path, "p1")
    check_new_participant("--participant", tmp_path, "p2")
    with pytest.raises(InputError, match="--participant: got 'P1', expected p1, as the dataset spells it"):
        check_new_participant("--participant", tmp_path, "P1")
