"""The log of a session: every trial is on the disk before the next one begins.

Theory of operation. The log is a text file to which one JSON object per line is appended; each line is on the disk
(fsync) before the session goes on. A trial is two lines: `begun` before its stimulus, `trial` with its answer. The
second line alone makes a trial count, so that a process may end at any instant:

- before `begun`: nothing was shown; the trial comes next.
- after `begun`: the stimulus may have been shown. The next run appends `interrupted`, and the trial is repeated as its
  next attempt, which its line states.
- within a line: the line has no end. It never counted; the next run removes it, and the case above applies.
- after `trial`: it counts, once. The list of trials stands in the first line, never computed anew.

A lock on the file keeps a second process from appending to the same session.
"""

import fcntl
import json
import os
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from optodrive.core.errors import BusyError, InputError, Unquoted, refuse_os_error
from optodrive.study.study_file import SIMULATED_PREFIX, Study
from optodrive.study.study_sections import Value
from optodrive.study.trial_list import ListedTrial, is_practice_over, list_trials

FORMAT, VERSION = "optodrive-trials", 2
LOG_BYTES_MAX = 500_000_000
SHOWN = frozenset({"familiarised", "begun"})
"""Kinds of records after which a participant may have felt something."""


class TrialLog:
    """Log of one participant's session, as a context manager.

    order: the list of trials; trials: the records of those that count, by their index
    run: number of the present run of the session, from 1; answers: to the questionnaire, by `before` and `after`
    """

    def __init__(self, path: Path, study: Study, participant: str, session: int = 1) -> None:
        """Open or create the log. The list of trials is recorded in a new log, and read from one that exists.

        A log of a changed study begins anew before the first stimulus, or a simulated participant's first answer.
        Raise InputError for a log of another study or participant, or one that is damaged; BusyError if another process
        has it open.
        """
        self.path = path
        self.trials: dict[int, dict[str, Any]] = {}
        self.is_familiarised = False
        self.run = 0
        self.answers: dict[str, dict[str, Any]] = {}
        self._study = study
        self._attempts: dict[int, int] = {}
        self._open_trial: int | None = None
        self._condition: dict[str, Value] = {}
        is_new = not path.exists()
        self._file = _open_locked(path)
        try:
            records = self._read_records()
            if records and _can_begin_anew(records, study, participant):
                self._file.truncate(0)
                records = []
            if not records:
                records = [_build_head(study, participant, session)]
                self._append(records[0])
            if is_new:
                _sync_folder(path.parent)
            _check_head(path, records[0], study, participant)
            self.order = [ListedTrial.from_record(record) for record in records[0]["order"]]
            for number, record in enumerate(records[1:], start=2):
                self._apply(record, f"{path}: line {number}")
            if self._open_trial is not None:
                self._append({"record": "interrupted", "trial": self._open_trial, "attempt": self.attempt})
                self._open_trial = None
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()

    @property
    def next_trial(self) -> int | None:
        """Index of the next trial that does not count yet, None after the last."""
        practised = [self.trials[k] for k in sorted(self.trials) if self.order[k].phase == "practice"]
        is_over = is_practice_over(self._study, practised)
        left = (k for k in range(len(self.order)) if k not in self.trials)
        return next((k for k in left if not is_over or self.order[k].phase == "main"), None)

    @property
    def is_ended(self) -> bool:
        """Whether nothing is left, neither a trial nor the questionnaire after the last one."""
        parts = {question.when for question in self._study.questions}
        return self.next_trial is None and parts <= self.answers.keys()

    @property
    def attempt(self) -> int:
        """Number of the present attempt at the begun trial, from 1."""
        return self._attempts[self._require_open()]

    def begin(self, trial: int, condition: Mapping[str, Value] | None = None) -> int:
        """Record that a trial's stimulus is about to be shown, and return the number of this attempt.

        condition: that of the order, and the level that a procedure chose; None for that of the order
        """
        attempt = self._attempts.get(trial, 0) + 1
        self._condition = dict(self.order[trial].condition if condition is None else condition)
        self._write({"record": "begun", "trial": trial, "attempt": attempt, "condition": self._condition})
        return attempt

    def spoil(self, reason: str) -> None:
        """Record that the begun trial's stimulus was not as requested. The trial is repeated."""
        self._write({"record": "spoiled", "trial": self._require_open(), "attempt": self.attempt, "reason": reason})

    def complete(self, fields: Mapping[str, Any]) -> dict[str, Any]:
        """Record the answer of the begun trial, which then counts. Return its record."""
        trial = self._require_open()
        listed = self.order[trial].to_record()
        head = {"record": "trial", "trial": trial, "attempt": self.attempt, "run": self.run, **listed}
        head["condition"] = self._condition
        record = {**head, **fields}
        self._write(record)
        return record

    def begin_run(self, presenter: str) -> None:
        """Record that a run of the session begins, and who presents: times of the board count anew."""
        self._write({"record": "run", "presenter": presenter, "started": f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ}"})

    def record_familiarisation(self, presentations: Sequence[Mapping[str, Any]]) -> None:
        """Record that each stimulus was shown once before the trials."""
        self._write({"record": "familiarised", "presentations": list(presentations)})

    def record_answers(self, when: str, answers: Mapping[str, Any]) -> None:
        """Record the answers to the questionnaire, `before` or `after` the trials."""
        self._write({"record": "questionnaire", "when": when, "answers": dict(answers)})

    def _append(self, record: Mapping[str, Any]) -> None:
        """Append a record. It is on the disk when this returns. Raise InputError if it cannot be written."""
        rest = (json.dumps(record, ensure_ascii=False, allow_nan=False) + "\n").encode()
        try:
            while rest:
                rest = rest[self._file.write(rest) :]
            os.fsync(self._file.fileno())
        except OSError as error:
            expected = "room for the log; the session goes on with the same command"
            raise InputError(str(self.path), error.strerror or str(error), expected) from None

    def _require_open(self) -> int:
        """Return the trial that was begun last. Raise ValueError if none was, which is a bug."""
        if self._open_trial is None:
            raise ValueError("no trial was begun")
        return self._open_trial

    def _write(self, record: dict[str, Any]) -> None:
        self._append(record)
        self._apply(record, str(self.path))

    def _apply(self, record: dict[str, Any], place: str) -> None:
        """Follow a record. Raise InputError for one that cannot come here."""
        kind, trial = record.get("record"), record.get("trial", -1)
        if kind == "familiarised":
            self.is_familiarised = True
        elif kind == "run":
            self.run += 1
        elif kind == "questionnaire":
            self.answers[record["when"]] = record["answers"]
        elif kind == "begun" and self._open_trial is None and trial not in self.trials and _is_index(trial, self.order):
            self._open_trial, self._attempts[trial] = trial, record["attempt"]
        elif kind in ("trial", "spoiled", "interrupted") and self._open_trial is not None and trial == self._open_trial:
            self._open_trial = None
            if kind == "trial":
                self.trials[trial] = record
        elif kind in ("begun", "trial", "spoiled", "interrupted"):
            raise InputError(place, Unquoted(f"{kind} of trial {trial}"), "a record that continues the ones before it")

    def _read_records(self) -> list[dict[str, Any]]:
        """Read all records, and remove a last line without its end."""
        self._file.seek(0)
        content = self._file.read(LOG_BYTES_MAX + 1)
        if len(content) > LOG_BYTES_MAX:
            raise InputError(str(self.path), Unquoted("a larger file"), f"at most {LOG_BYTES_MAX} bytes")
        whole = content[: content.rfind(b"\n") + 1]
        if len(whole) < len(content):
            self._file.truncate(len(whole))
            os.fsync(self._file.fileno())
        return [_parse_line(f"{self.path}: line {k}", line) for k, line in enumerate(whole.splitlines(), start=1)]


def read_records(path: Path) -> list[dict[str, Any]]:
    """Return all whole records of a log. Raise InputError for another file."""
    with refuse_os_error(path, "a readable file"):
        content = path.read_bytes()
    lines = content[: content.rfind(b"\n") + 1].splitlines()
    records = [_parse_line(f"{path}: line {k}", line) for k, line in enumerate(lines, start=1)]
    if not records or records[0].get("format") != FORMAT:
        raise InputError(str(path), Unquoted("another file"), "the log of a session")
    if records[0].get("version") != VERSION:
        raise InputError(f"{path}: version", records[0].get("version"), f"{VERSION}: use another folder")
    return records


def read_log(path: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Return the first record of a log and the trials that count, in order. Raise InputError."""
    records = read_records(path)
    trials = [record for record in records if record.get("record") == "trial"]
    return records[0], sorted(trials, key=lambda record: int(record["trial"]))


def has_stimuli(path: Path) -> bool:
    """Return whether a log has a stimulus that was or may have been shown. Raise InputError as `read_log`."""
    with refuse_os_error(path, "a readable file"), path.open("rb") as file:
        lines = enumerate(file, start=1)
        return any(_parse_line(f"{path}: line {k}", line)["record"] in SHOWN for k, line in lines if line[-1:] == b"\n")


def _open_locked(path: Path) -> Any:
    with refuse_os_error(path, "a file that can be written"):
        file = path.open("a+b", buffering=0)  # no rest is written again when the file is closed
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        file.close()
        raise BusyError(f"{path} is open in another process: one runs this session already") from None
    return file


def _build_head(study: Study, participant: str, session: int) -> dict[str, Any]:
    order = [trial.to_record() for trial in list_trials(study, participant, session)]
    head = {"record": "session", "format": FORMAT, "version": VERSION, "participant": participant, "session": session}
    return {**head, "study": study.model_dump(mode="json"), "order": order}


def _can_begin_anew(records: Sequence[Mapping[str, Any]], study: Study, participant: str) -> bool:
    """Return whether a log is of this participant and another version of the study, and holds nothing to be kept."""
    counts = {"trial"} if participant.startswith(SIMULATED_PREFIX) else SHOWN
    if any(record.get("record") in counts for record in records):
        return False
    head = records[0]
    mine = {"format": FORMAT, "version": VERSION, "participant": participant}
    return all(head.get(key) == value for key, value in mine.items()) and bool(_list_changes(head, study))


def _list_changes(head: Mapping[str, Any], study: Study) -> list[str]:
    """Return the keys in which a study differs from that of a log."""
    design = study.model_dump(mode="json")
    return [key for key in design if head["study"].get(key) != design[key]]


def _check_head(path: Path, head: dict[str, Any], study: Study, participant: str) -> None:
    if head.get("format") != FORMAT or head.get("version") != VERSION:
        raise InputError(str(path), Unquoted("another format or version"), f"{FORMAT}, version {VERSION}")
    if head["participant"] != participant:
        raise InputError(f"{path}: participant", head["participant"], f"{participant!r}")
    changed = _list_changes(head, study)
    if changed:
        expected = "the study with which the session began; a changed one needs another folder"
        raise InputError(f"{path}: study", Unquoted(f"another {', '.join(changed)}"), expected)


def _is_index(trial: object, order: Sequence[object]) -> bool:
    return isinstance(trial, int) and 0 <= trial < len(order)


def _parse_line(place: str, line: bytes) -> dict[str, Any]:
    try:
        record = json.loads(line)
    except ValueError:
        record = None
    if not isinstance(record, dict):
        raise InputError(place, Unquoted("a damaged line"), "one JSON object")
    return record


def _sync_folder(folder: Path) -> None:
    """Put a new file's name on the disk."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
