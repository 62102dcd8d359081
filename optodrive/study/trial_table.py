"""The tables of trials of a dataset, read back: which trials count, and results by participant.

Theory of operation. Everything comes from the columns of `*_beh.tsv` and the description beside each, never from the
logs or the study's file, so that a dataset can be judged by what others read of it. A trial is `practice`, `excluded`
by a rule of the study, a `catch` trial, or it is `main`: only the last kind enters accuracies and thresholds. The guess
rate is that of the design, 1 of n answers. Where the same answer is correct in all main trials (yes/no), it is the
participant's own, and is fitted.
"""

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import permutations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from optodrive.core.errors import InputError, Unquoted
from optodrive.core.extras import import_extra
from optodrive.core.files import read_regular_file
from optodrive.core.numeric_tables import FORMULA_STARTS
from optodrive.core.types.arrays import FloatArray
from optodrive.study.results import CONFIDENCE, Accuracy, find_equality
from optodrive.study.threshold import (
    GUESSING_MAX,
    SLOPE_RANGE,
    Flag,
    ThresholdEstimate,
    ThresholdModel,
    sum_binomial,
)

TABLE_BYTES_MAX = 100_000_000
MISSING = "n/a"
REQUIRED = ("trial", "answer", "is_correct", "response_time")
KINDS = ("main", "catch", "practice", "excluded")
PERMUTED_MAX = 6
"""Largest number of answers whose permutations are tried, to find exchanged keys."""
PERMUTED_PROBABILITY = 1e-3
"""Largest probability by chance of the agreement with a permutation at which keys count as exchanged."""
TABLE_COLUMNS = ("participant", "session", "kind")


class Trial(NamedTuple):
    """One row of a table.

    session, block: empty if there is only one; kind: one of KINDS; cells: of the row by column
    """

    participant: str
    session: str
    block: str
    kind: str
    cells: Mapping[str, str]

    @property
    def is_correct(self) -> bool | None:
        """Whether the answer is correct, None if none is."""
        return None if self.cells["is_correct"] == MISSING else self.cells["is_correct"] == "1"

    def read_number(self, column: str) -> float | None:
        """Return a number of the row, None for `n/a` or a text."""
        try:
            return float(self.cells.get(column, MISSING))
        except ValueError:
            return None


class ThresholdResult(NamedTuple):
    """Threshold of a participant in a session and block.

    answered: level and correctness; estimate: None where an equality is sought; equality: level of equality
    """

    participant: str
    session: str
    block: str
    answered: list[tuple[int, bool]]
    estimate: ThresholdEstimate | None
    equality: float | None


class ParticipantResult(NamedTuple):
    """Counts and accuracy of one participant.

    counts: trials by kind; accuracy: of the main trials with a correct answer; catch: of the catch trials with one
    flags: why the answers may be no judgements
    """

    participant: str
    counts: dict[str, int]
    accuracy: Accuracy | None
    catch: Accuracy | None
    response_time_s: float | None
    flags: tuple[Flag, ...]


class GroupMean(NamedTuple):
    """Mean over participants with its 95 % interval (Student), None of fewer than two."""

    mean: float
    low: float | None
    high: float | None
    participants: int


@dataclass(frozen=True, eq=False)
class TrialTable:
    """All trials of one task. description: of the columns and the design, as the first table's `.json` has it."""

    task: str
    description: Mapping[str, Any]
    trials: tuple[Trial, ...]

    @cached_property
    def participants(self) -> tuple[str, ...]:
        """Participants in the order of the tables."""
        return tuple(dict.fromkeys(trial.participant for trial in self.trials))

    @cached_property
    def main(self) -> tuple[Trial, ...]:
        """The trials that count."""
        return tuple(trial for trial in self.trials if trial.kind == "main" and trial.cells["answer"] != MISSING)

    @cached_property
    def answers(self) -> tuple[str, ...]:
        """The possible answers, none of a magnitude."""
        return tuple(map(_read_cell, self.description.get("answer", {}).get("Levels", ())))

    @cached_property
    def analysis(self) -> Mapping[str, Any]:
        """Guess rate, column of levels, slopes, columns of factors and interval of an equality."""
        usual: dict[str, Any] = {
            "GuessRate": None,
            "Level": None,
            "Slopes": SLOPE_RANGE,
            "Factors": [],
            "EqualInterval": None,
        }
        return usual | dict(self.description.get("Analysis", {}))

    @cached_property
    def correct_answers(self) -> tuple[str, ...]:
        """The answers that are correct in a main trial, in the order of the answers."""
        found = {trial.cells.get("correct_answer", MISSING) for trial in self.main} - {MISSING}
        return tuple(sorted(found, key=lambda each: (self.answers.index(each) if each in self.answers else 99, each)))

    @cached_property
    def guess_rate(self) -> float | None:
        """Share of correct answers by guessing, None if the participant chooses it or there is no correct answer."""
        if len(self.correct_answers) < 2:
            return None
        stated = self.analysis["GuessRate"]
        return 1.0 / max(2, len(self.answers)) if stated is None else float(stated)

    @cached_property
    def levels(self) -> tuple[float, ...]:
        """Levels of the parameter whose threshold is sought, by the design and as shown, none if there is none."""
        column = self.analysis["Level"]
        if column is None:
            return ()
        stated = self.description.get(column, {}).get("Levels", ())
        shown = (trial.read_number(column) for trial in self.main)
        return tuple(sorted({float(level) for level in stated} | {level for level in shown if level is not None}))

    @cached_property
    def model(self) -> ThresholdModel:
        """Model of the thresholds."""
        low, high = self.analysis["Slopes"]
        return ThresholdModel(self.levels, self.guess_rate, (float(low), float(high)))

    def list_thresholds(self) -> Iterator[ThresholdResult]:
        """Yield the threshold, or the equality, of each participant, session and block."""
        column, name = self.analysis["Level"], self.analysis["EqualInterval"]
        if len(self.levels) < 2:
            return
        for key in dict.fromkeys(trial[:3] for trial in self.main):
            answered = [
                (
                    self.levels.index(level),
                    (trial.cells["chosen_interval"] == name) if name else trial.is_correct is True,
                )
                for trial in self.main
                if trial[:3] == key
                and (level := trial.read_number(column)) is not None
                and (name or trial.is_correct is not None)
            ]
            if not answered:
                continue
            if name:
                yield ThresholdResult(*key, answered, None, find_equality(self.levels, answered)["equality"])
            else:
                yield ThresholdResult(*key, answered, self.model.estimate(answered), None)

    def judge_participant(self, participant: str) -> ParticipantResult:
        """Return counts and accuracy of a participant, and why the answers may be no judgements."""
        own = [trial for trial in self.trials if trial.participant == participant]
        main = [trial for trial in self.main if trial.participant == participant]
        counts = Counter(trial.kind for trial in own)
        times_s = [t_s for trial in main if (t_s := trial.read_number("response_time")) is not None]
        accuracy = count_correct(main)
        return ParticipantResult(
            participant,
            {kind: counts[kind] for kind in KINDS},
            accuracy,
            count_correct([trial for trial in own if trial.kind == "catch"]),
            float(np.median(times_s)) if times_s else None,
            () if accuracy is None else tuple(self._list_flags(main, accuracy)),
        )

    def _list_flags(self, main: Sequence[Trial], accuracy: Accuracy) -> Iterator[Flag]:
        """Yield why answers may be no judgements. A threshold has flags of its own."""
        correct, trials = accuracy
        if self.guess_rate is None:
            return
        if correct == 0:
            yield Flag.ALL_WRONG
        elif self._find_permutation(main, accuracy) or sum_binomial(correct, trials, self.guess_rate) < GUESSING_MAX:
            yield Flag.EXCHANGED_KEYS
        elif not self.levels and sum_binomial(trials - correct, trials, 1.0 - self.guess_rate) > 0.05:
            yield Flag.GUESSING

    def _find_permutation(self, main: Sequence[Trial], accuracy: Accuracy) -> bool:
        """Return whether answers agree with a permutation of the keys much better than with the keys themselves."""
        count = len(self.answers)
        if not 2 <= count <= PERMUTED_MAX or self.guess_rate is None:
            return False
        matrix = self.count_confusions(main)
        orders = list(permutations(range(count)))
        best = max(int(sum(matrix[k, order[k]] for k in range(count))) for order in orders)
        correct, trials = accuracy
        if best <= correct or sum_binomial(trials - correct, trials, 1.0 - self.guess_rate) < GUESSING_MAX:
            return False
        by_chance = len(orders) * sum_binomial(trials - best, trials, 1.0 - self.guess_rate)
        return by_chance < PERMUTED_PROBABILITY

    def count_confusions(self, trials: Sequence[Trial]) -> FloatArray:
        """Return how often each answer was given where each is correct, [correct, answer] in the order of answers."""
        matrix = np.zeros((len(self.answers), len(self.answers)))
        for trial in trials:
            correct, answer = trial.cells.get("correct_answer", MISSING), trial.cells["answer"]
            if correct in self.answers and answer in self.answers:
                matrix[self.answers.index(correct), self.answers.index(answer)] += 1
        return matrix

    def format(self) -> str:
        """Return all trials as one tab-separated table, with participant, session and kind before the columns."""
        names = list(dict.fromkeys(name for trial in self.trials for name in trial.cells))
        rows = [[*TABLE_COLUMNS, *names]]
        rows += [
            [t.participant, t.session or MISSING, t.kind, *(t.cells.get(name, MISSING) for name in names)]
            for t in self.trials
        ]
        return "".join("\t".join(row) + "\n" for row in rows)


def compute_group_mean(values: Sequence[float]) -> GroupMean:
    """Return the mean over participants [n], n of 1 or more, with its 95 % interval."""
    mean, count = float(np.mean(values)), len(values)
    if count < 2:
        return GroupMean(mean, None, None, count)
    half = float(
        import_extra("scipy.special", "scipy").stdtrit(count - 1, 0.5 + 0.5 * CONFIDENCE)
        * np.std(values, ddof=1)
        / np.sqrt(count)
    )
    return GroupMean(mean, mean - half, mean + half, count)


def read_tables(folder: Path) -> list[TrialTable]:
    """Read the tables of a dataset, one per task. Raise InputError with the file and line."""
    paths = sorted([*folder.glob("sub-*/beh/*_beh.tsv"), *folder.glob("sub-*/ses-*/beh/*_beh.tsv")])
    if not paths:
        raise InputError(str(folder), Unquoted("no table of trials"), "a dataset that `optodrive study` has written")
    tasks: dict[str, list[Path]] = {}
    for path in paths:
        tasks.setdefault(_read_entity(path, "task"), []).append(path)
    return [_read_task(task, listed) for task, listed in tasks.items()]


def _read_task(task: str, paths: Sequence[Path]) -> TrialTable:
    trials = [trial for path in paths for trial in _read_table(path)]
    blocks = {trial.block for trial in trials if trial.kind == "main"}
    if len(blocks) == 1:
        trials = [trial._replace(block="") for trial in trials]
    beside = paths[0].with_suffix(".json")
    try:
        description = json.loads(read_regular_file(beside, TABLE_BYTES_MAX))
    except (OSError, ValueError):
        raise InputError(str(beside), Unquoted("no description"), "the JSON file that belongs to the table") from None
    return TrialTable(task, description, tuple(trials))


def _read_entity(path: Path, entity: str) -> str:
    """Return a part of a file's name, `detection` of `sub-01_task-detection_beh.tsv`, '' if there is none."""
    return next((part.partition("-")[2] for part in path.stem.split("_") if part.startswith(f"{entity}-")), "")


def _read_table(path: Path) -> Iterator[Trial]:
    try:
        lines = read_regular_file(path, TABLE_BYTES_MAX).decode("utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise InputError(str(path), Unquoted("another encoding"), "UTF-8") from None
    head = lines[0].split("\t") if lines else []
    missing = [name for name in REQUIRED if name not in head]
    if missing:
        raise InputError(f"{path}, line 1", Unquoted("no " + ", ".join(missing)), "the columns of a table of trials")
    participant, session = _read_entity(path, "sub"), _read_entity(path, "ses")
    for number, line in enumerate(lines[1:], start=2):
        cells = line.split("\t")
        if len(cells) != len(head):
            found = Unquoted(f"{len(cells)} of {len(head)} cells")
            raise InputError(f"{path}, line {number}", found, "a cell per column, separated by tabs")
        row = dict(zip(head, map(_read_cell, cells), strict=True))
        yield Trial(participant, session, row.get("block", ""), _find_kind(row), row)


def _read_cell(cell: str) -> str:
    """Return a cell without the apostrophe of `escape_formula`."""
    return cell[1:] if cell[:1] == "'" and cell[1:2] in FORMULA_STARTS else cell


def _find_kind(row: Mapping[str, str]) -> str:
    if row.get("phase") == "practice":
        return "practice"
    if row.get("exclusion", MISSING) != MISSING:
        return "excluded"
    return "catch" if row.get("is_catch") == "1" else "main"


def count_correct(trials: Sequence[Trial]) -> Accuracy | None:
    """Return the correct answers of the trials that have one, None if there is none."""
    judged = [trial.is_correct for trial in trials if trial.is_correct is not None]
    return Accuracy(sum(judged), len(judged)) if judged else None
