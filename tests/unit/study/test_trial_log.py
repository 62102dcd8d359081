"""The log of a session: what counts after an end at any byte."""

import json
import os
import stat

import pytest

from limited_files import largest_file
from optodrive.core.errors import BusyError, InputError
from optodrive.study.study_file import load_study
from optodrive.study.trial_list import list_trials
from optodrive.study.trial_log import TrialLog

STUDY = load_study("experiment-1")
ORDER = list_trials(STUDY, "01")
ANSWER = {"answer": "left", "is_correct": True}


def open_log(path, study=STUDY, participant="01"):
    return TrialLog(path, study, participant)


def run_trials(log, count):
    for _ in range(count):
        log.begin(log.next_trial)
        log.complete(ANSWER)


def kinds(path):
    return [json.loads(line)["record"] for line in path.read_text().splitlines()]


def test_a_session_goes_on_where_it_ended(tmp_path):
    path = tmp_path / "log.jsonl"
    with open_log(path) as log:
        run_trials(log, 3)
    with open_log(path) as log:
        assert log.next_trial == 3
        assert log.order == ORDER
        run_trials(log, len(ORDER) - 3)
        assert log.next_trial is None
    assert kinds(path) == ["session"] + ["begun", "trial"] * len(ORDER)


def test_a_trial_that_was_begun_is_marked_and_repeated(tmp_path):
    path = tmp_path / "log.jsonl"
    with open_log(path) as log:
        run_trials(log, 1)
        log.begin(1)
    with open_log(path) as log:
        assert log.next_trial == 1
        assert log.begin(1) == 2
        assert log.complete(ANSWER)["attempt"] == 2
    assert kinds(path)[-4:] == ["begun", "interrupted", "begun", "trial"]


def test_a_spoiled_stimulus_does_not_count(tmp_path):
    path = tmp_path / "log.jsonl"
    with open_log(path) as log:
        log.begin(0)
        log.spoil("3 of 4 pulses executed")
        assert log.next_trial == 0
        assert log.begin(0) == 2


def test_a_log_that_ends_at_any_byte_goes_on_without_a_loss(tmp_path):
    path = tmp_path / "log.jsonl"
    with open_log(path) as log:
        run_trials(log, 2)
    whole = path.read_bytes()
    head = whole.index(b"\n") + 1
    for size in range(0, len(whole), 7):
        path.write_bytes(whole[:size])
        lines = whole[:size].count(b"\n")
        with open_log(path) as log:
            assert len(log.trials) == max(0, lines - 1) // 2
            run_trials(log, len(ORDER) - len(log.trials))
        trials = [record["trial"] for record in map(json.loads, path.read_text().splitlines()) if "answer" in record]
        assert trials == list(range(len(ORDER)))
        assert size < head or path.read_bytes().startswith(whole[:head])


def test_two_processes_cannot_run_one_session(tmp_path):
    path = tmp_path / "log.jsonl"
    with open_log(path), pytest.raises(BusyError, match="another process"):
        open_log(path)


@pytest.mark.parametrize(
    ("study", "participant", "says"),
    [
        (STUDY.model_copy(update={"repetitions": 6}), "01", "another repetitions"),
        (STUDY, "02", "participant: got '01', expected '02'"),
    ],
)
def test_another_design_or_participant_is_refused(tmp_path, study, participant, says):
    path = tmp_path / "log.jsonl"
    with open_log(path) as log:
        run_trials(log, 1)
    before = path.read_bytes()
    with pytest.raises(InputError, match=says):
        open_log(path, study, participant)
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("nonsense", "line 2: got a damaged line"),
        ('{"record": "trial", "trial": 0, "attempt": 1}', "line 2: got trial of trial 0"),
        ('{"record": "begun", "trial": 99, "attempt": 1}', "line 2: got begun of trial 99"),
    ],
)
def test_a_damaged_line_is_told_and_nothing_is_changed(tmp_path, line, says):
    path = tmp_path / "log.jsonl"
    open_log(path).__exit__(None, None, None)
    path.write_text(path.read_text() + line + "\n")
    before = path.read_bytes()
    with pytest.raises(InputError, match=says):
        open_log(path)
    assert path.read_bytes() == before


def test_every_line_is_on_the_disk_before_the_session_goes_on(tmp_path, monkeypatch):
    path, synced = tmp_path / "log.jsonl", []
    fsync = os.fsync

    def record(descriptor):
        fsync(descriptor)
        synced.append(os.fstat(descriptor).st_size if stat.S_ISREG(os.fstat(descriptor).st_mode) else "folder")

    monkeypatch.setattr(os, "fsync", record)
    with open_log(path) as log:
        assert synced == [path.stat().st_size, "folder"]  # the new file's name, too
        log.begin(0)
        assert synced[-1] == path.stat().st_size
        log.complete(ANSWER)
        assert synced[-1] == path.stat().st_size
        assert len(synced) == 4


@pytest.mark.parametrize(("participant", "can_begin_anew"), [("01", False), ("sim01", True)])
def test_a_changed_study_begins_anew_before_the_first_stimulus(tmp_path, participant, can_begin_anew):
    path, changed = tmp_path / "log.jsonl", STUDY.model_copy(update={"title": "Corrected", "seed": 2})
    open_log(path, participant=participant).__exit__(None, None, None)
    with open_log(path, changed, participant) as log:
        assert log.order == list_trials(changed, participant)
        log.begin(0)
    assert kinds(path) == ["session", "begun"]
    if can_begin_anew:  # nobody felt the stimulus of a simulated participant
        with open_log(path, STUDY, participant) as log:
            assert log.order == list_trials(STUDY, participant)
            run_trials(log, 1)
    content = path.read_bytes()
    with pytest.raises(InputError, match="a changed one needs another folder"):
        open_log(path, STUDY.model_copy(update={"title": "Other"}), participant)
    assert path.read_bytes() == content


def test_a_log_of_another_participant_does_not_begin_anew(tmp_path):
    path = tmp_path / "log.jsonl"
    open_log(path).__exit__(None, None, None)
    with pytest.raises(InputError, match="participant: got '01'"):
        open_log(path, STUDY.model_copy(update={"title": "Other"}), "02")


def test_a_full_disk_ends_a_session_in_one_line_and_loses_no_trial(tmp_path):
    path = tmp_path / "log.jsonl"
    with open_log(path) as log:
        run_trials(log, 2)
    for beyond in (0, 30):  # the line is refused, or cut
        with open_log(path) as log:
            size = path.stat().st_size
            with largest_file(size + beyond), pytest.raises(InputError, match=r"log\.jsonl: got 'File too large'"):
                log.begin(2)
        assert path.stat().st_size == size + beyond
    with open_log(path) as log:
        run_trials(log, 1)
    assert [json.loads(line).get("trial") for line in path.read_text().splitlines()][-2:] == [2, 2]
