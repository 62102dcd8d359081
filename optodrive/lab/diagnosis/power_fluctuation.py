"""Whether the power is steady within pulses: repeats that differ as if each slice of light had a power of its own.

A run's power jitter is one number for the whole run. Light that hops within pulses is shared by no repeat and looks
like slow noise to a noise model; but it comes with the light, and fades as the absorber cools.
"""

from dataclasses import replace

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.lab.diagnosis.dataset import PIXEL_KINDS
from optodrive.lab.diagnosis.fitting import Fit, Problem, jitter
from optodrive.lab.diagnosis.noise_model import whiten
from optodrive.lab.diagnosis.replicate_contrasts import Contrast, contrasts
from optodrive.physics.pixel import Pixel
from optodrive.physics.pixel_ode import Active, Scene, observe

SLICE_S = 0.012
"""About a thermal time: what is quicker is smoothed, what is slower spans several slices."""

ANY_POWER = 1.0
"""A run as a whole may have any power here: wear and drift between repeats are no unsteadiness."""


def unsteadiness(problem: Problem, base: Fit) -> float:
    """Score of a variance of the slices' powers beside the noise model, in its own σ."""
    data, noise = problem.data, problem.noise
    shared = jitter(data, base.point, problem.epsilon, base.prediction)
    pixel = base.point.pixel(problem.epsilon)
    scenes = {place: scene for scene, places in data.scenes for place in places}
    pairs: dict[int, list[Contrast]] = {}
    for item in contrasts(data, data.value - base.prediction, shared.power, shared.timing):
        if item.kind in PIXEL_KINDS:
            pairs.setdefault(item.pair, []).append(item)
    excess = variance = 0.0
    for own in pairs.values():
        slices = _slices(scenes[own[0].block].pulses)
        count = 1 + len(slices)
        size = 2 + len(PIXEL_KINDS)
        gram = np.zeros((count + size, count + size))
        for item in own:
            sigma = np.array([ANY_POWER, noise.timing_s, noise.baseline[item.kind]])
            light = _responses(scenes[item.block], slices, item, pixel)
            columns = np.column_stack([item.value, light, item.jitter * sigma])
            whitened, _ = whiten(item.t_s, columns, noise.coloured[item.kind])
            where = np.append(np.arange(count), count + np.array([0, 1, 2 + item.kind]))
            gram[np.ix_(where, where)] += whitened.T @ whitened
        inner = gram[count:, count:] + np.eye(size)
        left = gram[:count, :count] - gram[:count, count:] @ np.linalg.solve(inner, gram[count:, :count])
        excess += float((left[1:, 0] ** 2).sum() - np.trace(left[1:, 1:]))
        variance += 2.0 * float((left[1:, 1:] ** 2).sum())
    return excess / float(np.sqrt(variance)) if variance > 0.0 else 0.0


def _slices(pulses: FloatArray) -> FloatArray:
    """[k, 4] pulses cut into equal pieces."""
    rows = []
    for start_s, width_s, power_w, lit in pulses.tolist():
        pieces = max(1, round(width_s / SLICE_S))
        rows += [[start_s + k * width_s / pieces, width_s / pieces, power_w, lit] for k in range(pieces)]
    return np.array(rows, dtype=np.float64).reshape(-1, 4)


def _responses(scene: Scene, slices: FloatArray, item: Contrast, pixel: Pixel) -> FloatArray:
    """[n, k] the nominal answer to each slice alone: its change with the logarithm of that slice's power."""
    none = np.zeros(0)
    times = tuple(item.t_s if kind == item.kind else none for kind in PIXEL_KINDS)
    out = np.empty((len(item.t_s), len(slices)))
    for row in range(len(slices)):
        alone = replace(scene, pulses=slices[row : row + 1], t_s=(times[0], times[1], times[2]))
        out[:, row] = observe(alone, pixel, Active.of({}), (0.0, 0.0, 0.0))[item.kind]
    return out
