"""What an extension gains on runs that it was not fitted to."""

from dataclasses import replace

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.discrepancy import Gain
from optodrive.lab.diagnosis.dataset import SIGNALS, Dataset
from optodrive.lab.diagnosis.fitting import Problem, jitter
from optodrive.lab.diagnosis.omnibus_test import by_group
from optodrive.lab.diagnosis.prediction import Point, predict

DRAWS = 400
VISIBLE = 4.0
"""Less excess than so many σ in held-out runs says nothing of any gain."""


def split(data: Dataset) -> tuple[list[int], list[int]]:
    """Runs to fit, and runs held out: whole groups, of each kind of experiment one in four, the hottest first.

    Kinds: a neighbour lit, mirrors, trains, single pulses. A kind with fewer than three groups is fitted whole.
    """
    kinds: dict[str, list[tuple[float, str]]] = {}
    lonely: dict[bytes, int] = {}
    for name, runs in data.groups().items():
        pulses = data.runs[runs[0]].pulses
        lonely[pulses.tobytes()] = lonely.get(pulses.tobytes(), 0) + 1
        measured = {block.pixel for block in data.blocks if block.run in runs}
        energy_j = float((pulses[:, 1] * pulses[:, 2]).sum())
        kind = "train" if len(pulses) > 2 else "pulse"
        if len(pulses) and not measured.intersection(pulses[:, 3].astype(int).tolist()):
            kind = "neighbour"
        if any(block.kind > 2 for block in data.blocks if block.run in runs):
            kind = "mirrors"
        kinds.setdefault(f"{kind} {sorted(measured)}", []).append((energy_j, name))
    held: list[str] = []
    for members in kinds.values():
        # The same drive early and late shows what ages: neither is spared.
        free = [
            (energy_j, name)
            for energy_j, name in sorted(members, reverse=True)
            if lonely[data.runs[data.groups()[name][0]].pulses.tobytes()] == 1
        ]
        if len(members) >= 3:
            held += [name for _, name in free[::3][: max(1, len(members) // 4)]]
    groups = data.groups()
    out = sorted(run for name in held for run in groups[name])
    return [run for run in range(len(data.runs)) if run not in out], out


def heldout(problem: Problem, data: Dataset, before: Point, after: Point, seed: int) -> Gain | None:
    """Both models on held-out runs; None where there are none, or where they show nothing of what is wrong.

    The reduction is of residuals averaged over repeats in bins of time: what a model misses is far below the noise of
    one sample. Its interval is cut at −1: draws of groups that hardly show the effect give any number.
    """
    if not len(data.value):
        return None
    problem = replace(problem, data=data)
    shared = jitter(data, before, problem.epsilon, predict(data, before, problem.epsilon))
    binned_before = by_group(problem, data.value - predict(data, before, problem.epsilon), shared)
    binned_after = by_group(problem, data.value - predict(data, after, problem.epsilon), shared)
    excess = binned_before[:, 0] - binned_before[:, 1]
    if excess.sum() < VISIBLE * np.sqrt(2.0 * binned_before[:, 1].sum()):
        return None
    floor2 = _floor(problem, after)
    residuals = [data.value - predict(data, point, problem.epsilon) for point in (before, after)]
    kinds = data.kinds()
    sums = np.zeros((len(kinds), 4))
    for block in data.blocks:
        sums[kinds.index(block.kind)] += [
            block.part.stop - block.part.start,
            float((residuals[0][block.part] ** 2).sum()),
            float((residuals[1][block.part] ** 2).sum()),
            float(floor2[block.part].sum()),
        ]
    rmse = np.sqrt(sums[:, 1:] / sums[:, :1])
    generator = np.random.default_rng(seed)
    both = np.stack([binned_before, binned_after])[:, binned_before[:, 1] > 0]
    count = both.shape[1]
    drawn = [max(-1.0, _reduction(both[:, generator.integers(0, count, count)])) for _ in range(DRAWS)]
    low, high = np.quantile(drawn, [0.025, 0.975])
    names = [SIGNALS[kind] for kind in kinds]
    columns = [dict(zip(names, rmse[:, column].tolist(), strict=True)) for column in range(3)]
    return Gain(columns[0], columns[1], columns[2], _reduction(both), float(low), float(high))


def _reduction(both: FloatArray) -> float:
    """From [before and after, groups, 2] χ² and degrees; the floor is χ² = degrees."""
    (before, degrees), (after, _) = both.sum(axis=1)
    rms_before, rms_after = np.sqrt(before / degrees), np.sqrt(max(after, degrees) / degrees)
    return float((rms_before - rms_after) / max(rms_before - 1.0, 1e-9))


def _floor(problem: Problem, point: Point) -> FloatArray:
    """Expected square of a residual of the true model: [m]."""
    data, noise = problem.data, problem.noise
    shared = jitter(data, point, problem.epsilon, predict(data, point, problem.epsilon))
    out = (noise.power * shared.power) ** 2 + (noise.timing_s * shared.timing) ** 2
    for block in data.blocks:
        own = noise.coloured[block.kind]
        out[block.part] += own.white**2 + own.sigma[0] ** 2 + own.sigma[1] ** 2 + noise.baseline[block.kind] ** 2
    return np.asarray(out)
