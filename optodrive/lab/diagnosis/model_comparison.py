"""Recorded signals and pushes beside both models: traces for reports, and the error of planned heights.

The drive of a recorded push is the one that a plan would choose for the height that the model predicts for it. The
measured height is then what a finger would feel in its place.
"""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.discrepancy import ExampleTrace, HeightError, ResidualTrace
from optodrive.lab.diagnosis.dataset import SIGNALS, Block, Dataset
from optodrive.lab.diagnosis.fitting import FitProblem, compute_jitter_sensitivity
from optodrive.lab.diagnosis.prediction import ParameterPoint, predict

TRACE_POINTS = 300
DISPLACEMENT = SIGNALS.index("displacement_m")
NEAR_PEAK = 0.9
"""Samples of a push above this share of its predicted height give the measured one."""
MAX_NOISE = 0.1
"""Pushes whose measured height is uncertain by more than this share of the predicted one are not judged."""


class ModelComparison:
    """Residuals of the nominal and the extended model on a dataset, in units of the white noise of each signal."""

    def __init__(self, data: Dataset, problem: FitProblem, nominal: ParameterPoint, extended: ParameterPoint) -> None:
        self._data = data
        self._sigma = {kind: problem.noise.coloured[kind].white for kind in data.kinds}
        self._nominal = data.value - predict(data, nominal)
        self._extended = data.value - predict(data, extended)

    def trace_groups(self) -> tuple[ResidualTrace, ...]:
        """Return the signals of the first run of each group."""
        first: dict[tuple[str, int], Block] = {}
        for block in self._data.blocks:
            first.setdefault((self._data.runs[block.run].group, block.kind), block)
        return tuple(self._trace(block) for block in first.values())

    def trace_examples(self) -> tuple[ExampleTrace, ...]:
        """Return the worst and the typical run of each signal. Return only the worst of a single run."""
        examples = []
        for kind in self._data.kinds:
            blocks = sorted(
                (block for block in self._data.blocks if block.kind == kind), key=self._compute_rms, reverse=True
            )
            examples.append(ExampleTrace("worst", self._trace(blocks[0])))
            if len(blocks) > 1:
                examples.append(ExampleTrace("typical", self._trace(blocks[len(blocks) // 2])))
        return tuple(examples)

    def _compute_rms(self, block: Block) -> float:
        """Return the rms residual of the nominal model, in units of sigma."""
        return float(np.sqrt(np.mean(self._nominal[block.part] ** 2))) / self._sigma[block.kind]

    def _trace(self, block: Block) -> ResidualTrace:
        stride = max(1, len(block.t_s) // TRACE_POINTS)
        edges = np.arange(0, len(block.t_s), stride)
        count = np.diff(np.append(edges, len(block.t_s)))
        values = (block.t_s, *(x[block.part] for x in (self._data.value, self._nominal, self._extended)))
        t_s, measured, nominal, extended = (np.add.reduceat(item, edges) / count for item in values)
        run, sigma = self._data.runs[block.run], self._sigma[block.kind]
        return ResidualTrace(
            run.name,
            run.group,
            SIGNALS[block.kind],
            sigma,
            t_s,
            measured,
            nominal / sigma,
            extended / sigma,
            self._compute_rms(block),
        )


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
