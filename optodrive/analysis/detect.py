"""Is there anything to explain, and where? Candidates by score, and an omnibus over bins, both against the noise model.

Every candidate is a column beside the base fit, at a finite size; its likelihood ratio follows from one matrix of all
columns. The omnibus asks whether whitened residuals agree with zero in bins of group × signal × time after an edge.
The level of the best of all candidates comes from draws of the same matrix (bounded numbers and time constants that
vanish with their effect have no textbook distribution).
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.stats import chi2 as chi_squared

from optodrive.analysis.causes import Hypothesis
from optodrive.analysis.dataset import Dataset
from optodrive.analysis.fit import Fit, Jitter, Problem, jitter, slopes
from optodrive.analysis.noise import whiten
from optodrive.analysis.normal import normal, projected, solve
from optodrive.analysis.predict import BASE, Point, predict
from optodrive.flow import FloatArray, IntArray

AFTER_S = np.geomspace(5e-4, 1.0, 9)
"""Edges of the omnibus' bins: time after an edge of the light."""
SPAN = 4
"""Bins over a whole run, for what is slower."""
DRAWS = 4000
RIDGE = 1e-4


@dataclass(frozen=True)
class Score:
    """One start of a hypothesis beside the base fit: likelihood ratio, its degrees, amplitudes of its columns.

    seen: likelihood ratio that its start's size would give; own: share of its column that nothing else imitates
    """

    hypothesis: Hypothesis
    start: dict[str, float]
    ratio: float
    amplitude: tuple[float, ...]
    columns: tuple[int, ...]
    seen: float
    own: float


@dataclass(frozen=True, eq=False)
class Detection:
    """scores: the best start of every hypothesis, strongest first; p values of the best score and of the omnibus.

    omnibus, bins: its χ² and degrees
    """

    scores: tuple[Score, ...]
    p_score: float
    omnibus: float
    bins: int
    p_omnibus: float


def detect(problem: Problem, base: Fit, found: list[Hypothesis], seed: int) -> Detection:
    """Score every hypothesis beside a fit (nominal, or with terms already in it)."""
    data = problem.data
    shared = jitter(data, base.point, problem.epsilon, base.prediction)
    known = slopes(problem, base.point, base.free, base.prediction)
    trials = [(item, start) for item in found for start in _tried(item)]
    terms = [{**base.point.terms, item.key: start} for item, start in trials]
    extra = [predict(data, Point(base.point.base, own), problem.epsilon) - base.prediction for own in terms]
    candidates = np.stack(extra, axis=1) if extra else np.zeros((len(data.value), 0))
    scale = np.maximum(np.abs(candidates).max(axis=0, initial=0.0), 1e-30)
    residual = (data.value - base.prediction)[:, None]
    columns = np.column_stack([known, candidates / scale, residual])
    total = normal(data, columns, problem.noise, shared.power, shared.timing).total()
    width = known.shape[1]
    total[range(len(BASE)), range(len(BASE))] += 1.0 / np.square(problem.prior.sigma)
    left = projected(total, list(range(width)), list(range(width, len(total))))
    own = np.diag(left) / np.maximum(np.diag(total)[width:], 1e-300)
    omnibus, degrees = binned(problem, np.column_stack([known, residual]), shared)
    scores, p_score = _scores(trials, left, scale, own, seed)
    p_omnibus = float(chi_squared.sf(omnibus, degrees)) if degrees else 1.0
    return Detection(tuple(scores), p_score, omnibus, degrees, p_omnibus)


def _tried(item: Hypothesis) -> tuple[dict[str, float], ...]:
    return item.starts[:1] if item.every else item.starts


def _scores(
    trials: list[tuple[Hypothesis, dict[str, float]]],
    left: FloatArray,
    scale: FloatArray,
    own: FloatArray,
    seed: int,
) -> tuple[list[Score], float]:
    sets: list[tuple[Hypothesis, dict[str, float], tuple[int, ...]]] = []
    joint: dict[str, list[int]] = {}
    for column, (item, start) in enumerate(trials):
        if item.linear and item.degrees > 1:
            joint.setdefault(item.label, []).append(column)
            if len(joint[item.label]) == len(item.starts):
                sets.append((item, item.starts[0], tuple(joint[item.label])))
        else:
            sets.append((item, start, (column,)))
    if not sets:
        return [], 1.0
    gram, right = left[:-1, :-1], left[:-1, -1]
    best: dict[str, Score] = {}
    for item, start, places in sets:
        ratio, amplitude = _ratio(gram, right, list(places), item.linear)
        last = places[-1]
        seen = float(gram[last, last] * scale[last] ** 2)
        amplitudes = tuple((amplitude / scale[list(places)]).tolist())
        score = Score(item, start, ratio, amplitudes, places, seen, float(own[last]))
        if item.label not in best or ratio > best[item.label].ratio:
            best[item.label] = score
    observed = max(_surprise(score.ratio, len(score.columns)) for score in best.values())
    generator = np.random.default_rng(seed)
    values, vectors = np.linalg.eigh(gram)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    draws = root @ generator.standard_normal((len(gram), DRAWS))
    least = np.zeros(DRAWS)
    for item, _, places in sets:
        rows = list(places)
        solved = solve(gram[np.ix_(rows, rows)], draws[rows])
        ratio_drawn = (draws[rows] * solved).sum(axis=0)
        if not item.linear:
            ratio_drawn = np.where(solved[0] > 0.0, ratio_drawn, 0.0)
        least = np.maximum(least, -chi_squared.logsf(ratio_drawn, len(rows)))
    level = float(np.quantile(least, 0.99))
    # Beyond the draws, the best of so many looks as if it were the best of e^(level) × 1 % independent ones.
    drawn = float((least >= observed).mean())
    p = (
        max(drawn, 1.0 / DRAWS)
        if observed < level
        else min(drawn if drawn > 0 else 1.0, 0.01 * np.exp(level - observed))
    )
    return sorted(best.values(), key=lambda score: -score.ratio), float(p)


def _surprise(ratio: float, degrees: int) -> float:
    return float(-chi_squared.logsf(ratio, degrees))


def _ratio(gram: FloatArray, right: FloatArray, places: list[int], either_sign: bool) -> tuple[float, FloatArray]:
    inner = gram[np.ix_(places, places)]
    amplitude = solve(inner, right[places])
    if not either_sign and amplitude[0] <= 0.0:
        return 0.0, np.zeros(len(places))
    return float(right[places] @ amplitude), amplitude


def binned(problem: Problem, columns: FloatArray, shared: Jitter) -> tuple[float, int]:
    """χ² of the last of columns [m, k] in the omnibus' bins beside the others, and its degrees of freedom."""
    data, noise, kinds = problem.data, problem.noise, problem.data.kinds()
    labels, width = bins(data), columns.shape[1]
    count = int(labels.max()) + 1
    total = np.zeros((width + count, width + count))
    if width > len(BASE):
        total[range(len(BASE)), range(len(BASE))] = 1.0 / np.square(problem.prior.sigma)
    by_run: dict[int, list[int]] = {}
    for place, block in enumerate(data.blocks):
        by_run.setdefault(block.run, []).append(place)
    for places in by_run.values():
        own = _binned_rows(np.concatenate([labels[data.blocks[place].part] for place in places]))
        size = 2 + len(kinds)
        gram = np.zeros((width + len(own) + size, width + len(own) + size))
        for place in places:
            block = data.blocks[place]
            part, kind = block.part, kinds.index(block.kind)
            local = _binned_rows(labels[part])
            indicators = (labels[part][:, None] == local).astype(np.float64)
            jitters = np.column_stack(
                [
                    noise.power * shared.power[part],
                    noise.timing_s * shared.timing[part],
                    np.full(part.stop - part.start, noise.baseline[block.kind]),
                ]
            )
            whitened, _ = whiten(block.t_s, np.hstack([columns[part], indicators, jitters]), noise.coloured[block.kind])
            where = np.concatenate(
                [
                    np.arange(width),
                    width + np.searchsorted(own, local),
                    width + len(own) + np.array([0, 1, 2 + kind]),
                ]
            )
            gram[np.ix_(where, where)] += whitened.T @ whitened
        kept = width + len(own)
        inner = gram[kept:, kept:] + np.eye(size)
        reduced = gram[:kept, :kept] - gram[:kept, kept:] @ np.linalg.solve(inner, gram[kept:, :kept])
        where = np.concatenate([np.arange(width), width + own])
        total[np.ix_(where, where)] += reduced
    out, last = list(range(width - 1)), width - 1
    left = projected(total, out, [*range(width, width + count), last])
    among, right = left[:-1, :-1], left[:-1, -1]
    spread = np.sqrt(np.diag(among))
    seen = spread > 1e-9 * spread.max(initial=0.0)
    alike = (among / spread / spread[:, None])[np.ix_(seen, seen)] + RIDGE * np.eye(int(seen.sum()))
    parts = (right / spread)[seen]
    return float(parts @ cho_solve(cho_factor(alike), parts)), int(seen.sum())


def by_group(problem: Problem, residual: FloatArray, shared: Jitter) -> FloatArray:
    """χ² of a residual in each group's bins, and its degrees: [groups, 2]."""
    data = problem.data
    out = []
    for runs in data.groups().values():
        own = data.only(runs)
        part = np.concatenate([np.arange(b.part.start, b.part.stop) for b in data.blocks if b.run in runs])
        here = Jitter(shared.power[part], shared.timing[part])
        out.append(binned(replace(problem, data=own), residual[part][:, None], here))
    return np.array(out, dtype=np.float64)


def _binned_rows(labels: IntArray) -> IntArray:
    return np.asarray(np.unique(labels[labels >= 0]))


def bins(data: Dataset) -> IntArray:
    """[m] the omnibus' bin of each sample, −1 for none: group × signal × pixel × (log time after an edge, time)."""
    names: dict[tuple[object, ...], int] = {}
    label = np.full(len(data.value), -1, dtype=np.int64)
    for block in data.blocks:
        run = data.runs[block.run]
        edges_s, rising = _edges(run.pulses, run.commands if block.kind >= 3 else None)
        row = np.searchsorted(edges_s, block.t_s, side="right") - 1
        after_s = block.t_s - edges_s[np.maximum(row, 0)]
        slot = np.searchsorted(AFTER_S, after_s)
        long = len(run.pulses) > 2
        span_s = max(float(block.t_s[-1] - block.t_s[0]), 1e-9)
        piece = ((block.t_s - block.t_s[0]) / span_s * SPAN).astype(int).clip(0, SPAN - 1) if long else 0 * slot
        order = np.where(row < 0, -1, np.where(rising[np.maximum(row, 0)], 0, 1) + 2 * (0 if long else 1) * (row // 2))
        keys = zip(order.tolist(), slot.tolist(), piece.tolist(), strict=True)
        for at, key in enumerate(keys, start=block.part.start):
            whole = (run.group, block.kind, block.pixel, *key)
            label[at] = names.setdefault(whole, len(names))
    return label


def _edges(pulses: FloatArray, commands: FloatArray | None) -> tuple[FloatArray, np.ndarray]:
    if commands is not None:
        return commands[:, 0], np.arange(len(commands)) % 2 == 0
    edges_s = np.concatenate([pulses[:, 0], pulses[:, 0] + pulses[:, 1]])
    order = np.argsort(edges_s, kind="stable")
    rising = np.concatenate([np.ones(len(pulses), dtype=bool), np.zeros(len(pulses), dtype=bool)])
    if not len(edges_s):
        return np.zeros(1), np.ones(1, dtype=bool)
    return edges_s[order], rising[order]
