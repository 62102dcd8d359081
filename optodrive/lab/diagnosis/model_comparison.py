"""Both models on recorded runs: gain on those that were held out, traces for reports, and the error of planned heights.

The drive of a recorded push is the one that a plan would choose for the height that the model predicts for it. The
measured height is then what a finger would feel in its place.
"""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.discrepancy import HeightError, HeldOutGain, ResidualTrace
from optodrive.lab.diagnosis.dataset import SIGNALS, Block, Dataset
from optodrive.lab.diagnosis.fitting import FitProblem, compute_jitter_sensitivity, compute_normal_equations
from optodrive.lab.diagnosis.omnibus_test import compute_omnibus_by_group
from optodrive.lab.diagnosis.prediction import ParameterPoint, predict
from optodrive.lab.inference.claim import HeldOutChange

TRACE_POINTS = 300
DISPLACEMENT = SIGNALS.index("displacement_m")
NEAR_PEAK = 0.9
"""Samples of a push above this share of its predicted height give the measured one."""
MAX_NOISE = 0.1
"""Pushes whose measured height is uncertain by more than this share of the predicted one are not judged."""


def trace_groups(
    problem: FitProblem, data: Dataset, nominal: ParameterPoint, extended: ParameterPoint
) -> tuple[ResidualTrace, ...]:
    """Return the signals of the first run of each group, with the residuals of both models."""
    if not len(data.value):
        return ()
    columns = [data.value, *(data.value - predict(data, point) for point in (nominal, extended))]
    first: dict[tuple[str, int], ResidualTrace] = {}
    for block in data.blocks:
        run, sigma = data.runs[block.run], problem.noise.coloured[block.kind].white
        if (run.group, block.kind) in first:
            continue
        edges = np.arange(0, len(block.t_s), max(1, len(block.t_s) // TRACE_POINTS))
        count = np.diff(np.append(edges, len(block.t_s)))
        means = (np.add.reduceat(item, edges) / count for item in (block.t_s, *(x[block.part] for x in columns)))
        t_s, measured, before, after = means
        rms = float(np.sqrt(np.mean(columns[1][block.part] ** 2))) / sigma
        first[run.group, block.kind] = ResidualTrace(
            run.name, run.group, SIGNALS[block.kind], sigma, t_s, measured, before / sigma, after / sigma, rms
        )
    return tuple(first.values())


@dataclass(frozen=True)
class _Push:
    """One push in one run: measured and predicted heights, m.

    noise_m: standard deviation of the measured one
    """

    measured_m: float
    nominal_m: float
    extended_m: float
    noise_m: float


def compute_height_error(
    problem: FitProblem, data: Dataset, nominal: ParameterPoint, extended: ParameterPoint
) -> HeightError | None:
    """Return the error of planned heights over all pushes. Return None if no measured push is clear of the noise."""
    if not len(data.value):
        return None
    problem = replace(problem, data=data)
    predictions = [predict(data, point) for point in (nominal, extended)]
    power = compute_jitter_sensitivity(data, extended, predictions[1]).power
    repeats: dict[tuple[str, int, int], list[_Push]] = {}
    for block in data.blocks:
        if block.kind == DISPLACEMENT:
            for number, push in _list_pushes(problem, block, predictions, power):
                repeats.setdefault((data.runs[block.run].group, block.pixel, number), []).append(push)
    errors, experiments = [], set()
    for (group, pixel, _), pushes in repeats.items():
        measured_m, nominal_m, extended_m, noise2 = np.mean(
            [(push.measured_m, push.nominal_m, push.extended_m, push.noise_m**2) for push in pushes], axis=0
        ).tolist()
        noise = float(np.sqrt(noise2 / len(pushes))) / extended_m
        if noise <= MAX_NOISE:
            errors.append((measured_m / nominal_m - 1.0, measured_m / extended_m - 1.0, noise))
            experiments.add((group, pixel))
    if not errors:
        return None
    table = np.abs(errors)
    rms, largest = np.sqrt((table**2).mean(axis=0)).tolist(), table.max(axis=0).tolist()
    return HeightError(len(errors), len(experiments), rms[0], largest[0], rms[1], largest[1], rms[2])


def _list_pushes(
    problem: FitProblem, block: Block, predictions: list[FloatArray], power: FloatArray
) -> list[tuple[int, _Push]]:
    """Return the number of each pulse on the block's pixel that lifts it, with the push."""
    pulses = problem.data.runs[block.run].pulses
    starts_s = np.sort(pulses[pulses[:, 3] == block.pixel, 0])
    noise = problem.noise
    coloured = noise.coloured[DISPLACEMENT]
    slow2 = coloured.sigma[0] ** 2 + coloured.sigma[1] ** 2 + noise.baseline_sigma[DISPLACEMENT] ** 2
    out = []
    for number, (start_s, end_s) in enumerate(pairwise([*starts_s, np.inf])):
        rows = block.part.start + np.flatnonzero((block.t_s >= start_s) & (block.t_s < end_s))
        if not len(rows):
            continue
        nominal_m, shape_m = (prediction[rows] for prediction in predictions)
        height_m = float(shape_m.max())
        near = shape_m >= NEAR_PEAK * height_m
        if height_m <= 0.0 or nominal_m.max() <= 0.0 or shape_m.argmax() == 0:  # it still falls from an earlier push
            continue
        near_m = shape_m[near]
        # A fit of the predicted shape, since the largest of many samples is too high by their noise.
        measured_m = height_m * float(near_m @ problem.data.value[rows][near]) / float(near_m @ near_m)
        jitter_m = noise.power_sigma * float(np.abs(power[rows][near]).mean())
        white2 = coloured.compute_mean_variance(block.t_s, len(near_m))
        noise_m = float(np.sqrt(white2 + slow2 + jitter_m**2))
        out.append((number, _Push(measured_m, float(nominal_m.max()), height_m, noise_m)))
    return out


BOOTSTRAP_DRAWS = 400
MIN_EXCESS_SIGMA = 4.0
"""Minimum significance, in σ, of the nominal model's error in held-out runs for a gain to be stated."""


def split_runs(data: Dataset) -> tuple[list[int], list[int]]:
    """Return the runs to fit and the runs to hold out: one in four groups of each kind of experiment, hottest first.

    Kinds are neighbour pulsed, mirrors, trains and single pulses; a kind with fewer than three groups is not held out.
    """
    kinds: dict[str, list[tuple[float, str]]] = {}
    drive_counts: dict[bytes, int] = {}
    for name, runs in data.groups.items():
        pulses = data.runs[runs[0]].pulses
        drive_counts[pulses.tobytes()] = drive_counts.get(pulses.tobytes(), 0) + 1
        measured = {block.pixel for block in data.blocks if block.run in runs}
        energy_j = float((pulses[:, 1] * pulses[:, 2]).sum())
        kind = "train" if len(pulses) > 2 else "pulse"
        if len(pulses) and not measured.intersection(pulses[:, 3].astype(int).tolist()):
            kind = "neighbour"
        if any(block.kind > 2 for block in data.blocks if block.run in runs):
            kind = "mirrors"
        # By kind and pixel, so that no kind of experiment is only held out, and none never.
        kinds.setdefault(f"{kind} {sorted(measured)}", []).append((energy_j, name))
    held_out: list[str] = []
    for members in kinds.values():
        # A drive repeated early and late shows ageing and is never held out.
        eligible = [
            (energy_j, name)
            # The hottest first: a model must extrapolate to what it did not see.
            for energy_j, name in sorted(members, reverse=True)
            if drive_counts[data.runs[data.groups[name][0]].pulses.tobytes()] == 1
        ]
        if len(members) >= 3:
            held_out += [name for _, name in eligible[::3][: max(1, len(members) // 4)]]
    groups = data.groups
    # Whole groups: a repeat in the fit would have shown the held-out one.
    held_out_runs = sorted(run for name in held_out for run in groups[name])
    return [run for run in range(len(data.runs)) if run not in held_out_runs], held_out_runs


def compute_held_out_gain(
    problem: FitProblem, data: Dataset, nominal: ParameterPoint, extended: ParameterPoint, seed: int
) -> HeldOutGain | None:
    """Compare both models on held-out runs. Return None if no held-out run shows an error of the nominal model.

    The reduction is that of residuals averaged over repeats in time bins, because model errors lie far below the noise
    of one sample. Its interval is clipped at −1: bootstrap draws of groups that hardly show the effect give arbitrary
    ratios.
    """
    if not len(data.value):
        return None
    problem = replace(problem, data=data)
    sensitivity = compute_jitter_sensitivity(data, nominal, predict(data, nominal))
    nominal_chi2 = compute_omnibus_by_group(problem, data.value - predict(data, nominal), sensitivity)
    extended_chi2 = compute_omnibus_by_group(problem, data.value - predict(data, extended), sensitivity)
    excess = nominal_chi2[:, 0] - nominal_chi2[:, 1]
    # A share of an error that is not there could be anything.
    if excess.sum() < MIN_EXCESS_SIGMA * np.sqrt(2.0 * nominal_chi2[:, 1].sum()):
        return None
    floor2 = _compute_noise_floor2(problem, extended)
    residuals = [data.value - predict(data, point) for point in (nominal, extended)]
    kinds = data.kinds
    sums = np.zeros((len(kinds), 4))
    for block in data.blocks:
        sums[kinds.index(block.kind)] += [
            block.part.stop - block.part.start,
            float((residuals[0][block.part] ** 2).sum()),
            float((residuals[1][block.part] ** 2).sum()),
            float(floor2[block.part].sum()),
        ]
    rmse = np.sqrt(sums[:, 1:] / sums[:, :1])
    chi2_pairs = np.stack([nominal_chi2, extended_chi2])[:, nominal_chi2[:, 1] > 0]
    names = [SIGNALS[kind] for kind in kinds]
    columns = [dict(zip(names, rmse[:, column].tolist(), strict=True)) for column in range(3)]
    return HeldOutGain(
        columns[0], columns[1], columns[2], _compute_reduction(chi2_pairs), _draw_interval(chi2_pairs, seed)
    )


def compute_held_out_changes(
    problem: FitProblem, data: Dataset, nominal: ParameterPoint, extended: ParameterPoint
) -> tuple[HeldOutChange, ...]:
    """Return the change of χ², jitters marginalised, in every signal of every held-out group.

    With a residual r of the nominal model and a difference d of the predictions, both whitened, it is d·d − 2 r·d, and
    noise gives it a standard deviation of 2 |d|.
    """
    changes = []
    for group, runs in data.groups.items():
        for kind in data.select(runs).kinds:
            part = data.select(runs, (kind,))
            before, after = (predict(part, point) for point in (nominal, extended))
            jitter = compute_jitter_sensitivity(part, extended, after)
            columns = np.column_stack([part.value - before, after - before])
            gram = compute_normal_equations(part, columns, problem.noise, jitter)
            norm2 = float(gram[1, 1])
            floor2 = _compute_noise_floor2(replace(problem, data=part), extended)
            squares = ((part.value - before) ** 2, (part.value - after) ** 2, floor2)
            rms = [float(np.sqrt(np.mean(each))) for each in squares]
            chi2, spread = norm2 - 2.0 * float(gram[0, 1]), 2.0 * norm2**0.5
            changes.append(
                HeldOutChange(group, SIGNALS[kind], chi2, spread, (rms[0], rms[1], rms[2]), len(part.blocks))
            )
    return tuple(changes)


def _draw_interval(chi2_pairs: FloatArray, seed: int) -> tuple[float, float] | None:
    """Return the 95 % interval of the reduction over draws of the groups.

    Return None for one group, which cannot vary.
    """
    count = chi2_pairs.shape[1]
    if count < 2:
        return None
    generator = np.random.default_rng(seed)
    # Groups are drawn, not runs: repeats of one experiment share its error.
    reductions = [
        max(-1.0, _compute_reduction(chi2_pairs[:, generator.integers(0, count, count)]))
        for _ in range(BOOTSTRAP_DRAWS)
    ]
    low, high = np.quantile(reductions, [0.025, 0.975]).tolist()
    return low, high


def _compute_reduction(chi2_pairs: FloatArray) -> float:
    """Return the reduction from [nominal and extended, groups, 2] χ² and degrees. The floor is χ² = degrees."""
    (nominal, degrees), (extended, _) = chi2_pairs.sum(axis=1)
    # Below the noise no model can be better, except by chance.
    rms_nominal, rms_extended = np.sqrt(nominal / degrees), np.sqrt(max(extended, degrees) / degrees)
    return float((rms_nominal - rms_extended) / max(rms_nominal - 1.0, 1e-9))


def _compute_noise_floor2(problem: FitProblem, point: ParameterPoint) -> FloatArray:
    """Return the expected square of each residual of the true model, [m]."""
    data, noise = problem.data, problem.noise
    sensitivity = compute_jitter_sensitivity(data, point, predict(data, point))
    out = (noise.power_sigma * sensitivity.power) ** 2 + (noise.timing_sigma_s * sensitivity.timing) ** 2
    for block in data.blocks:
        coloured = noise.coloured[block.kind]
        out[block.part] += (
            coloured.white**2 + coloured.sigma[0] ** 2 + coloured.sigma[1] ** 2 + noise.baseline_sigma[block.kind] ** 2
        )
    return np.asarray(out)
