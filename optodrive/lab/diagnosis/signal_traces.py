"""Signals of a recording beside both models, thinned for reports."""

import numpy as np

from optodrive.core.types.discrepancy import ExampleTrace, ResidualTrace
from optodrive.lab.diagnosis.dataset import SIGNALS, Block, Dataset
from optodrive.lab.diagnosis.fitting import FitProblem
from optodrive.lab.diagnosis.prediction import ParameterPoint, predict

TRACE_POINTS = 300


class ModelComparison:
    """Residuals of the nominal and the extended model on a dataset, in units of the white noise of each signal."""

    def __init__(self, data: Dataset, problem: FitProblem, nominal: ParameterPoint, extended: ParameterPoint) -> None:
        self._data = data
        self._sigma = {kind: problem.noise.coloured[kind].white for kind in data.kinds}
        self._nominal = data.value - predict(data, nominal, problem.epsilon)
        self._extended = data.value - predict(data, extended, problem.epsilon)

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
