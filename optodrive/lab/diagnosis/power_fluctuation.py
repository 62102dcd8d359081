"""Whether the power is steady within pulses: repeats that differ as if each slice of light had a power of its own.

A run's power jitter is one number for the whole run. Light that hops within pulses is shared by no repeat and looks
like slow noise to a noise model; but it comes with the light, and fades as the absorber cools.
"""

from dataclasses import replace

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.lab.diagnosis.dataset import PIXEL_KINDS
from optodrive.lab.diagnosis.fitting import FitProblem, ModelFit, compute_jitter_sensitivity
from optodrive.lab.diagnosis.noise_model import whiten
from optodrive.lab.diagnosis.replicate_contrasts import Contrast, compute_contrasts
from optodrive.physics.pixel import Pixel
from optodrive.physics.pixel_ode import ActiveTerms, PixelExperiment, simulate_signals

SLICE_S = 0.012
"""About a thermal time: what is quicker is smoothed, what is slower spans several slices."""

RUN_POWER_SIGMA = 1.0
"""A run as a whole may have any power here: wear and drift between repeats are no unsteadiness."""


def compute_intra_pulse_power_excess(problem: FitProblem, base: ModelFit) -> float:
    """Score of a variance of the slices' powers beside the noise model, in its own σ."""
    data, noise = problem.data, problem.noise
    sensitivity = compute_jitter_sensitivity(data, base.point, problem.epsilon, base.prediction)
    pixel = base.point.pixel(problem.epsilon)
    experiments = {place: scene for scene, places in data.experiments for place in places}
    pairs: dict[int, list[Contrast]] = {}
    for item in compute_contrasts(data, data.value - base.prediction, sensitivity.power, sensitivity.timing):
        if item.kind in PIXEL_KINDS:
            pairs.setdefault(item.pair, []).append(item)
    excess = variance = 0.0
    for own in pairs.values():
        slices = _slice_pulses(experiments[own[0].block].pulses)
        count = 1 + len(slices)
        size = 2 + len(PIXEL_KINDS)
        gram = np.zeros((count + size, count + size))
        for item in own:
            sigma = np.array([RUN_POWER_SIGMA, noise.timing_sigma_s, noise.baseline_sigma[item.kind]])
            responses = _compute_slice_responses(experiments[item.block], slices, item, pixel)
            columns = np.column_stack([item.value, responses, item.jitter * sigma])
            whitened, _ = whiten(item.t_s, columns, noise.coloured[item.kind])
            where = np.append(np.arange(count), count + np.array([0, 1, 2 + item.kind]))
            gram[np.ix_(where, where)] += whitened.T @ whitened
        inner = gram[count:, count:] + np.eye(size)
        projected = gram[:count, :count] - gram[:count, count:] @ np.linalg.solve(inner, gram[count:, :count])
        excess += float((projected[1:, 0] ** 2).sum() - np.trace(projected[1:, 1:]))
        variance += 2.0 * float((projected[1:, 1:] ** 2).sum())
    return excess / float(np.sqrt(variance)) if variance > 0.0 else 0.0


def _slice_pulses(pulses: FloatArray) -> FloatArray:
    """[k, 4] pulses cut into equal pieces."""
    rows = []
    for start_s, width_s, power_w, lit in pulses.tolist():
        count = max(1, round(width_s / SLICE_S))
        rows += [[start_s + k * width_s / count, width_s / count, power_w, lit] for k in range(count)]
    return np.array(rows, dtype=np.float64).reshape(-1, 4)


def _compute_slice_responses(
    experiment: PixelExperiment, slices: FloatArray, item: Contrast, pixel: Pixel
) -> FloatArray:
    """[n, k] the nominal answer to each slice alone: its change with the logarithm of that slice's power."""
    empty = np.zeros(0)
    times = tuple(item.t_s if kind == item.kind else empty for kind in PIXEL_KINDS)
    out = np.empty((len(item.t_s), len(slices)))
    for row in range(len(slices)):
        single = replace(experiment, pulses=slices[row : row + 1], t_s=(times[0], times[1], times[2]))
        out[:, row] = simulate_signals(single, pixel, ActiveTerms.from_values({}), (0.0, 0.0, 0.0))[item.kind]
    return out
