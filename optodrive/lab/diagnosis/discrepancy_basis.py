"""Basis functions for the deviation of a real cause from its term's functional form.

A real droop need not follow the power, ageing need not be uniform, a rise need not be exponential, an emissivity may
depend on temperature. The residuals of a fitted cause are therefore first compared with the cause's own effect,
modulated by power, temperature, dose and session time, with its term at other time constants and with its other
hypotheses, before a second cause is considered.
"""

from collections.abc import Sequence

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.lab.diagnosis.fitting import FitProblem, ModelFit, compute_jacobian, compute_jitter_sensitivity
from optodrive.lab.diagnosis.normal_equations import compute_normal_equations, solve
from optodrive.lab.diagnosis.prediction import ParameterPoint, predict
from optodrive.physics.hypothesis import Hypothesis

MIN_POWER_FRACTION = 0.02
"""Lower limit of the relative power in the modulation by its inverse."""
DISCREPANCY_SIGMA = 0.2
"""Prior standard deviation of the coefficients of the basis, relative to the effect of the cause."""


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
                power[part] = experiment.pulses[:, 2].max(initial=0.0) / experiment.full_w
                dose[part] = experiment.dose_before
                session[part] = experiment.session_time
    columns: list[FloatArray] = []
    for item in hypotheses:
        others = {key: values for key, values in terms.items() if key != item.key}
        effect = fitted.prediction - predict(data, ParameterPoint(fitted.point.base, others), problem.epsilon)
        columns += [
            effect * power,
            effect / np.maximum(power, MIN_POWER_FRACTION),
            effect * dose,
            effect * session,
            effect * heat,
        ]
        for other in all_hypotheses:
            if other.key == item.key and other.label != item.label:
                sizes = {free.names[0]: other.starts[0][free.names[0]] for free in other.free}
                alternative = ParameterPoint(fitted.point.base, {**terms, item.key: {**terms[item.key], **sizes}})
                columns.append(predict(data, alternative, problem.epsilon) - fitted.prediction)
        for start in () if item.is_linear or item.fit_every_start else item.starts:
            alternative = ParameterPoint(fitted.point.base, {**others, item.key: start})
            columns.append(predict(data, alternative, problem.epsilon) - fitted.prediction)
    nonzero = [column for column in columns if np.abs(column).max(initial=0.0) > 0.0]
    return np.stack(nonzero, axis=1) if nonzero else np.zeros((len(data.value), 0))


def compute_covariance(
    problem: FitProblem, fitted: ModelFit, hypotheses: Sequence[Hypothesis], all_hypotheses: Sequence[Hypothesis]
) -> FloatArray:
    """Compute the covariance [k, k] of fitted parameters, marginalised over a discrepancy of `DISCREPANCY_SIGMA`."""
    basis_columns = compute_discrepancy_basis(problem, fitted, hypotheses, all_hypotheses)
    if not basis_columns.shape[1]:
        return fitted.covariance
    data, point = problem.data, fitted.point
    other_terms = {key: values for key, values in point.terms.items() if key not in {item.key for item in hypotheses}}
    effect = fitted.prediction - predict(data, ParameterPoint(point.base, other_terms), problem.epsilon)
    # The part along the effect itself is the fitted amplitude; a discrepancy is orthogonal to it.
    basis_columns = basis_columns - np.outer(effect, effect @ basis_columns / max(float(effect @ effect), 1e-300))
    sensitivity = compute_jitter_sensitivity(data, fitted.point, problem.epsilon, fitted.prediction)
    jacobian = compute_jacobian(problem, fitted.point, fitted.free, fitted.prediction)
    count, basis_size = jacobian.shape[1], basis_columns.shape[1]
    total = compute_normal_equations(
        data, np.hstack([jacobian, basis_columns]), problem.noise, sensitivity.power, sensitivity.timing
    ).total
    base_count = len(problem.prior.sigma)
    weights = np.concatenate(
        [
            1.0 / np.square(problem.prior.sigma),
            np.zeros(count - base_count),
            np.full(basis_size, 1.0 / DISCREPANCY_SIGMA**2),
        ]
    )
    return solve(total + np.diag(weights), np.eye(count + basis_size))[:count, :count]
