"""Study files: the design of an experiment with people, as TOML of a stated version."""

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, model_validator

from optodrive.core.errors import MISSING, InputError, Unquoted, suggest_nearest
from optodrive.core.files import read_bounded
from optodrive.core.toml_model import ConflictError, Name, Section, check_format, parse_table, read_toml
from optodrive.planning.stimuli.json_values import decode_json
from optodrive.study.study_sections import (
    TEXTS,
    BlockSection,
    CatchSection,
    Factors,
    IntervalSection,
    MatchingSection,
    OrderSection,
    PracticeSection,
    ProcedureSection,
    PublishedSection,
    QuestionSection,
    ResponseSection,
    SimulationSection,
    StimulusSection,
    Text,
    Value,
    check_page_text,
)

FORMAT, VERSION = "optodrive-study", 2
EXPERIMENTS = Path(__file__).with_name("experiments")
SIMULATED_PREFIX = "sim"
"""Beginning of the identifiers of simulated participants."""
TRIALS_MAX = 10_000
LEVELS_MIN = 3
"""Smallest number of levels of a psychometric function."""
MATCHING_ANSWERS = ("first", "second")
OBSERVER_ANSWERS: dict[str, tuple[str, ...]] = {
    "linear-motion": ("left", "right", "up", "down"),
    "rotation": ("cw", "ccw"),
    "localisation": tuple("123456789"),
    "detection": ("left", "right"),
    "motion": ("motion", "succession"),
}
"""All answers of the observers that name what they feel. The others number the parts of a stimulus, or rate it."""
MAGNITUDE_OBSERVER = "intensity"
MATCHED_PARAMETERS = ("first", "second", "first_intensity", "second_intensity")
"""Parameters of the stimulus of a matching, which vary between trials."""
TEXT_QUOTES = re.compile(r"\"\"\"|'''")
"""Beginning or end of a text of several lines."""
GAP = "gap_s"
"""The factor, or parameter of a procedure, that is the time between two intervals."""

Condition = Mapping[str, Value]
"""One value of each factor."""


def _require_task_name(text: str) -> str:
    if not re.fullmatch(r"[a-z0-9]+(-[a-z0-9]+)*", text):
        raise ValueError("small letters and digits, with single hyphens between them")
    return text


class Study(Section):
    """Design of an experiment: conditions, repetitions, order and responses."""

    format: Literal["optodrive-study"]
    version: Literal[2]
    name: Annotated[str, Field(max_length=60), AfterValidator(_require_task_name)]
    """Small letters, digits and hyphens; the task of the dataset is the name without hyphens."""
    title: Name
    seed: Annotated[int, Field(ge=0)]
    """Seed of the orders of trials; each participant's is recorded in the session's log."""
    repetitions: Annotated[int, Field(ge=1, le=1000)] = 1
    """Number of trials with each condition; a procedure states its own number of trials."""
    sessions: Annotated[int, Field(ge=1, le=99)] = 1
    """Number of sessions of each participant, such as on several days."""
    pause_s: Annotated[float, Field(ge=0.0, le=600.0)]
    """Time from an answer to the next stimulus."""
    familiarisation: bool = False
    """Whether each stimulus is shown once, without a response, before the first trial."""
    break_every: Annotated[int, Field(ge=1, le=1000)] | None = None
    """Number of trials after which the participant is offered a break."""
    language: Annotated[str, Field(pattern=r"^[a-z]{2,3}(-[A-Za-z0-9]{2,8})*$")] = "en"
    """Language of the page, such as `de`."""
    instructions: Text | None = None
    """Shown before the first stimulus."""
    texts: dict[str, Text] = Field(default_factory=dict)
    """Sentences of the page in place of its own, as a translation."""
    stimulus: StimulusSection = Field(default_factory=StimulusSection)
    """What every trial shows."""
    intervals: Annotated[tuple[IntervalSection, ...], Field(max_length=10)] = ()
    """The parts of a trial, one after the other; none: one part."""
    factors: Factors = Field(default_factory=dict)
    """Values of each factor; the conditions are their combinations."""
    levels: dict[str, dict[str, StimulusSection]] = Field(default_factory=dict)
    """What the values of a factor that is no parameter change, by factor and value."""
    order: OrderSection = Field(default_factory=OrderSection)
    blocks: Annotated[tuple[BlockSection, ...], Field(max_length=100)] = ()
    catch: CatchSection | None = None
    practice: PracticeSection | None = None
    response: ResponseSection
    procedure: ProcedureSection | None = None
    matching: MatchingSection | None = None
    questions: Annotated[tuple[QuestionSection, ...], Field(max_length=30)] = ()
    """A questionnaire of a few fields."""
    simulation: SimulationSection | None = None
    published: PublishedSection | None = None

    @model_validator(mode="after")
    def _check_design(self) -> "Study":
        if self.matching is not None:
            self._check_matching()
        self._check_factors()
        self._check_blocks()
        self._check_answer()
        self._check_level()
        if self.procedure is not None:
            self._check_procedure(self.procedure)
        if self.trial_count > TRIALS_MAX:
            raise ConflictError("repetitions", self.repetitions, f"at most {TRIALS_MAX} trials in all")
        names = [question.name for question in self.questions]
        if len(set(names)) < len(names):
            raise ConflictError("questions", names, "names that differ")
        for key, text in self.texts.items():
            check_page_text(key, text)
        self._check_observer()
        return self

    def _list_factors(self) -> Iterator[tuple[str, str, tuple[Value, ...]]]:
        """Yield place, name and values of every list of a factor's values."""
        for name, values in self.factors.items():
            yield f"factors.{name}", name, values
        for index, block in enumerate(self.blocks):
            for name, values in block.factors.items():
                yield f"blocks.{index}.factors.{name}", name, values
        for name, values in (self.practice.factors if self.practice else {}).items():
            yield f"practice.factors.{name}", name, values

    def _check_factors(self) -> None:
        known = {name for place, name, _ in self._list_factors() if not place.startswith("practice")}
        for place, name, values in self._list_factors():
            if len(set(map(repr, values))) != len(values):
                raise ConflictError(place, values, "values that differ")
            if name in self.stimulus.parameters:
                raise ConflictError(place, values, "a factor that is no parameter of the stimulus too")
            is_level = self.procedure is not None and name == self.procedure.parameter
            if place.startswith("practice") and name not in known and not is_level:
                raise ConflictError(place, values, "a factor of the study")
            if name == GAP and not all(isinstance(value, int | float) and 0.0 <= value <= 60.0 for value in values):
                raise ConflictError(place, values, "times from 0 to 60 s")
        for factor, levels in self.levels.items():
            texts = [str(value) for _, name, listed in self._list_factors() if name == factor for value in listed]
            if not texts:
                raise ConflictError(f"levels.{factor}", factor, f"a factor, {suggest_nearest(factor, sorted(known))}")
            for level in levels:
                if level not in texts:
                    raise ConflictError(f"levels.{factor}", level, f"a value of the factor: {', '.join(texts)}")
        is_shown = self.stimulus.pattern is not None or self.stimulus.frames is not None
        others = [*self.intervals, *(level for levels in self.levels.values() for level in levels.values())]
        if not is_shown and not any(each.pattern is not None or each.frames is not None for each in others):
            raise ConflictError("stimulus.pattern", MISSING, "a pattern, or frames")

    def _check_blocks(self) -> None:
        names = [block.name for block in self.blocks]
        if len(set(names)) < len(names):
            raise ConflictError("blocks", names, "names that differ")
        by = self.order.blocked_by
        if by is not None:
            if by not in self.factors:
                expected = f"a factor, {suggest_nearest(by, list(self.factors))}" if self.factors else "no factor"
                raise ConflictError("order.blocked_by", by, expected)
            if self.blocks:
                raise ConflictError("blocks", names, "none beside order.blocked_by, which makes the blocks")
        if self.order.trials == "latin-square" and self.procedure is not None:
            raise ConflictError("order.trials", self.order.trials, "random or fixed, beside a procedure")
        names = [interval.name for interval in self.intervals]
        if len(set(names)) < len(names):
            raise ConflictError("intervals", names, "names that differ, with count for several alike")
        if self.order.intervals == "random" and len(self.interval_names) < 2:
            raise ConflictError("order.intervals", self.order.intervals, "at least two intervals")
        if self.catch is not None:
            if self.catch.shows != "nothing" and self.catch.shows not in names:
                raise ConflictError("catch.shows", self.catch.shows, f"one of {', '.join(['nothing', *names])}")
            if self.catch.answer is not None and self.catch.answer not in self.response.answers:
                raise ConflictError("catch.answer", self.catch.answer, "one of the answers")
            if self.catch.errors_max is not None and self.catch.answer is None:
                raise ConflictError("catch.errors_max", self.catch.errors_max, "a catch.answer beside it")
        if self.practice is not None and self.practice.criterion is not None and not self.response.rules:
            raise ConflictError("practice.criterion", self.practice.criterion, "none: no answer is correct")

    def _check_answer(self) -> None:
        """Raise ConflictError for a rule of the correct answer that the study cannot follow."""
        response, names = self.response, self.interval_names
        is_equality = self.procedure is not None and self.procedure.equal_interval is not None
        if (response.is_by_place or is_equality) and len(response.answers) != len(names):
            raise ConflictError("response.answers", response.answers, f"one per interval, {len(names)} in order")
        if response.correct_interval is not None and names.count(response.correct_interval) != 1:
            raise ConflictError("response.correct_interval", response.correct_interval, f"one of {', '.join(names)}")
        if response.correct_position is not None:
            if response.correct_position > len(names):
                raise ConflictError("response.correct_position", response.correct_position, f"1 to {len(names)}")
            for name in names:
                if name not in response.answers:
                    raise ConflictError("intervals", name, "one of the answers")
        correct = response.correct_factor
        if correct is None:
            return
        listed = [(place, values) for place, name, values in self._list_factors() if name == correct]
        if not listed:
            known = dict.fromkeys(name for _, name, _ in self._list_factors())
            raise ConflictError("response.correct_factor", correct, f"one of {', '.join(known)}")
        for place, values in listed:
            for value in values:
                if str(value) not in response.answers:
                    raise ConflictError(place, value, "one of the answers")

    def _check_level(self) -> None:
        """Raise ConflictError for a level along which no psychometric function can be fitted."""
        level, place = self.response.level, "response.level"
        if level is None:
            return
        if self.procedure is not None:
            raise ConflictError(place, level, "none beside [procedure], which has levels of its own")
        if not self.response.rules:
            raise ConflictError("response.correct_factor", MISSING, "a rule of the correct answer beside a level")
        listed = [(where, values) for where, name, values in self._list_factors() if name == level]
        known = dict.fromkeys(name for _, name, _ in self._list_factors())
        if not any(not where.startswith("practice") for where, _ in listed):
            raise ConflictError(place, level, f"one of {', '.join(known) or 'the factors, of which there is none'}")
        for where, values in listed:
            for value in values:
                if isinstance(value, str) or value <= 0.0:
                    raise ConflictError(where, value, f"numbers above 0: {place}")
        if len(self.threshold_levels) < LEVELS_MIN:
            raise ConflictError(place, level, f"a factor with at least {LEVELS_MIN} values")
        if self.order.blocked_by == level:
            raise ConflictError("order.blocked_by", level, f"another factor: a block has all values of {place}")

    def _check_procedure(self, procedure: ProcedureSection) -> None:
        if procedure.equal_interval is not None:
            if self.response.rules or self.interval_names.count(procedure.equal_interval) != 1:
                expected = f"one of {', '.join(self.interval_names)}, without a correct answer"
                raise ConflictError("procedure.equal_interval", procedure.equal_interval, expected)
        elif not self.response.rules:
            raise ConflictError("response.correct_factor", MISSING, "a factor: a threshold needs correct answers")
        names = {name for place, name, _ in self._list_factors() if not place.startswith("practice")}
        if procedure.parameter in {*names, *self.stimulus.parameters}:
            raise ConflictError("procedure.parameter", procedure.parameter, "neither a factor nor a constant")
        if self.repetitions != 1:
            raise ConflictError("repetitions", self.repetitions, "none: the procedure states the number of trials")

    def _check_observer(self) -> None:
        """Raise ConflictError for a simulated participant that cannot give the study's answers."""
        if self.simulation is None:
            return
        observer, answers = self.simulation.observer, self.response.answers
        if (observer == MAGNITUDE_OBSERVER) != (self.response.kind != "choice"):
            given = "magnitudes" if self.response.kind != "choice" else ", ".join(answers)
            raise ConflictError("simulation.observer", observer, f"an observer whose answers are {given}")
        if observer == "interval" and len(answers) != max(1, len(self.interval_names)):
            expected = (
                f"another: it names one of {len(self.interval_names)} intervals, the study has {len(answers)} answers"
            )
            raise ConflictError("simulation.observer", observer, expected)
        possible = self.interval_names if observer == "order" else OBSERVER_ANSWERS.get(observer, answers)
        if observer == "identification":
            possible = tuple(map(str, self.factors.get(self.response.correct_factor or "", ())))
        if not set(answers) <= set(possible):
            own = ", ".join(possible) or "none here"
            expected = f"an observer whose answers are {', '.join(answers)}; those of this one are {own}"
            raise ConflictError("simulation.observer", observer, expected)

    def _check_matching(self) -> None:
        if self.factors:
            raise ConflictError("factors", self.factors, "none: the answers choose the comparisons")
        if self.stimulus.pattern != "comparison" or self.stimulus.parameters:
            raise ConflictError("stimulus", self.stimulus.pattern, "the pattern comparison without parameters")
        if self.response.answers != MATCHING_ANSWERS or self.response.rules:
            expected = f"{', '.join(MATCHING_ANSWERS)}, without a correct answer"
            raise ConflictError("response.answers", self.response.answers, expected)
        for key in ("procedure", "catch", "practice", "blocks", "intervals"):
            if getattr(self, key):
                raise ConflictError(key, Unquoted("a section"), "none beside [matching]")
        if self.repetitions != 1:
            raise ConflictError("repetitions", self.repetitions, "none: [matching] states the number of trials")

    @property
    def interval_names(self) -> tuple[str, ...]:
        """Name of every interval of a trial, in the order of the file."""
        return tuple(interval.name for interval in self.intervals for _ in range(interval.count))

    @property
    def block_list(self) -> tuple[BlockSection, ...]:
        """The blocks in the order of the file: as stated, one per value of the blocking factor, or a single one."""
        by = self.order.blocked_by
        if by is not None:
            return tuple(
                BlockSection.model_construct(
                    name=f"{by}-{value}", factors={by: (value,)}, repetitions=None, instructions=None
                )
                for value in self.factors[by]
            )
        return self.blocks or (
            BlockSection.model_construct(name="main", factors={}, repetitions=None, instructions=None),
        )

    def list_conditions(self, block: BlockSection | None = None) -> tuple[dict[str, Value], ...]:
        """Return all combinations of the factors' values in a block, the last factor fastest."""
        factors = {**self.factors, **(block.factors if block else {})}
        return tuple(dict(zip(factors, values, strict=True)) for values in product(*factors.values()))

    @property
    def conditions(self) -> tuple[dict[str, Value], ...]:
        """All conditions of all blocks, each once."""
        found = [condition for block in self.block_list for condition in self.list_conditions(block)]
        return tuple({repr(condition): condition for condition in found}.values())

    @property
    def varied(self) -> dict[str, tuple[Value, ...]]:
        """Values of each parameter that varies between trials, none of one that is chosen freely."""
        found: dict[str, dict[Value, None]] = {}
        for _, name, values in self._list_factors():
            found.setdefault(name, {}).update(dict.fromkeys(values))
        listed = {name: tuple(values) for name, values in found.items()}
        if self.procedure is not None:
            listed[self.procedure.parameter] = self.procedure.levels
        return listed | (dict.fromkeys(MATCHED_PARAMETERS, ()) if self.matching is not None else {})

    @property
    def tabulated(self) -> dict[str, tuple[Value, ...]]:
        """Values of each parameter of the table of trials: those that vary, and constants that no interval changes."""
        changed = {name for interval in self.intervals for name in interval.parameters}
        changed |= {name for levels in self.levels.values() for level in levels.values() for name in level.parameters}
        constants = {name: (value,) for name, value in self.stimulus.parameters.items() if name not in changed}
        return {**self.varied, **constants}

    @property
    def threshold_of(self) -> str | None:
        """The parameter or factor whose threshold, or equality, the study finds."""
        return self.response.level if self.procedure is None else self.procedure.parameter

    @property
    def threshold_levels(self) -> tuple[float, ...]:
        """Levels of `threshold_of` in increasing order."""
        if self.procedure is not None:
            return self.procedure.levels
        listed = [one for one in self._list_factors() if one[1] == self.response.level and one[0][:8] != "practice"]
        return tuple(sorted({float(value) for _, _, values in listed for value in values}))

    def count_trials(self, block: BlockSection) -> int:
        """Return the number of trials of a block, without catch trials."""
        if self.procedure is not None:
            return self.procedure.trials
        if self.matching is not None:
            return self.matching.trials
        repetitions = self.repetitions if block.repetitions is None else block.repetitions
        return len(self.list_conditions(block)) * repetitions

    @property
    def trial_count(self) -> int:
        """Number of trials of one session, with catch trials and without practice."""
        blocks = self.block_list
        catch = 0 if self.catch is None else self.catch.trials * len(blocks)
        return sum(map(self.count_trials, blocks)) + catch

    @property
    def task(self) -> str:
        """Name of the task in a dataset, which has letters and digits only."""
        return self.name.replace("-", "")

    @property
    def page_texts(self) -> dict[str, str]:
        """Every sentence of the page, by key."""
        return {**TEXTS, **self.texts}


def list_shipped_studies() -> list[str]:
    """Return the names of the shipped studies."""
    return sorted(path.stem for path in EXPERIMENTS.glob("*.toml"))


def _find_path(source: str) -> Path:
    return EXPERIMENTS / f"{source}.toml" if source in list_shipped_studies() else Path(source)


def load_study(source: str) -> Study:
    """Read a study file with its frames, or a shipped one by its name. Raise InputError with one line."""
    path = _find_path(source)
    if not path.is_file():
        raise InputError("study", source, "a file, or " + ", ".join(list_shipped_studies()))
    table = read_toml(path)
    try:
        check_format(path, table, FORMAT, VERSION)
        _read_frames(path, "", table)
        return parse_table(path, table, Study)
    except InputError as error:
        line = _find_line(path, error.where.removeprefix(f"{path}: "))
        if line is None or not error.where.startswith(f"{path}: "):
            raise
        where = error.where.replace(f"{path}: ", f"{path}, line {line}: ", 1)
        raise InputError(where, error.value, error.expected, error.code) from None


def _find_line(path: Path, place: str) -> int | None:
    """Return the line of a TOML file that states a dotted key, or else the nearest table around it."""
    sought, found, best = place.split("."), None, 0
    table: list[str] = []
    counts: dict[str, int] = {}
    is_within_text = False
    for number, text in enumerate(path.read_text("utf-8-sig").splitlines(), start=1):
        was_within_text, is_within_text = is_within_text, is_within_text ^ bool(len(TEXT_QUOTES.findall(text)) % 2)
        if was_within_text:
            continue
        header = re.match(r"\s*(\[\[?)([^\[\]]+)\]", text)
        key = re.match(r"""\s*((?:[\w-]+|"[^"]*"|'[^']*')(?:\s*\.\s*(?:[\w-]+|"[^"]*"|'[^']*'))*)\s*=""", text)
        if header is None and key is None:
            continue
        if header is not None:
            table = parts = _split_key(header[2])
            if header[1] == "[[":
                name = ".".join(parts)
                counts[name] = counts.get(name, -1) + 1
                table = [*parts, str(counts[name])]
                parts = parts if parts == sought else table
        elif key is not None:
            parts = table + _split_key(key[1])
        depth = len(parts) if parts == sought[: len(parts)] else 0
        if depth > best:
            found, best = number, depth
    return found


@contextmanager
def name_lines(source: str) -> Iterator[None]:
    """Add the line of a study file to the error about a stimulus that a display has not, where one line states it."""
    try:
        yield
    except InputError as error:
        path = _find_path(source)
        line = _find_parameter(path, error) if error.where.startswith("study ") else None
        if line is None:
            raise
        raise InputError(f"{path}, line {line}: {error.where}", error.value, error.expected, error.code) from None


def _find_parameter(path: Path, error: InputError) -> int | None:
    """Return the line with the name of a refused parameter, and with its value if one has both."""
    last, shown = error.where.split(" ")[-1], f"{error.value:g}" if isinstance(error.value, float) else str(error.value)
    lines = list(enumerate(path.read_text("utf-8-sig").splitlines(), start=1))
    for name in (last, last.rpartition(".")[2], str(error.value)):
        named = [
            (number, text) for number, text in lines if re.search(rf"""(?<![\w.]){re.escape(name)}["']?\s*=""", text)
        ]
        if named:
            return next((number for number, text in named if shown in text), named[0][0])
    return None


def _split_key(text: str) -> list[str]:
    """Return the parts of a dotted key, a quoted one split at its dots as in the place of an error."""
    return [part for part in re.sub(r"""["'\s]""", "", text).split(".") if part]


def _read_frames(path: Path, place: str, table: Any) -> None:
    """Replace every path of a FRAMES.json by its content."""
    items = table.items() if isinstance(table, dict) else enumerate(table) if isinstance(table, list) else ()
    for key, value in items:
        where = f"{place}.{key}" if place else str(key)
        if key == "frames" and isinstance(value, str):
            content = decode_json(read_bounded(path.parent / value), value)
            if not isinstance(content, dict):
                raise InputError(f"{path}: {where}", value, "a FRAMES.json, which is an object")
            table[key] = content
        elif key != "parameters":
            _read_frames(path, where, value)
