"""Test for power that fluctuates within pulses, from repeats.

The power jitter of a run is one value for the whole run. A power that fluctuates within pulses differs between repeats
and resembles slow noise, but it appears with the pulse and decays as the absorber cools.
"""

from dataclasses import replace
from math import ceil

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.lab.diagnosis.dataset import PIXEL_KINDS
from optodrive.lab.diagnosis.fitting import FitProblem, ModelFit, compute_jitter_sensitivity
from optodrive.lab.diagnosis.noise_model import whiten
from optodrive.lab.diagnosis.replicate_contrasts import Contrast, compute_contrasts
from optodrive.physics.pixel import Pixel
from optodrive.physics.pixel_ode import ActiveTerms, PixelExperiment, simulate_signals

SLICE_S = 0.012
"""Length of a pulse slice, about the thermal time constant: faster fluctuations are smoothed, slower span slices."""
MAX_SLICES = 2000
"""Maximum number of slices that are examined; of more, evenly spaced ones are."""

RUN_POWER_SIGMA = 1.0
"""Prior σ of a run's relative power here: ageing and drift between repeats are no fluctuation within pulses."""


def compute_intra_pulse_power_excess(problem: FitProblem, base: ModelFit) -> float:
    """Return the score statistic, in σ, for independent powers of the pulse slices added to the noise model."""
    data, noise = problem.data, problem.noise
    sensitivity = compute_jitter_sensitivity(data, base.point, base.prediction)
    pixel = base.point.pixel()
    experiments = {number: experiment for experiment, numbers in data.experiments for number in numbers}
    pairs: dict[int, list[Contrast]] = {}
    for item in compute_contrasts(data, data.value - base.prediction, sensitivity.power, sensitivity.timing):
        if item.kind in PIXEL_KINDS:
            pairs.setdefault(item.pair, []).append(item)
    excess = variance = 0.0
    for members in pairs.values():
        slices = slice_pulses(experiments[members[0].block].pulses)
        count = 1 + len(slices)
        size = 2 + len(PIXEL_KINDS)
        gram = np.zeros((count + size, count + size))
        for item in members:
            sigma = np.array([RUN_POWER_SIGMA, noise.timing_sigma_s, noise.baseline_sigma[item.kind]])
            responses = _compute_slice_responses(experiments[item.block], slices, item, pixel)
            columns = np.column_stack([item.value, responses, item.jitter * sigma])
            whitened, _ = whiten(item.t_s, columns, noise.coloured[item.kind])
            indices = np.append(np.arange(count), count + np.array([0, 1, 2 + item.kind]))
            gram[np.ix_(indices, indices)] += whitened.T @ whitened
        inner = gram[count:, count:] + np.eye(size)
        projected = gram[:count, :count] - gram[:count, count:] @ np.linalg.solve(inner, gram[count:, :count])
        # The score of a variance at zero: it needs no fit of the fluctuation, which nobody would use.
        excess += float((projected[1:, 0] ** 2).sum() - np.trace(projected[1:, 1:]))
        variance += 2.0 * float((projected[1:, 1:] ** 2).sum())
    return excess / float(np.sqrt(variance)) if variance > 0.0 else 0.0


def slice_pulses(pulses: FloatArray, slice_s: float = SLICE_S) -> FloatArray:
    """Return pulses [k, 4] cut into equal slices, MAX_SLICES at most."""
    rows = []
    for start_s, width_s, power_w, pixel in pulses.tolist():
        count = max(1, round(width_s / slice_s))
        rows += [[start_s + k * width_s / count, width_s / count, power_w, pixel] for k in range(count)]
    slices = np.array(rows, dtype=np.float64).reshape(-1, 4)
    return slices[:: max(1, ceil(len(slices) / MAX_SLICES))]


def _compute_slice_responses(
    experiment: PixelExperiment, slices: FloatArray, item: Contrast, pixel: Pixel
) -> FloatArray:
    """Return the nominal response [n, k] to each slice: the derivative with respect to the logarithm of its power."""
    empty = np.zeros(0)
    times = tuple(item.t_s if kind == item.kind else empty for kind in PIXEL_KINDS)
    out = np.empty((len(item.t_s), len(slices)))
    for row in range(len(slices)):
        single = replace(experiment, pulses=slices[row : row + 1], t_s=(times[0], times[1], times[2]))
        out[:, row] = simulate_signals(single, pixel, ActiveTerms.from_values({}), (0.0, 0.0, 0.0))[item.kind]
    return out
