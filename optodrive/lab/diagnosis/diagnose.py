"""A recording to its answer: pixels and mirrors each for themselves, joined; nothing here knows files or words."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import exp
from time import perf_counter

import numpy as np
from scipy.stats import chi2 as chi_squared
from scipy.stats import t as student

from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.discrepancy import CandidateCause, Course, Discrepancy, Estimate, Gain, NextExperiment
from optodrive.core.types.measurements import Measurement
from optodrive.lab.diagnosis.dataset import MIRROR_KINDS, SIGNALS, Dataset, dataset
from optodrive.lab.diagnosis.detection import Score, sureness
from optodrive.lab.diagnosis.discrepancy_basis import covariance
from optodrive.lab.diagnosis.fitting import Fit, Prior, Problem, fit
from optodrive.lab.diagnosis.held_out_gain import heldout, split
from optodrive.lab.diagnosis.hypotheses import Free, Hypothesis, hypotheses
from optodrive.lab.diagnosis.model_selection import (
    ALIKE,
    UNEVEN,
    UNSTEADY,
    Candidate,
    Verdict,
    leading,
    select,
    unrepeated,
)
from optodrive.lab.diagnosis.next_experiment import next_experiment
from optodrive.lab.diagnosis.nominal_fit import BROAD, EPSILON, prepare, with_noise
from optodrive.lab.diagnosis.power_fluctuation import unsteadiness
from optodrive.lab.diagnosis.prediction import BASE, UNITS, predict

VISIBLE = 30.0
"""A likelihood ratio that is found nine times in ten."""
OWN = 1e-4
"""Less of its effect than this left beside the nominal numbers: this data cannot show it."""
COURSE = 300

Tick = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class _Half:
    """Pixels or mirrors: everything found about them. covariance: of the final numbers, other forms allowed."""

    data: Dataset
    held: Dataset
    problem: Problem
    base: Fit
    verdict: Verdict
    final: Fit
    covariance: FloatArray
    gain: Gain | None
    candidates: tuple[CandidateCause, ...]
    ask: NextExperiment | None


def diagnose(
    measurement: Measurement,
    seed: int = 0,
    prior: Prior = BROAD,
    epsilon: float = EPSILON,
    tick: Tick = lambda what: None,
) -> Discrepancy:
    """What the recording says; raises InputError where it holds nothing to compare."""
    began_s = perf_counter()
    halves: list[_Half] = []
    for part in dataset(measurement).halves():
        timing_s = max((item.problem.noise.timing_s for item in halves), default=0.0)
        known = hypotheses(part)
        if halves:
            # One clock for all: what the pixels say of it holds, and a late mirror is a mirror that lags.
            known = [item for item in known if item.key != "clock_offset"]
        halves.append(_study(part, known, seed, prior, epsilon, timing_s, _late_s(halves), tick))
    verdict, causes = _joined(halves)
    main = halves[0]
    parameters: dict[str, Estimate] = {}
    terms: dict[str, dict[str, float]] = {}
    for half in halves:
        parameters |= _estimates(half)
        terms |= {key: dict(own) for key, own in half.final.point.terms.items()}
    heats = any(kind < 3 for kind in main.data.kinds())
    base = dict(zip(BASE, np.exp(np.array(main.final.point.base)).tolist(), strict=True)) if heats else {}
    held = tuple(sorted({run.name for half in halves for run in half.held.runs}))
    fitted = tuple(sorted({run.name for half in halves for run in half.data.runs}.difference(held)))
    explained = [half.verdict.explained for half in halves if half.verdict.verdict != "none"]
    return Discrepancy(
        verdict=verdict,
        causes=causes,
        labels=tuple(
            item.label for half in halves if half.verdict.chosen is not None for item in half.verdict.chosen.hypotheses
        ),
        parameters=parameters,
        base=base,
        terms=terms if verdict == "cause" or verdict == "ambiguous" else {},
        gain=next((half.gain for half in halves if half.verdict.chosen is not None), None),
        candidates=tuple(item for half in halves for item in half.candidates),
        next_experiment=next((half.ask for half in halves if half.ask is not None), None),
        fitted=fitted,
        held_out=held,
        courses=tuple(course for half in halves for course in _courses(half)),
        remarks=_remarks(halves),
        explained=min(explained, default=0.0),
        seconds=perf_counter() - began_s,
    )


def _study(
    data: Dataset,
    known: list[Hypothesis],
    seed: int,
    prior: Prior,
    epsilon: float,
    timing_s: float,
    late_s: float,
    tick: Tick,
) -> _Half:
    fitted, held_runs = split(data)
    here, held = data.only(fitted), data.only(held_runs)
    tick("noise and nominal model")
    problem, base = prepare(here, prior, epsilon, timing_s, late_s)
    if unrepeated(problem):
        # A jitter acts along the slopes of the true model: a large cause moves them, and repeats seem to differ.
        lead = leading(problem, base, known, seed, tick)
        if lead is not None:
            other = with_noise(problem, lead.fit, timing_s)
            other = replace(other, noise=replace(other.noise, unsteady=unsteadiness(other, lead.fit)))
            if not unrepeated(other):
                problem, base = other, fit(other, base.point)
    verdict = select(problem, base, known, seed, tick)
    gains: dict[str, float] = {}
    for candidate in verdict.candidates:
        told = heldout(problem, held, base.point, candidate.fit.point, seed)
        if told is not None:
            gains[candidate.label] = told.reduction
    everything = Problem(data, problem.noise, prior, epsilon)
    tick("all runs together")
    chosen = verdict.chosen
    gain = None if chosen is None else heldout(problem, held, base.point, chosen.fit.point, seed)
    start = base if chosen is None else chosen.fit
    final = fit(everything, start.point, start.free, iterations=6)
    if all(kind in MIRROR_KINDS for kind in data.kinds()):  # jitters may lead astray: each place by its own slopes
        places = (start.point, final.point)
        final = min((fit(everything, place, start.free, iterations=1) for place in places), key=lambda one: one.chi2)
    if verdict.verdict == "none" and held_runs:
        # What only the hottest runs show is seen with them alone: nothing is held out then.
        wider = select(everything, final, known, seed, tick)
        if wider.verdict != "none":
            problem, base, held, verdict = everything, final, data.only([]), wider
            if wider.chosen is not None:
                final = wider.chosen.fit
    ask = _asked(problem, verdict, tick)
    named = () if verdict.chosen is None else verdict.chosen.hypotheses
    unsure = covariance(everything, final, named, known)
    return _Half(data, held, problem, base, verdict, final, unsure, gain, _candidates(verdict, gains), ask)


def _late_s(halves: list[_Half]) -> float:
    """By how much all clocks are late, as far as is known."""
    for half in halves:
        clock = half.final.point.terms.get("clock_offset")
        if "clock_offset" in half.verdict.causes and clock is not None and clock["mirrors"] != 0.0:
            return clock["mirrors"]
    return 0.0


def _joined(halves: list[_Half]) -> tuple[str, tuple[str, ...]]:
    """The verdict on all: as weak as its weakest part; a part without anything to explain does not weaken it."""
    verdicts = [half.verdict for half in halves if half.verdict.verdict != "none"]
    if not verdicts:
        return "none", ()
    causes = tuple(dict.fromkeys(cause for item in verdicts for cause in item.causes))
    for word in ("unexplained", "ambiguous"):
        if any(item.verdict == word for item in verdicts):
            return word, causes if word == "ambiguous" else ()
    return "cause", causes


def _estimates(half: _Half) -> dict[str, Estimate]:
    final = half.final
    sigma = np.sqrt(np.maximum(np.diag(half.covariance), 0.0))
    out: dict[str, Estimate] = {}
    reach = float(student.ppf(0.975, sureness(half.data)))
    if any(kind < 3 for kind in half.data.kinds()):
        for row, name in enumerate(BASE):
            log_value, width = final.point.base[row], reach * float(sigma[row])
            out[name] = Estimate(exp(log_value), UNITS[name], exp(log_value - width), exp(log_value + width))
    for row, free in enumerate(final.free, start=len(BASE)):
        number, width = free.read(final.point.terms), reach * float(min(sigma[row], 50.0))
        ends = (number - width, number + width)
        value, low, high = (exp(min(x, 300.0)) if free.logarithmic else x for x in (number, *ends))
        low, high = max(low, free.parameter.low), min(high, free.parameter.high)
        for name in free.names:
            out[f"{free.key}.{name}"] = Estimate(value, free.parameter.unit, low, high)
    return out


def _candidates(verdict: Verdict, gains: dict[str, float]) -> tuple[CandidateCause, ...]:
    chosen = verdict.chosen
    tests = max(len(verdict.first.scores), 1)
    out = []
    for score in verdict.first.scores:
        item = score.hypothesis
        if chosen is not None and item.label in {part.label for part in chosen.hypotheses}:
            word = "named" if verdict.verdict == "cause" else "cannot be told apart"
        elif item.key in verdict.causes:
            word = "cannot be told apart" if verdict.verdict == "ambiguous" else "another form of a named cause"
        elif score.own < OWN:
            word = "this data cannot show it"
        else:
            word = "nothing of it seen" if score.ratio < VISIBLE else "ruled out"
        p_value = min(1.0, tests * float(chi_squared.sf(score.ratio, len(score.columns))))
        out.append(
            CandidateCause(item.key, item.label, score.ratio, p_value, gains.get(item.label), word, _smallest(score))
        )
    return tuple(out)


def _smallest(score: Score) -> str:
    """The size that would have been seen, in words."""
    if score.hypothesis.key == "mirror_lag":
        return "any lag of the mirrors beyond half a sample"
    free = score.hypothesis.free[-1 if score.hypothesis.linear else 0]
    start = score.start.get(free.names[0], 0.0) or 1.0
    if score.seen <= 0.0 or score.own < OWN:
        return "not visible in this data"
    size = abs(start) * float(np.sqrt(VISIBLE / score.seen))
    if size > 3.0 * free.parameter.high:
        return f"more than {free.parameter.high:g} {free.parameter.unit}"
    return f"{'all' if len(free.names) > 1 else free.names[0]} {size:.2g} {free.parameter.unit}".removesuffix(" 1")


def _asked(problem: Problem, verdict: Verdict, tick: Tick) -> NextExperiment | None:
    """For rivals that this data cannot tell apart: what would."""
    if verdict.verdict != "ambiguous" or not verdict.candidates:
        return None
    best = verdict.candidates[0]
    rivals: list[Candidate] = [
        item
        for item in verdict.candidates[1:]
        if item.bic - best.bic < ALIKE and frozenset(item.causes) != frozenset(best.causes)
    ]
    if not rivals:
        return None
    tick("the next experiment")
    return next_experiment(problem, best.fit, rivals[0].fit, (best.label, rivals[0].label))


def _courses(half: _Half) -> list[Course]:
    """Each group's mean residuals per signal, thinned, in units of the white noise."""
    data = half.data
    nominal = predict(data, half.base.point, half.problem.epsilon)
    extended = predict(data, half.final.point, half.problem.epsilon)
    seen: set[tuple[str, int]] = set()
    out = []
    for block in data.blocks:
        group = data.runs[block.run].group
        if (group, block.kind) in seen:
            continue
        seen.add((group, block.kind))
        thin = max(1, len(block.t_s) // COURSE)
        edges = np.arange(0, len(block.t_s), thin)
        count = np.diff(np.append(edges, len(block.t_s)))
        parts = [np.add.reduceat(values[block.part], edges) / count for values in (data.value, nominal, extended)]
        t_s = np.add.reduceat(block.t_s, edges) / count
        scale = half.problem.noise.coloured[block.kind].white
        before, after = ((parts[0] - part) / scale for part in parts[1:])
        out.append(Course(group, SIGNALS[block.kind], scale, t_s, parts[0], before, after))
    return out


def _remarks(halves: list[_Half]) -> tuple[str, ...]:
    out = []
    for half in halves:
        if half.problem.noise.uneven > UNEVEN:
            out.append(
                "Runs that should repeat one experiment differ by far more than noise and jitter: something "
                "changes from run to run."
            )
        if half.problem.noise.unsteady > UNSTEADY:
            out.append("Repeats differ more while lit: the power is unsteady within pulses.")
        if not half.problem.noise.measured:
            out.append("No run repeats another: the noise is a guess, so nothing is named for certain.")
        if half.verdict.chosen is not None and half.verdict.rest is not None:
            rest = half.verdict.rest
            if half.verdict.verdict == "cause" and rest.p_omnibus < 1e-3:
                causes = " and ".join(half.verdict.causes)
                out.append(
                    f"{causes}: {1 - half.verdict.explained:.1%} of what was wrong stays, for the cause acts in a form "
                    "a little other than the term's."
                )
        out += _at_an_end(half.final)
    return tuple(dict.fromkeys(out))


def _at_an_end(final: Fit) -> list[str]:
    out = []
    for free in final.free:
        value = final.point.terms[free.key][free.names[0]]
        if _shape(free):
            continue
        if value >= 0.999 * free.parameter.high or (free.parameter.low > 0 and value <= 1.001 * free.parameter.low):
            out.append(f"{free.label} came out at the end of its plausible range, {value:g} {free.parameter.unit}.")
    return out


def _shape(free: Free) -> bool:
    return free.names[0] in ("spread", "order", "delay_share", "damping", "slew", "delay")
