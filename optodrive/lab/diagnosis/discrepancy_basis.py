"""The same cause in another form than its term's: how its effect may bend before another cause is looked for.

A droop need not follow the power, wear need not be even, a rise need not be exponential, an emissivity may grow with
the temperature. What a fitted cause leaves is first compared with its own effect, growing or fading with power, with
heat, with dose and over the session, with its term at other times, and with the term's other sides.
"""

from collections.abc import Sequence

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.lab.diagnosis.fitting import FitProblem, ModelFit, compute_jacobian, compute_jitter_sensitivity
from optodrive.lab.diagnosis.hypotheses import Hypothesis
from optodrive.lab.diagnosis.normal_equations import compute_normal_equations, solve
from optodrive.lab.diagnosis.prediction import ParameterPoint, predict

MIN_POWER_FRACTION = 0.02
"""Less power than this share of the full one counts as this."""
DISCREPANCY_SIGMA = 0.2
"""Standard deviation of how much of a cause's effect takes another form."""


def compute_discrepancy_basis(
    problem: FitProblem, fitted: ModelFit, hypotheses: Sequence[Hypothesis], known: Sequence[Hypothesis]
) -> FloatArray:
    """[m, k] columns beside a fit that has these hypotheses, of all those known, in it."""
    data, terms = problem.data, fitted.point.terms
    power, dose, session, heat = (np.zeros(len(data.value)) for _ in range(4))
    for block in data.blocks:
        predicted = fitted.prediction[block.part]
        max_span = max(float(np.ptp(fitted.prediction[item.part])) for item in data.blocks if item.kind == block.kind)
        heat[block.part] = (predicted - predicted.min()) / max(max_span, 1e-300)
    for scene, places in data.experiments:
        for place in places:
            if place >= 0:
                part = data.blocks[place].part
                power[part] = scene.pulses[:, 2].max(initial=0.0) / scene.full_w
                dose[part] = scene.dose_before
                session[part] = scene.session_time
    columns: list[FloatArray] = []
    for item in hypotheses:
        others = {key: own for key, own in terms.items() if key != item.key}
        effect = fitted.prediction - predict(data, ParameterPoint(fitted.point.base, others), problem.epsilon)
        columns += [
            effect * power,
            effect / np.maximum(power, MIN_POWER_FRACTION),
            effect * dose,
            effect * session,
            effect * heat,
        ]
        for side in known:
            if side.key == item.key and side.label != item.label:
                sizes = {free.names[0]: side.starts[0][free.names[0]] for free in side.free}
                alternative = ParameterPoint(fitted.point.base, {**terms, item.key: {**terms[item.key], **sizes}})
                columns.append(predict(data, alternative, problem.epsilon) - fitted.prediction)
        for start in () if item.is_linear or item.fit_every_start else item.starts:
            alternative = ParameterPoint(fitted.point.base, {**others, item.key: start})
            columns.append(predict(data, alternative, problem.epsilon) - fitted.prediction)
    nonzero = [column for column in columns if np.abs(column).max(initial=0.0) > 0.0]
    return np.stack(nonzero, axis=1) if nonzero else np.zeros((len(data.value), 0))


def compute_covariance(
    problem: FitProblem, fitted: ModelFit, hypotheses: Sequence[Hypothesis], known: Sequence[Hypothesis]
) -> FloatArray:
    """[k, k] of a fit's numbers where each cause may also act in other forms, by `BENT` of its effect."""
    basis = compute_discrepancy_basis(problem, fitted, hypotheses, known)
    if not basis.shape[1]:
        return fitted.covariance
    data, point = problem.data, fitted.point
    other_terms = {key: own for key, own in point.terms.items() if key not in {item.key for item in hypotheses}}
    effect = fitted.prediction - predict(data, ParameterPoint(point.base, other_terms), problem.epsilon)
    # How large the effect is, is the number itself: another form is what differs from that.
    basis = basis - np.outer(effect, effect @ basis / max(float(effect @ effect), 1e-300))
    sensitivity = compute_jitter_sensitivity(data, fitted.point, problem.epsilon, fitted.prediction)
    jacobian = compute_jacobian(problem, fitted.point, fitted.free, fitted.prediction)
    count, basis_size = jacobian.shape[1], basis.shape[1]
    total = compute_normal_equations(
        data, np.hstack([jacobian, basis]), problem.noise, sensitivity.power, sensitivity.timing
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
