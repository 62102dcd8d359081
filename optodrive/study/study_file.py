"""Study files: the design of an experiment with people, as TOML of a stated version."""

import re
from collections.abc import Mapping
from itertools import pairwise, product
from math import isclose
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from optodrive.core.errors import InputError
from optodrive.core.toml_model import ConflictError, Name, Section, check_format, parse_table, read_toml
from optodrive.study.threshold import Procedure

FORMAT, VERSION = "optodrive-study", 1
EXPERIMENTS = Path(__file__).with_name("experiments")
SIMULATED_PREFIX = "sim"
"""Beginning of the identifiers of simulated participants."""
TRIALS_MAX = 10_000
CHANCE_TOLERANCE = 1e-3
MATCHING_ANSWERS = ("first", "second")
OBSERVER_ANSWERS: dict[str, tuple[str, ...]] = {
    "linear-motion": ("left", "right", "up", "down"),
    "rotation": ("cw", "ccw"),
    "localisation": tuple("123456789"),
    "detection": ("left", "right"),
}
"""All answers of the observers that name what they feel. The others number the parts of a stimulus, or rate it."""
MAGNITUDE_OBSERVER = "intensity"
MATCHED_PARAMETERS = ("first", "second", "first_intensity", "second_intensity")
"""Parameters of the stimulus of a matching, which vary between trials."""

Value = str | int | float
Condition = Mapping[str, Value]
"""One value of each factor."""


def _require_task_name(text: str) -> str:
    if not re.fullmatch(r"[a-z0-9]+(-[a-z0-9]+)*", text):
        raise ValueError("small letters and digits, with single hyphens between them")
    return text


class StimulusSection(Section):
    """The stimulus of every trial."""

    pattern: Name
    """A name that `optodrive patterns` lists; the factors are parameters of it."""
    parameters: dict[str, Value] = Field(default_factory=dict)
    """Parameters with the same value in every trial."""


class ResponseSection(Section):
    """The participant's response."""

    kind: Literal["choice", "magnitude"]
    """One of the answers, or a number between 0 and 1, both excluded, on a scale."""
    question: Name
    answers: tuple[Name, ...] = ()
    correct_factor: Name | None = None
    """The factor whose value is the correct answer."""
    chance_level: Annotated[float, Field(gt=0.0, lt=1.0)] | None = None
    """Share of correct answers by guessing; states the design's, and is checked."""

    @model_validator(mode="after")
    def _check_answers(self) -> "ResponseSection":
        if self.kind == "magnitude":
            if self.answers or self.correct_factor or self.chance_level:
                raise ConflictError("answers", self.answers, "none, no correct_factor and no chance_level: a magnitude")
            return self
        if len(set(self.answers)) != len(self.answers) or len(self.answers) < 2:
            raise ConflictError("answers", self.answers, "at least two, all different")
        if self.chance_level is None or not isclose(
            self.chance_level, 1.0 / len(self.answers), abs_tol=CHANCE_TOLERANCE
        ):
            expected = f"{1.0 / len(self.answers):.4f}, for one of {len(self.answers)} answers"
            raise ConflictError("chance_level", self.chance_level, expected)
        return self


class ProcedureSection(Section):
    """The choice of a level for each trial, to find the threshold of a parameter."""

    kind: Procedure
    """Every level as often, 1 up and 2 down, or the most informative level next."""
    parameter: Name
    """The pattern's parameter whose threshold is sought."""
    levels: Annotated[tuple[Annotated[float, Field(gt=0.0)], ...], Field(min_length=3, max_length=100)]
    """Values of the parameter in increasing order."""
    trials: Annotated[int, Field(ge=1, le=1000)]

    @model_validator(mode="after")
    def _check_levels(self) -> "ProcedureSection":
        if any(low >= high for low, high in pairwise(self.levels)):
            raise ConflictError("levels", self.levels, "increasing values")
        return self


class MatchingSection(Section):
    """Comparisons of places, chosen by the answers so far, by which the sensitivity over the display is found."""

    trials: Annotated[int, Field(ge=1, le=5000)]
    places: Annotated[int, Field(ge=2, le=200)] = 60
    """Number of compared pixels, spread over the display."""
    intensity: Annotated[float, Field(gt=0.0, le=100.0)]
    """Perceived intensity at which they are compared, in thresholds."""


class SimulationSection(Section):
    """The simulated participant."""

    observer: Literal[
        "linear-motion", "rotation", "localisation", "intensity", "oddball", "digits", "detection", "comparison"
    ]
    """The rule by which it answers."""
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


class Study(Section):
    """Design of an experiment: conditions, repetitions, order and responses."""

    format: Literal["optodrive-study"]
    version: Literal[1]
    name: Annotated[str, Field(max_length=60), AfterValidator(_require_task_name)]
    """Small letters, digits and hyphens; the task of the dataset is the name without hyphens."""
    title: Name
    seed: Annotated[int, Field(ge=0)]
    """Seed of the orders of trials; each participant's is recorded in the session's log."""
    repetitions: Annotated[int, Field(ge=1, le=1000)] = 1
    """Number of trials with each condition; a procedure states its own number of trials."""
    pause_s: Annotated[float, Field(ge=0.0, le=600.0)]
    """Time from an answer to the next stimulus."""
    familiarisation: bool = False
    """Whether each stimulus is shown once, without a response, before the first trial."""
    stimulus: StimulusSection
    factors: dict[str, Annotated[tuple[Value, ...], Field(min_length=1)]] = Field(default_factory=dict)
    """Values of each factor; the conditions are their combinations."""
    response: ResponseSection
    procedure: ProcedureSection | None = None
    matching: MatchingSection | None = None
    simulation: SimulationSection | None = None
    published: PublishedSection | None = None

    @model_validator(mode="after")
    def _check_factors(self) -> "Study":
        if self.matching is not None:
            self._check_matching()
        elif not self.factors:
            raise ConflictError("factors", self.factors, "at least one factor")
        for name, values in self.factors.items():
            if len(set(map(repr, values))) != len(values):
                raise ConflictError(f"factors.{name}", values, "values that differ")
            if name in self.stimulus.parameters:
                raise ConflictError(f"factors.{name}", values, "a factor that is no parameter of the stimulus too")
        correct = self.response.correct_factor
        if correct is not None:
            if correct not in self.factors:
                raise ConflictError("response.correct_factor", correct, f"one of {', '.join(self.factors)}")
            for value in self.factors[correct]:
                if str(value) not in self.response.answers:
                    raise ConflictError(f"factors.{correct}", value, "one of the answers")
        if self.procedure is not None:
            if correct is None:
                raise ConflictError("response.correct_factor", correct, "a factor: a threshold needs correct answers")
            if self.procedure.parameter in {**self.factors, **self.stimulus.parameters}:
                raise ConflictError("procedure.parameter", self.procedure.parameter, "neither a factor nor a constant")
            if self.repetitions != 1:
                raise ConflictError("repetitions", self.repetitions, "none: the procedure states the number of trials")
        if self.trial_count > TRIALS_MAX:
            raise ConflictError("repetitions", self.repetitions, f"at most {TRIALS_MAX} trials in all")
        self._check_observer()
        return self

    def _check_observer(self) -> None:
        """Raise ConflictError for a simulated participant that cannot give the study's answers."""
        if self.simulation is None:
            return
        observer, answers = self.simulation.observer, self.response.answers
        if (observer == MAGNITUDE_OBSERVER) != (self.response.kind == "magnitude"):
            given = "magnitudes" if self.response.kind == "magnitude" else ", ".join(answers)
            raise ConflictError("simulation.observer", observer, f"an observer whose answers are {given}")
        possible = OBSERVER_ANSWERS.get(observer, answers)
        if not set(answers) <= set(possible):
            expected = (
                f"an observer whose answers are {', '.join(answers)}; those of this one are {', '.join(possible)}"
            )
            raise ConflictError("simulation.observer", observer, expected)

    def _check_matching(self) -> None:
        if self.factors:
            raise ConflictError("factors", self.factors, "none: the answers choose the comparisons")
        if self.stimulus.pattern != "comparison" or self.stimulus.parameters:
            raise ConflictError("stimulus", self.stimulus.pattern, "the pattern comparison without parameters")
        if self.response.answers != MATCHING_ANSWERS or self.response.correct_factor is not None:
            expected = f"{', '.join(MATCHING_ANSWERS)}, without a correct_factor"
            raise ConflictError("response.answers", self.response.answers, expected)
        if self.procedure is not None:
            raise ConflictError("procedure", self.procedure.kind, "none beside [matching]")
        if self.repetitions != 1:
            raise ConflictError("repetitions", self.repetitions, "none: [matching] states the number of trials")

    @property
    def conditions(self) -> tuple[dict[str, Value], ...]:
        """All combinations of the factors' values, the last factor fastest."""
        return tuple(dict(zip(self.factors, values, strict=True)) for values in product(*self.factors.values()))

    @property
    def trial_count(self) -> int:
        """Number of trials of one participant."""
        if self.procedure is not None:
            return self.procedure.trials
        if self.matching is not None:
            return self.matching.trials
        return len(self.conditions) * self.repetitions

    @property
    def task(self) -> str:
        """Name of the task in a dataset, which has letters and digits only."""
        return self.name.replace("-", "")

    def find_correct_answer(self, condition: Condition) -> str | None:
        """Return the correct answer in a condition, None if no answer is."""
        factor = self.response.correct_factor
        return None if factor is None else str(condition[factor])


def list_shipped_studies() -> list[str]:
    """Return the names of the shipped studies."""
    return sorted(path.stem for path in EXPERIMENTS.glob("*.toml"))


def load_study(source: str) -> Study:
    """Read a study file, or a shipped one by its name. Raise InputError with one line."""
    names = list_shipped_studies()
    path = EXPERIMENTS / f"{source}.toml" if source in names else Path(source)
    if not path.is_file():
        raise InputError("study", source, "a file, or " + ", ".join(names))
    table = read_toml(path)
    check_format(path, table, FORMAT, VERSION)
    return parse_table(path, table, Study)
