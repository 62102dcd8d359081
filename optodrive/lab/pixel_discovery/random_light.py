"""Light that changes at random within runs, other in every repeat: which no term of states and time can describe.

Theory of operation. Pulses are cut into slices of about the thermal time constant. The power of every slice is fitted
to the temperature of its run, and judged by the displacement and force that it predicts, of which a fit has seen one
factor each: light moves all signals together, an instrument only its own.
"""

from dataclasses import dataclass, replace
from math import sqrt

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.discrepancy import Probabilities
from optodrive.lab.diagnosis.dataset import PIXEL_KINDS
from optodrive.lab.diagnosis.fitting import FitProblem, ModelFit
from optodrive.lab.diagnosis.nominal_fit import slice_pulses
from optodrive.lab.inference.claim import (
    MAX_NO_EFFECT,
    Alternative,
    Evidence,
    SplitGain,
    TermClaim,
    TermForm,
    claim,
    compute_no_effect,
)
from optodrive.lab.pixel_discovery.findings import PixelFinding
from optodrive.physics.pixel_ode import ActiveTerms, PixelExperiment, simulate_signals

SLICE_S = 6e-3
POWER_SIGMA = 0.5
"""Prior σ of a slice's relative power: a missed pulse has none."""
MIN_GAIN = 0.5
"""Share of the displacement's and force's error that the powers remove, below which the light is not the cause."""
DARK = 0.3
"""Relative power below which a slice counts as dark."""


@dataclass(frozen=True, eq=False)
class _RunPowers:
    """Relative powers [k] of the slices of one run, and its other signals in units of noise.

    signals: by kind, [n, 3]: measured, and predicted from one power and from those of all slices; without zeros
    """

    powers: FloatArray
    signals: dict[int, FloatArray]


def find_random_light(problem: FitProblem, base: ModelFit) -> tuple[tuple[PixelFinding, ...], tuple[float, float]]:
    """Return the finding, if there is one, and the errors in units of the noise before and after."""
    runs = [
        found
        for experiment, numbers in problem.data.experiments
        if len(experiment.pulses) and (experiment.pulses[:, 3] == experiment.pixel).all()
        if (found := _fit_powers(problem, base, experiment, numbers)) is not None
    ]
    if not runs:
        return (), (1.0, 1.0)
    errors = _compute_errors(runs)
    before, after = np.concatenate([each[:, 0] for each in errors]), np.concatenate([each[:, 1] for each in errors])
    rms = float(np.sqrt(np.mean(before**2))), float(np.sqrt(np.mean(after**2)))
    gain = (rms[0] - rms[1]) / max(rms[0] - min(1.0, rms[1]), 1e-9)
    score = sum(float(((each[:, 0] - each[:, 1]) * each[:, 0]).sum()) for each in errors)
    squares = sum(float(((each[:, 0] - each[:, 1]) * each[:, 1]).sum()) ** 2 for each in errors)
    no_effect = compute_no_effect(score / sqrt(max(squares, 1e-300)), len(runs))
    if gain < MIN_GAIN or no_effect > MAX_NO_EFFECT:
        return (), rms
    powers = np.concatenate([run.powers for run in runs])
    form = TermForm("light", (), "random", _describe(powers), 1.0, gain)
    gains = (SplitGain("displacement and force", gain, gain),)
    probabilities = Probabilities(no_effect, 0.0, {(form.kind,): 1.0 - no_effect})
    claimed = claim(Evidence(probabilities, (Alternative((form.kind,), gains=gains),)))
    return (PixelFinding("light", TermClaim(claimed, 1.0 - no_effect, (form,), form, gains), None),), rms


def _fit_powers(
    problem: FitProblem, base: ModelFit, experiment: PixelExperiment, numbers: tuple[int, int, int]
) -> _RunPowers | None:
    """Return the powers of a run's slices, None where its temperature or all other signals are missing."""
    judged = [kind for kind in PIXEL_KINDS[1:] if numbers[kind] >= 0]
    if numbers[0] < 0 or not judged:
        return None
    data, pixel = problem.data, base.point.pixel()
    slices = slice_pulses(experiment.pulses, SLICE_S)
    nothing = ActiveTerms.from_values({})
    parts = [simulate_signals(replace(experiment, pulses=part[None, :]), pixel, nothing) for part in slices]
    responses = [np.column_stack([each[kind] for each in parts]) for kind in PIXEL_KINDS]
    residual, noise = data.value - base.prediction, problem.noise
    measured = residual[data.blocks[numbers[0]].part]
    columns = np.column_stack([responses[0], np.full(len(measured), noise.baseline_sigma[0])])
    white = noise.coloured[0].white
    precision = np.append(np.full(len(slices), 1.0 / POWER_SIGMA**2), 1.0)
    matrix = columns.T @ columns / white**2 + np.diag(precision)
    changes = np.linalg.solve(matrix, columns.T @ measured / white**2)[:-1]
    whole = responses[0].sum(axis=1)
    common = np.full(len(slices), float(whole @ measured / (whole @ whole)))
    signals = dict[int, FloatArray]()
    for kind in judged:
        part = data.blocks[numbers[kind]].part
        columns = np.column_stack(
            [data.value[part], responses[kind] @ (1.0 + common), responses[kind] @ (1.0 + changes)]
        )
        signals[kind] = (columns - columns.mean(axis=0)) / noise.coloured[kind].white
    return _RunPowers(1.0 + changes, signals)


def _compute_errors(runs: list[_RunPowers]) -> list[FloatArray]:
    """Return the errors [n, 2] of each run's other signals, each predicted with one factor common to all runs."""
    errors = [list[FloatArray]() for _ in runs]
    for kind in PIXEL_KINDS[1:]:
        own = [(run.signals[kind], out) for run, out in zip(runs, errors, strict=True) if kind in run.signals]
        if not own:
            continue
        joined = np.concatenate([signal for signal, _ in own])
        factors = (joined[:, 1:] * joined[:, :1]).sum(axis=0) / (joined[:, 1:] ** 2).sum(axis=0)
        for signal, out in own:
            out.append(signal[:, :1] - factors * signal[:, 1:])
    return [np.concatenate(out) for out in errors]


def _describe(powers: FloatArray) -> str:
    """Return a description of the powers [k] of all slices."""
    dark = int((powers < DARK).sum())
    if dark:
        return f"{dark} of {len(powers)} parts of pulses stay dark"
    middle = 0.5 * (powers.min() + powers.max())
    share = 1.0 - float(np.median(powers[powers < middle])) / float(np.median(powers[powers >= middle]))
    return f"the power falls by {share:.1%} and returns"
