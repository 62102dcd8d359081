"""Power of a study before it is run, from simulated participants.

Theory of operation. Every stimulus of the design is executed once on a cold simulated display. Simulated participants
answer it in whole sessions, in the order of the study's trial list, with the choices of its procedure, its catch trials
and its rules of exclusion. A study of N participants is N of these, drawn with replacement; the power is the share of
such studies whose 95 % interval of the effect excludes the reference. Without a spread participants are alike, all
answers are of one kind, and the interval of a share is the exact one of all answers together. Otherwise, and for any
other effect, it is Student's over participants. Drawing the simulated participants themselves anew (bootstrap) states
how far the power depends on which were simulated.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from math import exp, log
from typing import Any, NamedTuple, cast

import numpy as np

from optodrive.core.errors import MISSING, InputError
from optodrive.core.extras import import_extra
from optodrive.core.types.arrays import FloatArray
from optodrive.planning.display_model import DisplayModel
from optodrive.study.observers import Observer, Participant, draw_sensitivity
from optodrive.study.presenter import OnBegin, Presentation, VirtualPresenter, ignore_begin
from optodrive.study.results import CONFIDENCE, list_thresholds
from optodrive.study.session import Response, SimulatedRespondent, choose_condition
from optodrive.study.study_file import SIMULATED_PREFIX, Study
from optodrive.study.study_sections import Value
from optodrive.study.trial_list import ListedTrial, find_exclusion, find_session_exclusion, list_trials
from optodrive.study.trial_log import TrialLog
from optodrive.study.trial_stimulus import TrialStimulus, build_stimulus, find_chosen_interval, find_correct_answer

STUDIES, BOOTSTRAPS, BOOTSTRAP_STUDIES = 4000, 60, 500
TAIL = 0.5 - 0.5 * CONFIDENCE


class RememberedDisplay:
    """Presenter that executes each stimulus once, on a cold simulated display. Time does not pass."""

    def __init__(self, display: DisplayModel) -> None:
        self.display, self.config = display, display.config
        self._shown: dict[str, Presentation] = {}

    def present(self, stimulus: TrialStimulus, on_begin: OnBegin = ignore_begin) -> Presentation:
        """Return the executed stimulus. Raise RefusedError if the display cannot show it."""
        del on_begin  # nobody watches a clock
        key = repr((stimulus.requested, stimulus.intervals))
        if key not in self._shown:
            presenter = VirtualPresenter(self.display)
            self._shown[key] = presenter.present(stimulus)
            presenter.close()
        return self._shown[key]

    def wait(self, duration_s: float) -> None:
        """Do nothing."""


@dataclass
class _MemoryLog:
    """The part of a session's log by which a procedure chooses the next level."""

    order: list[ListedTrial]
    trials: dict[int, dict[str, Any]]


class Effect(NamedTuple):
    """An effect that a study may show, in each simulated participant.

    name: of the effect; reference: value that its interval is to exclude; values: of the participants [k], NaN of one
    without a value; trials: number of answers behind each [k], where these are alike and values are shares
    """

    name: str
    reference: float
    values: FloatArray
    trials: FloatArray | None

    @property
    def known(self) -> int:
        """Number of simulated participants with a value."""
        return int(np.isfinite(self.values).sum())

    @property
    def mean(self) -> float:
        """Mean of the simulated participants."""
        return float(np.nanmean(self.values))

    @property
    def test(self) -> str:
        """Name of the interval by which a study shows the effect."""
        if self.trials is not None:
            return "exact binomial interval of all answers together (participants are alike)"
        return "Student's interval over participants"


class Power(NamedTuple):
    """Power with a number of participants, its 95 % interval, and the median interval of the effect."""

    participants: int
    power: float
    low: float
    high: float
    effect_low: float
    effect_high: float


def simulate_sessions(
    study: Study, display: DisplayModel, count: int, spread: float, on_progress: Callable[[float], None]
) -> list[list[list[dict[str, Any]]]]:
    """Return the records of all trials of simulated participants, by participant and session, without practice.

    spread: standard deviation of the logarithm of the participants' acuity, by which their sensitivity is higher and
    places, features of intervals and onsets are told apart more finely
    """
    if study.simulation is None:
        raise InputError(f"study {study.name}: simulation", None, "an observer, to simulate a participant")
    presenter, built, found = RememberedDisplay(display), dict[str, Presentation](), []
    for number in range(1, count + 1):
        rng = np.random.default_rng((study.seed, number))
        sensitivity = draw_sensitivity(display.layout, study.simulation.sensitivity_range, rng)
        acuity = exp(spread * float(rng.standard_normal()))
        observer = Observer(study, display, Participant(acuity=acuity), acuity * sensitivity)
        sessions = []
        for session in range(1, study.sessions + 1):
            respondent = SimulatedRespondent(observer, study.seed, number, presenter, session)
            sessions.append(
                _simulate_session(study, presenter, respondent, f"{SIMULATED_PREFIX}{number}", session, built)
            )
        found.append(sessions)
        on_progress(number / count)
    return found


def _simulate_session(
    study: Study,
    presenter: RememberedDisplay,
    respondent: SimulatedRespondent,
    name: str,
    session: int,
    built: dict[str, Presentation],
) -> list[dict[str, Any]]:
    order = [listed for listed in list_trials(study, name, session) if listed.phase == "main"]
    log_of_session = _MemoryLog(order, {})
    for index, listed in enumerate(order):
        condition = choose_condition(study, cast("TrialLog", log_of_session), index, None)
        key = repr((condition, listed.intervals, listed.is_catch))
        if key not in built:
            built[key] = presenter.present(build_stimulus(study, listed, condition, presenter.config))
        response = respondent.respond(built[key], index, 1)
        log_of_session.trials[index] = _build_record(study, listed, condition, response)
    return [log_of_session.trials[index] for index in sorted(log_of_session.trials)]


def _build_record(study: Study, listed: ListedTrial, condition: dict[str, Value], response: Response) -> dict[str, Any]:
    correct = find_correct_answer(study, listed, condition)
    return {
        **listed.to_record(),
        "condition": condition,
        "answer": response.answer,
        "response_time_s": response.response_time_s,
        "chosen_interval": find_chosen_interval(study, listed, response.answer),
        "is_correct": None if correct is None or response.answer is None else response.answer == correct,
    }


def measure_effect(
    study: Study,
    people: Sequence[Sequence[Sequence[dict[str, Any]]]],
    compare: str | None,
    reference: float | None,
    spread: float,
) -> Effect:
    """Return the effect in each simulated participant. Raise InputError for an effect that the design has not.

    compare: factor whose first and last value are compared; None for the share of correct answers, or the threshold
    """
    kept = [[_keep(study, records) for records in sessions] for sessions in people]
    sought = study.threshold_of
    if sought is not None and compare is None and (study.procedure is not None or reference is not None):
        levels = study.threshold_levels
        is_within = reference is not None and levels[0] <= reference <= levels[-1]
        if reference is None or reference <= 0.0 or not (is_within or study.procedure is not None):
            expected = (
                f"a value of {sought}, {levels[0]:g} to {levels[-1]:g}, from which the threshold is to be told apart"
            )
            raise InputError("--reference", MISSING if reference is None else reference, expected)
        values = np.array([_find_log_threshold(study, sessions) for sessions in kept])
        return Effect(f"logarithm of {sought}", log(reference), values, None)
    people_records = [[record for session in sessions for record in session] for sessions in kept]
    if compare is not None:
        return _compare(study, people_records, compare, reference)
    if not study.response.rules:
        raise InputError("--compare", MISSING, f"one of {', '.join(study.factors)}: no answer is correct")
    judged = [
        [record["is_correct"] for record in records if record["is_correct"] is not None] for records in people_records
    ]
    trials = np.array([float(len(each)) for each in judged])
    shares = np.array([sum(each) / len(each) if each else np.nan for each in judged])
    chance = study.response.chance_level if reference is None else reference
    if chance is None or not 0.0 < chance < 1.0:
        raise InputError("--reference", MISSING if chance is None else chance, "a share between 0 and 1")
    return Effect("share of correct answers", chance, shares, trials if spread == 0.0 else None)


def _keep(study: Study, records: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the trials of a session that count."""
    if find_session_exclusion(study.model_copy(update={"practice": None}), records):
        return []
    return [record for record in records if not record["is_catch"] and find_exclusion(study, record) is None]


def _find_log_threshold(study: Study, sessions: Sequence[Sequence[dict[str, Any]]]) -> float:
    """Return the mean logarithm of a participant's thresholds or equalities, NaN without one."""
    found = list_thresholds(study, {str(k): session for k, session in enumerate(sessions)})
    levels = [one.get("threshold", one.get("equality")) for one in found.values()]
    logs = [log(level) for level in levels if level is not None and level > 0.0]
    return float(np.mean(logs)) if logs else float("nan")


def _compare(study: Study, people: Sequence[Sequence[dict[str, Any]]], factor: str, reference: float | None) -> Effect:
    values = study.varied.get(factor, ())
    if len(values) < 2:
        raise InputError("--compare", factor, f"one of {', '.join(study.varied) or 'none: the study has no factor'}")
    is_judged = bool(study.response.rules)
    if not is_judged and study.response.kind == "choice":
        raise InputError("--compare", factor, "a study with correct answers, magnitudes or numbers")

    def average(records: Sequence[dict[str, Any]], value: Value) -> float:
        own = [record for record in records if record["condition"].get(factor) == value]
        scores = [
            float(record["is_correct"]) if is_judged else log(float(record["answer"]))
            for record in own
            if not is_judged or record["is_correct"] is not None
        ]
        return float(np.mean(scores)) if scores else float("nan")

    name = "share of correct answers" if is_judged else "logarithm of the answers"
    differences = np.array([average(each, values[-1]) - average(each, values[0]) for each in people])
    name = f"{name}, {factor} {values[-1]} less {values[0]}"
    return Effect(name, 0.0 if reference is None else reference, differences, None)


def compute_powers(effect: Effect, participants: Sequence[int], seed: int) -> Iterator[Power]:
    """Yield the power of studies with each number of participants."""
    rng = np.random.default_rng(seed)
    known = np.flatnonzero(np.isfinite(effect.values))
    if len(known) < 2:
        raise InputError("--seeds", len(known), "at least two simulated participants with a value of the effect")
    for number in participants:
        low, high = _find_intervals(effect, known[rng.integers(len(known), size=(STUDIES, number))])
        shown = _exclude(effect, low, high)
        bootstrapped = []
        for _ in range(BOOTSTRAPS):
            pool = known[rng.integers(len(known), size=len(known))]
            drawn = pool[rng.integers(len(pool), size=(BOOTSTRAP_STUDIES, number))]
            bootstrapped.append(float(_exclude(effect, *_find_intervals(effect, drawn)).mean()))
        ends = np.quantile(bootstrapped, [TAIL, 1.0 - TAIL])
        medians = float(np.median(low)), float(np.median(high))
        yield Power(number, float(shown.mean()), float(ends[0]), float(ends[1]), *medians)


def _exclude(effect: Effect, low: FloatArray, high: FloatArray) -> FloatArray:
    return np.asarray((low > effect.reference) | (high < effect.reference))


def _find_intervals(effect: Effect, drawn: Any) -> tuple[FloatArray, FloatArray]:
    """Return both ends of the 95 % interval in studies of drawn participants [s, n], [s] each."""
    special = import_extra("scipy.special", "scipy")
    values = effect.values[drawn]
    count = drawn.shape[1]
    if effect.trials is not None:
        trials = effect.trials[drawn]
        correct, total = np.round((values * trials).sum(axis=1)), trials.sum(axis=1)
        low = np.where(correct > 0, special.betaincinv(np.maximum(correct, 1), total - correct + 1, TAIL), 0.0)
        wrong = total - correct
        high = np.where(wrong > 0, special.betaincinv(correct + 1, np.maximum(wrong, 1), 1.0 - TAIL), 1.0)
        return low, high
    mean, half = values.mean(axis=1), special.stdtrit(count - 1, 1.0 - TAIL) * values.std(axis=1, ddof=1) / count**0.5
    return mean - half, mean + half
