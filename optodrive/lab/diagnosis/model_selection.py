"""Which cause: refitted candidates ranked, a verdict, a second cause where one is not enough, and what stays alike."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from optodrive.lab.diagnosis.detection import Detection, Score, detect
from optodrive.lab.diagnosis.discrepancy_basis import bent
from optodrive.lab.diagnosis.fitting import Fit, Problem, fit, jitter
from optodrive.lab.diagnosis.hypotheses import Free, Hypothesis
from optodrive.lab.diagnosis.normal_equations import normal
from optodrive.lab.diagnosis.prediction import Point, predict

ALPHA = 0.001
"""Level of the whole family. False alarms are to stay below 1 %, and the noise model is itself an estimate."""
UNEVEN = 6.0
"""Repeats that differ by more than this do not repeat one experiment."""
UNSTEADY = 25.0
"""Likewise, as if the power changed within pulses."""
HOPELESS = 300.0
"""A fit that does not promise to come within so much χ² of the best one is given up."""
MOST = 9
"""So many of the strongest hypotheses are refitted."""
ALIKE = 10.0
"""Rivals whose BIC is within this of the best one's cannot be told apart: odds of less than about 150.

No more, or a rival that only imitates the best one with a number more, which costs ln samples, would stay for ever.
"""
SAME = 9.0
"""Predictions that differ by less χ² than this are one prediction."""
EXPLAINED, MAINLY = 0.9, 0.5
"""A cause is named for so much of the excess; for less, if other forms of it take the rest."""
FORM = 0.985
"""A cause in another form than its term's leaves a rest: it is still named if so much of the excess is explained."""
NEAREST, AGAIN = 6, 6
"""So many starts are tried of a hypothesis with many, each fitted again so often at most."""
PAIRS, BEGIN = 4, 2
"""So many second causes are refitted beside each of so many best first ones."""

Tick = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class Candidate:
    """One or two hypotheses, refitted. bic: χ² and the price of the free numbers."""

    hypotheses: tuple[Hypothesis, ...]
    fit: Fit
    bic: float

    @property
    def causes(self) -> tuple[str, ...]:
        """Keys."""
        return tuple(item.key for item in self.hypotheses)

    @property
    def label(self) -> str:
        """In words."""
        return " and ".join(item.label for item in self.hypotheses)


@dataclass(frozen=True, eq=False)
class Verdict:
    """verdict, causes: as in the answer; chosen: the model to go on with; candidates: best first.

    first, rest: detection beside the nominal fit, and beside the chosen model; explained: share of the excess
    """

    verdict: str
    causes: tuple[str, ...]
    chosen: Candidate | None
    candidates: tuple[Candidate, ...]
    first: Detection
    rest: Detection | None
    explained: float


def alarmed(found: Detection) -> bool:
    """Whether the family rejects what was fitted: the better of two tests, at half the level each."""
    return min(found.p_score, found.p_omnibus) < 0.5 * ALPHA


def unrepeated(problem: Problem) -> bool:
    """Whether repeats differ by more than noise and jitters."""
    return problem.noise.uneven > UNEVEN or problem.noise.unsteady > UNSTEADY


def leading(problem: Problem, base: Fit, known: list[Hypothesis], seed: int, tick: Tick) -> Candidate | None:
    """The best of the strongest, refitted; None where none is worth it."""
    return next(iter(_refitted(problem, base, (), detect(problem, base, known, seed).scores, tick)), None)


def select(problem: Problem, base: Fit, known: list[Hypothesis], seed: int, tick: Tick) -> Verdict:
    """The verdict on one recording."""
    tick("looking for anything to explain")
    first = detect(problem, base, known, seed)
    if unrepeated(problem):
        return Verdict("unexplained", (), None, (), first, None, 0.0)
    if not alarmed(first):
        return Verdict("none", (), None, (), first, None, 0.0)
    singles = _refitted(problem, base, (), first.scores, tick)
    if not singles:
        return Verdict("unexplained", (), None, (), first, None, 0.0)
    best = singles[0]
    tick(f"what {best.label} leaves")
    others = [item for item in known if item.key not in best.causes]
    rest = detect(problem, best.fit, others, seed)
    alone = _explained(rest, base, best)
    if not alarmed(rest) and alone >= EXPLAINED:
        return _named(problem, singles, first, rest, alone)
    shape = bent(problem, best.fit, best.hypotheses, known)
    formed = detect(problem, best.fit, others, seed, shape)
    if not alarmed(formed) and alone >= MAINLY and max(alone, _explained(formed, base, best)) >= EXPLAINED:
        return _named(problem, singles, first, rest, alone)
    price = rest.left - formed.left - shape.shape[1] * np.log(len(problem.data.value))
    found = _pairs(problem, base, known, singles, rest, seed, tick)
    pairs = [item for item in found if _needed(item, singles, price)]
    if pairs:
        both = pairs[0]
        tick(f"what {both.label} leave")
        others = [item for item in known if item.key not in both.causes]
        after = detect(problem, both.fit, others, seed)
        together = _explained(after, base, both)
        # Beside a cause in another form than its term's, a second one patches: it must leave nothing to be believed.
        if not alarmed(after) or (together >= FORM > alone):
            return _named(problem, pairs, first, after, together)
        if together >= EXPLAINED and not alarmed(
            detect(problem, both.fit, others, seed, bent(problem, both.fit, both.hypotheses, known))
        ):
            return _named(problem, pairs, first, after, together)
    # Where only one cause is known at all, no other can be taken for it.
    enough = FORM if len({item.key for item in known}) > 1 else EXPLAINED
    if alone >= EXPLAINED and max(alone, _explained(formed, base, best)) >= enough:
        return _named(problem, singles, first, rest, alone)
    return Verdict("unexplained", (), None, (*pairs, *singles), first, rest, alone)


def _start(point: Point, score: Score) -> Point:
    """Terms as the score found them, at the amplitude it found, within their ranges."""
    item = score.hypothesis
    terms = {**point.terms, item.key: dict(score.start)}
    if item.linear and item.degrees > 1:
        own = dict.fromkeys(score.start, 0.0)
        for free, amplitude, start in zip(item.free, score.amplitude, item.starts, strict=True):
            own[free.names[0]] = amplitude * start[free.names[0]]
        return Point(point.base, {**point.terms, item.key: own})
    free = item.free[0]
    scale = score.amplitude[0] if not free.logarithmic else float(np.clip(score.amplitude[0], 0.2, 5.0))
    value = score.start[free.names[0]] * scale
    return Point(point.base, free.written(terms, float(np.log(value)) if free.logarithmic else value))


def _refitted(
    problem: Problem, base: Fit, before: tuple[Hypothesis, ...], scores: Sequence[Score], tick: Tick
) -> list[Candidate]:
    """The strongest scores as full fits, best first."""
    samples = len(problem.data.value)
    found: list[Candidate] = []
    worth = [score for score in scores[:MOST] if score.ratio > max(6.0, 0.05 * scores[0].ratio)]
    hopeless = np.inf
    for score in worth:
        tick(f"fitting {score.hypothesis.label}")
        free = (*base.free, *score.hypothesis.free)
        start = _start(base.point, score)
        if score.hypothesis.every:
            result = _settled(problem, base, score.hypothesis, free)
        else:
            result = fit(problem, start, free, hopeless=hopeless)
        hopeless = min(hopeless, result.chi2 + HOPELESS)
        found.append(Candidate((*before, score.hypothesis), result, result.chi2 + len(free) * np.log(samples)))
    return sorted(found, key=lambda item: item.bic)


def _settled(problem: Problem, base: Fit, item: Hypothesis, free: Sequence[Free]) -> Fit:
    """The best place that fits from the nearest starts come to, each begun again where it ended until it stays.

    Jitters act along the slopes of where a fit began: a place is judged by a fit that begins there.
    """
    found: list[Fit] = []
    for point in _nearest(problem, base, item):
        for _ in range(AGAIN):
            came = fit(problem, point, free)
            there = fit(problem, came.point, free, iterations=1)
            found.append(there)
            if abs(there.chi2 - came.chi2) < 1.0:
                break
            point = there.point
    return min(found, key=lambda one: one.chi2)


def _nearest(problem: Problem, base: Fit, item: Hypothesis) -> list[Point]:
    """The starts that come nearest to the data as it is."""
    still = np.zeros(len(problem.data.value))

    def cost(point: Point) -> float:
        residual = problem.data.value - predict(problem.data, point, problem.epsilon)
        return float(normal(problem.data, residual[:, None], problem.noise, still, still).total()[0, 0])

    points = (Point(base.point.base, {**base.point.terms, item.key: own}) for own in item.starts)
    return sorted(points, key=cost)[:NEAREST]


def _excess(found: Detection) -> float:
    return max(0.0, found.omnibus - found.bins)


def _explained(rest: Detection, base: Fit, best: Candidate) -> float:
    """Share of the excess that a candidate took: of what it gained, and what is clearly left."""
    gained = base.chi2 - best.fit.chi2
    score = rest.scores[0].ratio if rest.scores else 0.0
    left = max(0.0, _excess(rest) - 2.5 * np.sqrt(2.0 * rest.bins), score - 12.0)
    return float(gained / max(gained + left, 1e-9))


def _pairs(
    problem: Problem,
    base: Fit,
    known: list[Hypothesis],
    singles: list[Candidate],
    rest: Detection,
    seed: int,
    tick: Tick,
) -> list[Candidate]:
    """Best pairs: the second beside each of the best few first ones."""
    found: list[Candidate] = []
    for row, first in enumerate(singles[:BEGIN]):
        others = [item for item in known if item.key not in first.causes]
        beside = rest if row == 0 else detect(problem, first.fit, others, seed)
        found += _refitted(problem, first.fit, first.hypotheses, beside.scores[:PAIRS], tick)
    unique: dict[frozenset[str], Candidate] = {}
    for item in sorted(found, key=lambda candidate: candidate.bic):
        unique.setdefault(frozenset(part.label for part in item.hypotheses), item)
    return list(unique.values())


def _needed(both: Candidate, singles: list[Candidate], bending: float) -> bool:
    """Whether the pair beats every single one by more than chance among so many pairs, and by more than its price.

    bending: what the best single cause would gain by another form, its price paid; a second cause must do better.
    """
    return singles[0].bic - both.bic > ALIKE + max(0.0, bending)


def _imitates(problem: Problem, rival: Candidate, best: Candidate) -> bool:
    """Whether a rival of more numbers, one of them at its end, says what the best one says."""
    terms = rival.fit.point.terms
    if len(rival.fit.free) <= len(best.fit.free) or not any(
        not item.parameter.low < terms[item.key][item.names[0]] < item.parameter.high for item in rival.fit.free
    ):
        return False
    shared = jitter(problem.data, best.fit.point, problem.epsilon, best.fit.prediction)
    apart = (rival.fit.prediction - best.fit.prediction)[:, None]
    return float(normal(problem.data, apart, problem.noise, shared.power, shared.timing).total()[0, 0]) < SAME


def _named(problem: Problem, ranked: list[Candidate], first: Detection, rest: Detection, explained: float) -> Verdict:
    best = ranked[0]
    rivals = [item for item in ranked if item.bic - best.bic < ALIKE and not _imitates(problem, item, best)]
    keys = list(dict.fromkeys(key for item in rivals for key in item.causes))
    if len({frozenset(item.causes) for item in rivals}) > 1:
        return Verdict("ambiguous", tuple(keys), best, tuple(ranked), first, rest, explained)
    if not problem.noise.measured:
        return Verdict("ambiguous", tuple(best.causes), best, tuple(ranked), first, rest, explained)
    return Verdict("cause", best.causes, best, tuple(ranked), first, rest, explained)
