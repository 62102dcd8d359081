"""Which cause: refitted candidates ranked, a verdict, a second cause where one is not enough, and what stays alike."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from optodrive.analysis.causes import Hypothesis
from optodrive.analysis.detect import Detection, Score, detect
from optodrive.analysis.fit import Fit, Problem, fit
from optodrive.analysis.normal import normal
from optodrive.analysis.predict import Point, predict

ALPHA = 0.001
"""Level of the whole family. False alarms are to stay below 1 %, and the noise model is itself an estimate."""
UNEVEN = 6.0
"""Repeats that differ by more than this do not repeat one experiment."""
HOPELESS = 300.0
"""A fit that does not promise to come within so much χ² of the best one is given up."""
MOST = 9
"""So many of the strongest hypotheses are refitted."""
ALIKE = 12.0
"""Rivals whose χ² is within this of the best one's, degrees of freedom counted as by BIC, cannot be told apart."""
EXPLAINED = 0.9
FORM = 0.985
"""A cause in another form than its term's leaves a rest: it is still named if so much of the excess is explained."""
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


def select(problem: Problem, base: Fit, known: list[Hypothesis], seed: int, tick: Tick) -> Verdict:
    """The verdict on one recording."""
    tick("looking for anything to explain")
    first = detect(problem, base, known, seed)
    if problem.noise.uneven > UNEVEN:
        return Verdict("unexplained", (), None, (), first, None, 0.0)
    if not alarmed(first):
        return Verdict("none", (), None, (), first, None, 0.0)
    singles = _refitted(problem, base, (), first.scores, tick)
    if not singles:
        return Verdict("unexplained", (), None, (), first, None, 0.0)
    best = singles[0]
    tick(f"what {best.label} leaves")
    rest = detect(problem, best.fit, [item for item in known if item.key not in best.causes], seed)
    alone = _explained(rest, base, best)
    if not alarmed(rest) and alone >= EXPLAINED:
        return _named(problem, singles, first, rest, alone)
    pairs = [item for item in _pairs(problem, base, known, singles, rest, seed, tick) if _needed(item, singles)]
    if pairs:
        tick(f"what {pairs[0].label} leave")
        others = [item for item in known if item.key not in pairs[0].causes]
        after = detect(problem, pairs[0].fit, others, seed)
        together = _explained(after, base, pairs[0])
        # Beside a cause in another form than its term's, a second one patches: it must leave nothing to be believed.
        if not alarmed(after) or (together >= FORM > alone):
            return _named(problem, pairs, first, after, together)
    # Where only one cause is known at all, no other can be taken for it.
    if alone >= (FORM if len({item.key for item in known}) > 1 else EXPLAINED):
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
            # Jitters act along the slopes of where a fit began: only the second one has them right.
            start = fit(problem, _nearest(problem, base, score.hypothesis), free).point
        result = fit(problem, start, free, hopeless=hopeless)
        hopeless = min(hopeless, result.chi2 + HOPELESS)
        found.append(Candidate((*before, score.hypothesis), result, result.chi2 + len(free) * np.log(samples)))
    return sorted(found, key=lambda item: item.bic)


def _nearest(problem: Problem, base: Fit, item: Hypothesis) -> Point:
    """The start that comes nearest to the data as it is."""
    still = np.zeros(len(problem.data.value))

    def cost(point: Point) -> float:
        residual = problem.data.value - predict(problem.data, point, problem.epsilon)
        return float(normal(problem.data, residual[:, None], problem.noise, still, still).total()[0, 0])

    return min((Point(base.point.base, {**base.point.terms, item.key: own}) for own in item.starts), key=cost)


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


def _needed(both: Candidate, singles: list[Candidate]) -> bool:
    """Whether the pair beats every single one by more than chance among so many pairs, and by more than its price."""
    return singles[0].bic - both.bic > ALIKE


def _named(problem: Problem, ranked: list[Candidate], first: Detection, rest: Detection, explained: float) -> Verdict:
    best = ranked[0]
    rivals = [item for item in ranked if item.bic - best.bic < ALIKE]
    keys = list(dict.fromkeys(key for item in rivals for key in item.causes))
    if len({frozenset(item.causes) for item in rivals}) > 1:
        return Verdict("ambiguous", tuple(keys), best, tuple(ranked), first, rest, explained)
    if not problem.noise.measured:
        return Verdict("ambiguous", tuple(best.causes), best, tuple(ranked), first, rest, explained)
    return Verdict("cause", best.causes, best, tuple(ranked), first, rest, explained)
