"""Basis functions for the deviation of a real cause from its term's functional form.

A real droop need not follow the power, ageing need not be uniform, a rise need not be exponential, an emissivity may
depend on temperature, a gas need not follow the warmth of a wall. The residuals of a fitted cause are therefore first
compared with the cause's own effect, modulated by power, temperature, dose and session time, with another share of it
in each signal, with its term at other time constants and with its other hypotheses; only then is a second cause
considered. A late clock is late: only its share in each signal is free.
"""

from collections.abc import Sequence
from contextlib import suppress

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.lab.diagnosis.dataset import Dataset
from optodrive.lab.diagnosis.fitting import (
    FitProblem,
    ModelFit,
    compute_jacobian,
    compute_jitter_sensitivity,
    compute_normal_equations,
    solve,
)
from optodrive.lab.diagnosis.prediction import ParameterPoint, predict
from optodrive.lab.diagnosis.search_log import UNCOMPUTABLE
from optodrive.physics.hypothesis import Hypothesis
from optodrive.physics.terms import discover_terms

MIN_POWER_FRACTION = 0.02
"""Lower limit of the relative power in the modulation by its inverse."""
DISCREPANCY_SIGMA = 0.2
"""Prior standard deviation of the coefficients of the basis, relative to the effect of the cause."""
SIZE_ITERATIONS = 3
"""Number of times that the size of the discrepancy is estimated from its coefficients."""


def compute_discrepancy_basis(
    problem: FitProblem, fitted: ModelFit, hypotheses: Sequence[Hypothesis], all_hypotheses: Sequence[Hypothesis]
) -> FloatArray:
    """Compute basis columns [m, k] for a fit with these hypotheses."""
    data, terms = problem.data, fitted.point.terms
    power, dose, session, heat = (np.zeros(len(data.value)) for _ in range(4))
    for block in data.blocks:
        predicted = fitted.prediction[block.part]
        max_span = max(float(np.ptp(fitted.prediction[item.part])) for item in data.blocks if item.kind == block.kind)
        heat[block.part] = (predicted - predicted.min()) / max(max_span, 1e-300)
    for experiment, numbers in data.experiments:
        for number in numbers:
            if number >= 0:
                part = data.blocks[number].part
                dose[part] = experiment.dose_before
                session[part], power[part] = data.recorded_runs[number]
    columns: list[FloatArray] = []
    for item in hypotheses:
        others = {key: values for key, values in terms.items() if key != item.key}
        effect = fitted.prediction - predict(data, ParameterPoint(fitted.point.base, others))
        columns += _separate_signals(data, effect)
        term = discover_terms()[item.key]
        # As a clock: it has no other form than its share in each signal.
        if term.is_exact:
            continue
        if any(term.kernels):  # a record's filter does not know power, dose or heat
            columns += [
                effect * power,
                effect / np.maximum(power, MIN_POWER_FRACTION),
                effect * dose,
                effect * session,
                effect * heat,
            ]
        alternatives: list[ParameterPoint] = []
        for other in all_hypotheses:
            if other.key == item.key and other.label != item.label:
                # Beside the fitted values: the other hypothesis adds its numbers, and takes none away.
                sizes = {free.names[0]: other.starts[0][free.names[0]] for free in other.free}
                alternatives.append(
                    ParameterPoint(fitted.point.base, {**terms, item.key: {**terms[item.key], **sizes}})
                )
        for start in () if item.is_linear or item.fit_every_start else item.starts:
            alternatives.append(ParameterPoint(fitted.point.base, {**others, item.key: start}))
        for alternative in alternatives:
            with suppress(*UNCOMPUTABLE):  # no form of the effect
                columns.append(predict(data, alternative) - fitted.prediction)
    nonzero = [column for column in columns if np.abs(column).max(initial=0.0) > 0.0]
    return np.stack(nonzero, axis=1) if nonzero else np.zeros((len(data.value), 0))


def _separate_signals(data: Dataset, effect: FloatArray) -> list[FloatArray]:
    """Return the effect [m] in each signal that shows it but the first, which the amplitude of the effect covers."""
    parts = []
    for kind in data.kinds:
        part = np.zeros(len(effect))
        for block in data.blocks:
            if block.kind == kind:
                part[block.part] = effect[block.part]
        if part.any():
            parts.append(part)
    return parts[1:]


def compute_covariance(
    problem: FitProblem, fitted: ModelFit, hypotheses: Sequence[Hypothesis], all_hypotheses: Sequence[Hypothesis]
) -> FloatArray:
    """Compute the covariance [k, k] of fitted parameters, marginalised over a discrepancy.

    Its coefficients have the standard deviation `DISCREPANCY_SIGMA`, or their own size where the residuals show more.
    The change of the parameters beside that discrepancy counts as one standard deviation of their own.
    """
    basis_columns = compute_discrepancy_basis(problem, fitted, hypotheses, all_hypotheses)
    if not basis_columns.shape[1]:
        return fitted.covariance
    data, point = problem.data, fitted.point
    other_terms = {key: values for key, values in point.terms.items() if key not in {item.key for item in hypotheses}}
    effect = fitted.prediction - predict(data, ParameterPoint(point.base, other_terms))
    # The part along the effect itself is the fitted amplitude; a discrepancy is orthogonal to it.
    basis_columns = basis_columns - np.outer(effect, effect @ basis_columns / max(float(effect @ effect), 1e-300))
    sensitivity = compute_jitter_sensitivity(data, fitted.point, fitted.prediction)
    jacobian = compute_jacobian(problem, fitted.point, fitted.free, fitted.prediction)
    residual = (data.value - fitted.prediction)[:, None]
    total = compute_normal_equations(
        data, np.hstack([jacobian, basis_columns, residual]), problem.noise, sensitivity.power, sensitivity.timing
    ).total
    return _marginalise(total[:-1, :-1], total[:-1, -1], problem.prior.sigma, jacobian.shape[1])


def _marginalise(gram: FloatArray, right: FloatArray, prior_sigma: Sequence[float], count: int) -> FloatArray:
    """Return the covariance of the first `count` columns, the others being a discrepancy.

    right: columns × residual
    """
    weights = np.zeros(len(gram))
    weights[: len(prior_sigma)] = 1.0 / np.square(prior_sigma)
    alone = solve(gram[:count, :count] + np.diag(weights[:count]), right[:count])
    sigma = np.full(len(gram) - count, DISCREPANCY_SIGMA)
    for _ in range(SIZE_ITERATIONS):
        weights[count:] = 1.0 / np.square(sigma)
        both = solve(gram + np.diag(weights), right)
        sigma = np.maximum(DISCREPANCY_SIGMA, np.abs(both[count:]))
    weights[count:] = 1.0 / np.square(sigma)
    # After the loop: the last sizes have not been used yet.
    covariance = solve(gram + np.diag(weights), np.eye(len(gram)))[:count, :count]
    change = solve(gram + np.diag(weights), right)[:count] - alone
    # A parameter that moves when other forms are allowed depends on the form, though its curvature may be large.
    return np.asarray(covariance + np.outer(change, change))
