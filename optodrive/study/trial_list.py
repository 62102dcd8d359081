"""The trial list of a session: a pure function of the study, the participant's code, the session and the seed.

Theory of operation. A session is practice, then blocks. Each block has every condition of its factors as often, or as
many trials as its procedure states, and its catch trials at random places among them. The order of trials and of blocks
is that of the file, random, or a row of a Latin square, in which every condition precedes every other equally often
(Williams 1949): the row is the number in the participant's code, so consecutive codes are balanced. All that is random
comes from one generator that the seed, the code and the session seed. The log of a session records the list.

Practice stands in the list at its largest length; what a criterion spares is skipped.
"""

import random
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import permutations
from math import ceil
from typing import Any, Literal, TypeVar

from optodrive.core.errors import InputError
from optodrive.study.study_file import Study
from optodrive.study.study_sections import BlockSection, Value
from optodrive.study.threshold import draw_constant_levels

Item = TypeVar("Item")
ORDERS_MAX = 1000
"""Largest number of orders of the intervals that are balanced."""


@dataclass(frozen=True)
class ListedTrial:
    """A trial of the list.

    block: its name, `practice` for practice; condition: the value of each factor
    intervals: names in the order in which they are shown, none for a trial of one part
    """

    block: str
    phase: Literal["practice", "main"]
    is_catch: bool
    condition: Mapping[str, Value]
    intervals: tuple[str, ...] = ()

    def to_record(self) -> dict[str, Any]:
        """Return the trial as JSON values."""
        return {**asdict(self), "condition": dict(self.condition), "intervals": list(self.intervals)}

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> "ListedTrial":
        """Return the trial of a record."""
        return cls(**{**record, "intervals": tuple(record["intervals"])})


def list_trials(study: Study, participant: str, session: int = 1) -> list[ListedTrial]:
    """Return the trials of a session in order, with practice at its largest length.

    Raise InputError for a Latin square and a code without a number.
    """
    seed = f"{study.seed} {participant}" + (f" {session}" if study.sessions > 1 else "")
    rng = random.Random(seed)
    row = _find_row(study, participant, session)
    blocks = _arrange(study.order.blocks, list(study.block_list), rng, row)
    trials = [] if study.practice is None else list(_list_practice(study, blocks[0], rng))
    for number, block in enumerate(blocks):
        trials += _list_block(study, block, rng, row + number, f"{seed} levels {block.name}")
    return trials


def _list_practice(study: Study, first: BlockSection, rng: random.Random) -> Iterator[ListedTrial]:
    practice = study.practice
    if practice is None:
        return
    block = first.model_copy(update={"factors": {**first.factors, **practice.factors}})
    conditions = list(study.list_conditions(block))
    chosen: list[dict[str, Value]] = []
    while len(chosen) < practice.count_max:
        chosen += rng.sample(conditions, len(conditions))
    procedure = study.procedure
    strongest = {} if procedure is None else {procedure.parameter: procedure.levels[-1]}
    orders = _draw_intervals(study, practice.count_max, rng)
    for condition, order in zip(chosen, orders, strict=False):
        yield ListedTrial("practice", "practice", False, {**strongest, **condition}, order)


def _list_block(study: Study, block: BlockSection, rng: random.Random, row: int, seed: str) -> list[ListedTrial]:
    count, conditions = study.count_trials(block), list(study.list_conditions(block))
    repetitions = ceil(count / len(conditions))
    if study.order.trials == "latin-square":
        chosen = [one for each in range(repetitions) for one in _arrange("latin-square", conditions, rng, row + each)]
    else:
        chosen = _arrange(study.order.trials, conditions * repetitions, rng, row)
    chosen = chosen[:count]
    procedure = study.procedure
    if procedure is not None and procedure.kind == "constant":
        levels = draw_constant_levels(len(procedure.levels), procedure.trials, seed)
        chosen = [{**one, procedure.parameter: procedure.levels[k]} for one, k in zip(chosen, levels, strict=True)]
    orders = _draw_intervals(study, len(chosen), rng)
    trials = [ListedTrial(block.name, "main", False, one, order) for one, order in zip(chosen, orders, strict=True)]
    if study.catch is not None:
        strongest = {procedure.parameter: procedure.levels[-1]} if procedure is not None else {}
        for order in _draw_intervals(study, study.catch.trials, rng):
            trial = ListedTrial(block.name, "main", True, {**rng.choice(conditions), **strongest}, order)
            trials.insert(rng.randint(0, len(trials)), trial)
    return trials


def _draw_intervals(study: Study, count: int, rng: random.Random) -> list[tuple[str, ...]]:
    """Return the order of the intervals of each trial, each possible order as often to within one."""
    names = study.interval_names
    if study.order.intervals == "fixed":
        return [names] * count
    orders = list(dict.fromkeys(_take(permutations(names), ORDERS_MAX)))
    drawn = (rng.sample(orders, len(orders)) * ceil(count / len(orders)))[:count]
    rng.shuffle(drawn)
    return drawn


def _take(items: Iterator[Item], count: int) -> Iterator[Item]:
    return (item for item, _ in zip(items, range(count), strict=False))


def _arrange(order: str, items: list[Item], rng: random.Random, row: int) -> list[Item]:
    """Return items as stated, at random, or by a row of a Latin square."""
    if order == "random":
        return rng.sample(items, len(items))
    return [items[index] for index in build_latin_row(len(items), row)] if order == "latin-square" else items


def build_latin_row(count: int, row: int) -> list[int]:
    """Return a row of a Latin square of `count` conditions in which each follows each other one equally often.

    The square has `count` rows, or twice as many for an odd number, of which the second half is the mirrored first.
    """
    zigzag = [(k + 1) // 2 if k % 2 else -(k // 2) % count for k in range(count)]
    shifted = [(place + row) % count for place in zigzag]
    return shifted[::-1] if count % 2 and row // count % 2 else shifted


def _find_row(study: Study, participant: str, session: int) -> int:
    """Return the row of the Latin squares: the number in the code, from 1, and one further per session."""
    if "latin-square" not in (study.order.trials, study.order.blocks):
        return 0
    number = re.search(r"\d+", participant)
    if number is None:
        raise InputError("--participant", participant, "a code with a number, such as 07, for the Latin square")
    return int(number[0]) + session - 2


def is_practice_over(study: Study, records: Sequence[Mapping[str, Any]]) -> bool:
    """Return whether no further practice trial comes after those of `records`, in order."""
    practice = study.practice
    if practice is None or len(records) >= practice.count_max:
        return True
    return has_passed_practice(study, records) and practice.criterion is not None


def has_passed_practice(study: Study, records: Sequence[Mapping[str, Any]]) -> bool:
    """Return whether the last practice trials have reached the criterion, if there is one."""
    practice = study.practice
    if practice is None or practice.criterion is None:
        return True
    last = records[-practice.trials :]
    correct = sum(record["is_correct"] is True for record in last)
    return len(last) == practice.trials and correct >= practice.criterion * practice.trials - 1e-9


def find_session_exclusion(study: Study, records: Sequence[Mapping[str, Any]]) -> str | None:
    """Return the rule by which all trials of a session are excluded: `practice` or `catch_trials`, else None."""
    practised = [record for record in records if record["phase"] == "practice"]
    if any(record["phase"] == "main" for record in records) and not has_passed_practice(study, practised):
        return "practice"
    caught = [record for record in records if record["is_catch"] and record["phase"] == "main"]
    errors_max = None if study.catch is None else study.catch.errors_max
    if errors_max is not None and caught:
        wrong = sum(record["is_correct"] is not True for record in caught)
        if wrong > errors_max * len(caught) + 1e-9:
            return "catch_trials"
    return None


def find_exclusion(study: Study, record: Mapping[str, Any]) -> str | None:
    """Return the rule by which a trial is excluded: `no_answer` or `too_fast`, else None."""
    if record["answer"] is None:
        return "no_answer"
    min_s = study.response.min_s
    return "too_fast" if min_s is not None and record["response_time_s"] < min_s else None
