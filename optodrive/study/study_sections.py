"""Sections of a study file: stimuli, intervals, order, blocks, practice, responses, questionnaires and simulation."""

import json
import re
from importlib.resources import files
from itertools import pairwise
from math import isclose
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, model_validator

from optodrive.core.errors import MISSING, suggest_nearest
from optodrive.core.toml_model import ConflictError, Name, Section
from optodrive.study.threshold import Procedure

CHANCE_TOLERANCE = 1e-3
TEXT_MAX = 5000
NUMBER_MAX = 1e9
"""Bound of a number that a participant may answer."""

TEXTS: dict[str, str] = json.loads(files("optodrive.study").joinpath("page", "texts.json").read_bytes())
"""Sentences of the participant's page and of the terminal by key. Words in braces stand for what is filled in."""

Value = str | int | float
Factors = dict[str, Annotated[tuple[Value, ...], Field(min_length=1)]]


def _require_text(text: str) -> str:
    if not all(character.isprintable() or character == "\n" for character in text):
        raise ValueError("printable characters and ends of lines")
    return text


Text = Annotated[str, Field(min_length=1, max_length=TEXT_MAX), AfterValidator(_require_text)]
"""A text of several lines that people read."""
Identifier = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_-]{0,39}$")]
Share = Annotated[float, Field(ge=0.0, le=1.0)]


def check_page_text(key: str, text: str) -> None:
    """Raise ConflictError for a sentence that the page has not, or that lacks or adds a word in braces."""
    place = f"texts.{key}"
    if key not in TEXTS:
        raise ConflictError(place, key, f"a sentence of the page, {suggest_nearest(key, list(TEXTS))}")
    words, found = (sorted(re.findall(r"\{\w*\}|[{}\n]", each)) for each in (TEXTS[key], text))
    if found != words:
        raise ConflictError(place, text, f"one line with {' and '.join(words) or 'no braces'}")


class StimulusSection(Section):
    """A stimulus, or a change of one: a key that a section leaves open keeps its value."""

    pattern: Name | None = None
    """A name that `optodrive patterns` lists."""
    frames: dict[str, Any] | None = None
    """In place of a pattern: the path of a FRAMES.json beside the study file, or its content."""
    nothing: bool | None = None
    """Show nothing, for as long as the stimulus would last."""
    parameters: dict[str, Value] = Field(default_factory=dict)
    """Parameters of the pattern, or places in the frames such as `trains.0.start_s` or `trains.*.target_um`."""
    gap_s: Annotated[float, Field(ge=0.0, le=60.0)] | None = None
    """Time between two intervals."""

    @model_validator(mode="after")
    def _check_source(self) -> "StimulusSection":
        if self.pattern is not None and self.frames is not None:
            raise ConflictError("frames", "a file", "none beside a pattern")
        return self


class IntervalSection(StimulusSection):
    """One part of a trial, which changes the stimulus of the trial."""

    name: Identifier
    count: Annotated[int, Field(ge=1, le=10)] = 1
    """Number of such intervals in a trial."""


class OrderSection(Section):
    """The order of trials, blocks and intervals."""

    trials: Literal["random", "fixed", "latin-square"] = "random"
    """Of the trials within a block; a Latin square orders each repetition of the conditions."""
    blocks: Literal["fixed", "random", "latin-square"] = "fixed"
    intervals: Literal["fixed", "random"] = "fixed"
    blocked_by: str | None = None
    """A factor each of whose values makes a block."""


class BlockSection(Section):
    """Trials that come together."""

    name: Identifier
    factors: Factors = Field(default_factory=dict)
    """Factors of this block, beside or in place of those of the study."""
    repetitions: Annotated[int, Field(ge=1, le=1000)] | None = None
    instructions: Text | None = None
    """Shown before the block."""


class CatchSection(Section):
    """Trials without a stimulus, or without a difference, mixed into each block."""

    trials: Annotated[int, Field(ge=1, le=1000)]
    """Number of catch trials per block."""
    shows: Identifier = "nothing"
    """`nothing`, or the interval that all intervals of the trial show."""
    answer: Name | None = None
    """The correct answer, none if there is no such."""
    errors_max: Share | None = None
    """Largest share of wrong answers; with more, all trials of the session are marked as excluded."""


class PracticeSection(Section):
    """Trials before the first block that do not count."""

    trials: Annotated[int, Field(ge=1, le=500)]
    """Smallest number, by whose last answers the criterion is judged."""
    criterion: Share | None = None
    """Share of correct answers in the last `trials` that ends the practice."""
    trials_max: Annotated[int, Field(ge=1, le=1000)] | None = None
    """Number after which it ends in any case; a session without the criterion is marked as excluded."""
    feedback: bool = True
    """Whether the participant is told if an answer is correct."""
    factors: Factors = Field(default_factory=dict)
    """Factors in place of those of the study, such as easier levels."""
    instructions: Text | None = None

    @model_validator(mode="after")
    def _check_criterion(self) -> "PracticeSection":
        if (self.criterion is None) != (self.trials_max is None):
            raise ConflictError("trials_max", self.trials_max, "stated beside a criterion, and only there")
        if self.trials_max is not None and self.trials_max < self.trials:
            raise ConflictError("trials_max", self.trials_max, f"at least {self.trials}, the smallest number")
        return self

    @property
    def count_max(self) -> int:
        """Largest number of practice trials."""
        return self.trials if self.trials_max is None else self.trials_max


class ResponseSection(Section):
    """The participant's response."""

    kind: Literal["choice", "magnitude", "number"]
    """One of the answers, a place on a scale from 0 to 1, both excluded, or any positive number."""
    question: Name
    answers: tuple[Name, ...] = ()
    labels: tuple[Name, ...] = ()
    """What the participant reads in place of each answer, such as its translation."""
    correct_factor: Name | None = None
    """The factor whose value is the correct answer."""
    correct_interval: Identifier | None = None
    """The interval whose place in the trial is the correct answer; the answers are the places in order."""
    correct_largest: Name | None = None
    """The parameter by whose largest value an interval is the correct one; the answers are the places in order."""
    correct_position: Annotated[int, Field(ge=1, le=10)] | None = None
    """The place whose interval's name is the correct answer."""
    level: Name | None = None
    """The factor along which a psychometric function is fitted, with numbers of which 0 would be no difference."""
    chance_level: Annotated[float, Field(gt=0.0, lt=1.0)] | None = None
    """Share of correct answers by guessing; states the design's, and is checked."""
    min_s: Annotated[float, Field(ge=0.0, le=60.0)] | None = None
    """Shortest response time; a shorter one is marked as excluded."""
    max_s: Annotated[float, Field(gt=0.0, le=3600.0)] | None = None
    """Time after which the trial ends without an answer."""
    feedback: bool = False
    """Whether the participant is told if an answer is correct, also after practice."""
    again: bool = True
    """Whether the participant may ask for the stimulus once more."""

    @property
    def rules(self) -> dict[str, str | int]:
        """The stated rules of the correct answer, by key."""
        keys = ("correct_factor", "correct_interval", "correct_largest", "correct_position")
        return {key: value for key in keys if (value := getattr(self, key)) is not None}

    @property
    def is_by_place(self) -> bool:
        """Whether the correct answer is the place of an interval."""
        return self.correct_interval is not None or self.correct_largest is not None

    @property
    def number_max(self) -> float:
        """Bound of a magnitude or a number, which lies below it."""
        return 1.0 if self.kind == "magnitude" else NUMBER_MAX

    @model_validator(mode="after")
    def _check_answers(self) -> "ResponseSection":
        if self.kind != "choice":
            if self.level is not None:
                raise ConflictError("level", self.level, f"none: {self.kind} has no correct answer")
            if self.answers or self.labels or self.rules or self.chance_level:
                raise ConflictError(
                    "answers", self.answers, f"none, no correct answer and no chance_level: {self.kind}"
                )
            return self
        if len(set(self.answers)) != len(self.answers) or len(self.answers) < 2:
            raise ConflictError("answers", self.answers, "at least two, all different")
        if self.labels and (len(self.labels) != len(self.answers) or len(set(self.labels)) != len(self.labels)):
            raise ConflictError("labels", self.labels, f"{len(self.answers)}, all different: one per answer")
        if len(self.rules) > 1:
            raise ConflictError(
                list(self.rules)[1], list(self.rules.values())[1], f"none beside {next(iter(self.rules))}"
            )
        share = 1.0 / len(self.answers)
        is_given = self.chance_level is not None and isclose(self.chance_level, share, abs_tol=CHANCE_TOLERANCE)
        if not is_given and (self.rules or self.chance_level is not None):
            expected = f"{share:.4f}, for one of {len(self.answers)} answers"
            raise ConflictError("chance_level", MISSING if self.chance_level is None else self.chance_level, expected)
        if self.min_s is not None and self.max_s is not None and self.min_s >= self.max_s:
            raise ConflictError("max_s", self.max_s, f"more than min_s, {self.min_s:g}")
        return self


class ProcedureSection(Section):
    """The choice of a level for each trial of a block, to find the threshold of a parameter, or an equality."""

    kind: Procedure
    """Every level as often, 1 up and `down` down, or the most informative level next."""
    parameter: Name
    """The pattern's parameter whose threshold is sought."""
    levels: Annotated[tuple[Annotated[float, Field(gt=0.0)], ...], Field(min_length=3, max_length=100)]
    """Values of the parameter in increasing order."""
    trials: Annotated[int, Field(ge=1, le=1000)]
    """Number of trials per block."""
    down: Annotated[int, Field(ge=1, le=4)] = 2
    """Correct answers in a row that lower a staircase by one level."""
    equal_interval: Identifier | None = None
    """In place of a correct answer: seek the level at which this interval is named as often as not."""

    @model_validator(mode="after")
    def _check_levels(self) -> "ProcedureSection":
        if any(low >= high for low, high in pairwise(self.levels)):
            raise ConflictError("levels", self.levels, "increasing values")
        if self.equal_interval is not None and self.kind == "quest-plus":
            raise ConflictError("kind", self.kind, "staircase or constant, to seek an equality")
        return self


class MatchingSection(Section):
    """Comparisons of places, chosen by the answers so far, by which the sensitivity over the display is found."""

    trials: Annotated[int, Field(ge=1, le=5000)]
    places: Annotated[int, Field(ge=2, le=200)] = 60
    """Number of compared pixels, spread over the display."""
    intensity: Annotated[float, Field(gt=0.0, le=100.0)]
    """Perceived intensity at which they are compared, in thresholds."""


class QuestionSection(Section):
    """A field of the questionnaire."""

    name: Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,39}$")]
    """Column of the table of answers."""
    question: Name
    kind: Literal["choice", "number", "text"] = "text"
    answers: tuple[Name, ...] = ()
    when: Literal["before", "after"] = "before"

    @model_validator(mode="after")
    def _check_answers(self) -> "QuestionSection":
        if (self.kind == "choice") != (len(self.answers) >= 2) or len(set(self.answers)) != len(self.answers):
            raise ConflictError("answers", self.answers, "at least two that differ for a choice, none otherwise")
        if self.name in ("participant_id", "session_id", "when"):
            raise ConflictError("name", self.name, "another name: the table has this column")
        return self


class SimulationSection(Section):
    """The simulated participant."""

    observer: Literal[
        "linear-motion",
        "rotation",
        "localisation",
        "intensity",
        "oddball",
        "digits",
        "detection",
        "comparison",
        "interval",
        "order",
        "identification",
        "motion",
    ]
    """The rule by which it answers."""
    feature: Literal["intensity", "rate", "gap", "extent"] = "intensity"
    """What the observer `interval` compares."""
    sensitivity_range: Annotated[float, Field(ge=1.0, le=10.0)] = 1.0
    """Largest over smallest sensitivity over the display, which varies smoothly and differs between participants."""


class PublishedSection(Section):
    """Results that a paper states for this design."""

    source: Name
    participants: Annotated[int, Field(ge=1)]
    trials_per_participant: Annotated[int, Field(ge=1)]
    correct: Annotated[int, Field(ge=0)] | None = None
    """Correct answers of all participants together."""
    r_squared: Annotated[float, Field(ge=0.0, le=1.0)] | None = None
    contradictions: tuple[str, ...] = ()
    """Places at which the source contradicts itself."""

    @property
    def trials(self) -> int:
        """Trials of all participants together."""
        return self.participants * self.trials_per_participant
