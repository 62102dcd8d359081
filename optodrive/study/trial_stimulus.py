"""Stimuli of trials: all intervals of a trial as one sequence on one time line, and the correct answer.

An interval changes the study's stimulus in this order: the levels and values of the factors, what the interval itself
states, and factors that name the interval, such as `comparison.rate_hz`. All intervals of a trial are one plan, so the
board keeps the time between them.
"""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from optodrive.core.errors import InputError
from optodrive.core.types.stimuli import FrameSequence
from optodrive.device.config import Config
from optodrive.planning.stimuli.pattern_registry import build_pattern
from optodrive.planning.stimuli.sequence_file import parse_sequence, sequence_to_json, validate_sequence
from optodrive.study.study_file import GAP, Condition, Study
from optodrive.study.study_sections import StimulusSection, Value
from optodrive.study.trial_list import ListedTrial, list_trials

NOTHING = "nothing"


@dataclass(frozen=True)
class ShownInterval:
    """Stimulus of one interval.

    gap_s: from the end of the interval before; name: '' of a trial of one part
    """

    name: str
    pattern: str | None
    frames: Mapping[str, Any] | None
    is_empty: bool
    parameters: dict[str, Value]
    gap_s: float

    def to_record(self) -> dict[str, Any]:
        """Return the request without the content of frames, which stands in the study."""
        shown = NOTHING if self.is_empty else "frames" if self.pattern is None else self.pattern
        return {"name": self.name, "pattern": shown, "parameters": self.parameters}

    def build(self, config: Config, where: str) -> FrameSequence:
        """Return the sequence that is shown, also of an empty interval, which lasts as long."""
        if self.pattern is not None:
            return build_pattern(self.pattern, self.parameters, config)
        if self.frames is None:
            raise InputError(f"{where}: stimulus.pattern", None, "a pattern, or frames, in every condition")
        body = json.loads(json.dumps(self.frames))
        for path, value in self.parameters.items():
            _set_values(body, path, value, f"{where}: {path}")
        return parse_sequence(body, config, f"{where}: frames")


class IntervalTimes(NamedTuple):
    """An interval on the time line of its trial, s."""

    name: str
    start_s: float
    end_s: float


@dataclass(frozen=True)
class TrialStimulus:
    """The stimulus of a trial.

    sequence: None if nothing is shown; intervals: their times; requested: what each shows, as JSON values
    """

    sequence: FrameSequence | None
    intervals: tuple[IntervalTimes, ...]
    requested: list[dict[str, Any]]

    @property
    def duration_s(self) -> float:
        """End of the last interval, s."""
        return self.intervals[-1].end_s

    @property
    def has_silent_end(self) -> bool:
        """Whether the last interval shows nothing."""
        return bool(self.requested[-1]["pattern"] == NOTHING)

    @property
    def first_start_s(self) -> float:
        """Requested start of the first pulse or frame, s, 0 if nothing is shown."""
        if self.sequence is None:
            return 0.0
        starts_s = [frame.show_at_s for frame in self.sequence.frames]
        return min(starts_s + [train.start_s for train in self.sequence.trains])

    def to_body(self) -> dict[str, object]:
        """Return the sequence as the body of a plan request."""
        return {} if self.sequence is None else sequence_to_json(self.sequence)


def resolve_intervals(study: Study, trial: ListedTrial, condition: Condition) -> list[ShownInterval]:
    """Return the stimuli of the intervals of a trial, in order.

    condition: of the trial, with a procedure's level
    """
    if not study.intervals:
        shown = _resolve(study, None, condition)
        is_empty = trial.is_catch or shown.is_empty
        return [replace(shown, is_empty=is_empty)]
    catch = study.catch
    if not trial.is_catch or catch is None:
        return [_resolve(study, name, condition) for name in trial.intervals]
    if catch.shows == NOTHING:
        return [replace(_resolve(study, name, condition), is_empty=True) for name in trial.intervals]
    alike = _resolve(study, catch.shows, condition)
    return [replace(alike, name=name) for name in trial.intervals]


def _resolve(study: Study, name: str | None, condition: Condition) -> ShownInterval:
    layers = [study.stimulus]
    own: dict[str, Value] = {}
    for factor, value in condition.items():
        prefix, _, parameter = factor.partition(".")
        if factor in study.levels:
            layers += [study.levels[factor][str(value)]] if str(value) in study.levels[factor] else []
        elif parameter and prefix in study.interval_names:
            own |= {parameter: value} if prefix == name else {}
        elif factor == GAP:
            layers.append(StimulusSection.model_construct(gap_s=float(value)))
        else:
            layers.append(StimulusSection.model_construct(parameters={factor: value}))
    layers += [interval for interval in study.intervals if interval.name == name]
    pattern, frames, is_empty, gap_s = None, None, False, 0.0
    parameters: dict[str, Value] = {}
    for layer in layers:
        if layer.pattern is not None or layer.frames is not None:
            pattern, frames = layer.pattern, layer.frames
        is_empty = is_empty if layer.nothing is None else layer.nothing
        gap_s = gap_s if layer.gap_s is None else layer.gap_s
        parameters = {**parameters, **layer.parameters}
    return ShownInterval(name or "", pattern, frames, is_empty, {**parameters, **own}, gap_s)


def build_stimulus(study: Study, trial: ListedTrial, condition: Condition, config: Config) -> TrialStimulus:
    """Return the stimulus of a trial on a display. Raise InputError with the parameter that the display has not."""
    where, end_s = f"study {study.name}", 0.0
    times: list[IntervalTimes] = []
    parts: list[FrameSequence] = []
    shown = resolve_intervals(study, trial, condition)
    for number, interval in enumerate(shown):
        sequence = interval.build(config, where)
        start_s = end_s + (interval.gap_s if number else 0.0)
        end_s = start_s + _find_end_s(sequence)
        times.append(IntervalTimes(interval.name, start_s, end_s))
        if not interval.is_empty:
            parts.append(_shift(sequence, start_s, number))
    requested = [interval.to_record() for interval in shown]
    if not parts:
        return TrialStimulus(None, tuple(times), requested)
    frames = tuple(frame for part in parts for frame in part.frames)
    joined = FrameSequence(frames, tuple(train for part in parts for train in part.trains))
    return TrialStimulus(validate_sequence(joined, where, config), tuple(times), requested)


def _find_end_s(sequence: FrameSequence) -> float:
    ends_s = [frame.show_at_s + frame.duration_s for frame in sequence.frames]
    return max(ends_s + [train.start_s + train.duration_s for train in sequence.trains])


def _shift(sequence: FrameSequence, by_s: float, number: int) -> FrameSequence:
    """Return a sequence that starts later, with frames whose names no other interval has."""
    by_s = round(by_s, 6)
    frames = [
        replace(frame, show_at_s=frame.show_at_s + by_s, frame_id=f"{frame.frame_id}-{number + 1}"[-100:])
        for frame in sequence.frames
    ]
    return FrameSequence(
        tuple(frames), tuple(replace(train, start_s=train.start_s + by_s) for train in sequence.trains)
    )


def _set_values(body: Any, path: str, value: Value, place: str) -> None:
    """Set the values at a dotted path of decoded JSON, `*` for every element. Raise InputError for no such place."""
    targets, parts = [body], path.split(".")
    for part in parts[:-1]:
        targets = [found for target in targets for found in _descend(target, part)]
    hits = [(target, key) for target in targets for key in _list_keys(target, parts[-1])]
    if not hits:
        raise InputError(place, path, "the place of a value in the frames, such as trains.0.start_s")
    for target, key in hits:
        target[key] = value


def _descend(target: Any, part: str) -> Iterator[Any]:
    for key in _list_keys(target, part):
        yield target[key]


def _list_keys(target: Any, part: str) -> list[Any]:
    """Return the keys or indices of a table or an array that a part of a path names."""
    if isinstance(target, dict):
        return list(target) if part == "*" else [part] if part in target else []
    if isinstance(target, list):
        return [index for index in range(len(target)) if part in ("*", str(index))]
    return []


def find_correct_answer(study: Study, trial: ListedTrial, condition: Condition) -> str | None:
    """Return the correct answer of a trial, None if no answer is correct."""
    response = study.response
    if trial.is_catch:
        return None if study.catch is None else study.catch.answer
    if response.correct_factor is not None:
        return str(condition[response.correct_factor])
    if response.correct_interval is not None:
        return response.answers[trial.intervals.index(response.correct_interval)]
    if response.correct_position is not None:
        return trial.intervals[response.correct_position - 1]
    if response.correct_largest is not None:
        key = response.correct_largest
        shown = resolve_intervals(study, trial, condition)
        values = [each.gap_s if key == GAP else each.parameters.get(key) for each in shown]
        numbers = [float(value) if isinstance(value, int | float) else 0.0 for value in values]
        largest = max(numbers)
        return None if numbers.count(largest) > 1 else response.answers[numbers.index(largest)]
    return None


def find_chosen_interval(study: Study, trial: ListedTrial, answer: object) -> str | None:
    """Return the name of the interval that an answer names by its place, None if answers are about something else."""
    is_equality = study.procedure is not None and study.procedure.equal_interval is not None
    if not (study.response.is_by_place or is_equality) or answer not in study.response.answers:
        return None
    return trial.intervals[study.response.answers.index(str(answer))]


def check_stimuli(study: Study, config: Config) -> None:
    """Raise InputError with the parameter unless a display has the stimuli of all conditions.

    Those of a procedure are tried at its lowest and highest level; a matching chooses its own.
    """
    if study.matching is not None:
        return
    tried: set[str] = set()
    procedure = study.procedure
    ends: list[dict[str, Value]] = (
        [{}] if procedure is None else [{procedure.parameter: procedure.levels[k]} for k in (0, -1)]
    )
    for trial in list_trials(study, "1"):
        for end in ends:
            condition = {**trial.condition, **end}
            key = repr((sorted(condition.items(), key=repr), sorted(trial.intervals)))
            if key in tried:
                continue
            tried.add(key)
            try:
                build_stimulus(
                    study, ListedTrial(trial.block, "main", False, condition, trial.intervals), condition, config
                )
            except InputError as error:
                where = error.where if error.where.startswith("study ") else f"study {study.name}: {error.where}"
                raise InputError(where, error.value, error.expected, error.code) from None
