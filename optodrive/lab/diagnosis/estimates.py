"""Fitted parameters with their intervals beside other forms of their causes, and the doubts that these leave.

A real droop need not follow the power, ageing need not be uniform, a rise need not be exponential, an emissivity may
depend on temperature, a gas need not follow the warmth of a wall. The residuals of a fitted cause are therefore first
compared with the cause's own effect, modulated by power, temperature, dose and session time, with another share of it
in each signal, with its term at other time constants and with its other hypotheses; only then is a second cause
considered. A late clock is late: only its share in each signal is free.
"""

from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from math import exp

import numpy as np
from scipy.special import stdtrit

from optodrive.core.quantity import format_range
from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.discrepancy import Estimate
from optodrive.lab.diagnosis.dataset import Dataset
from optodrive.lab.diagnosis.detection import UNCOMPUTABLE
from optodrive.lab.diagnosis.evidence import count_noise_degrees
from optodrive.lab.diagnosis.fitting import (
    FitProblem,
    ModelFit,
    compute_jacobian,
    compute_jitter_sensitivity,
    compute_normal_equations,
    fit,
    solve,
)
from optodrive.lab.diagnosis.prediction import BASE_PARAMETERS, BASE_UNITS, ParameterPoint, predict
from optodrive.physics.hypothesis import FreeParameter, Hypothesis
from optodrive.physics.terms import discover_terms

PROFILE_STEPS, PROFILE_ITERATIONS = 5, 10
"""Halvings by which the smallest size of an effect is found, and iterations of the fit beside each."""
LIMIT_SHARE = 1e-3
"""A fitted number within this share of a limit of its range counts as at the limit."""


def compute_estimates(data: Dataset, final: ModelFit, covariance: FloatArray) -> dict[str, Estimate]:
    """Return the estimate of each fitted parameter by name.

    covariance: of base, then free parameters
    """
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    out: dict[str, Estimate] = {}
    # Student's: the noise is known by as many values as there are repeats.
    t_quantile = float(stdtrit(count_noise_degrees(data), 0.975))
    if any(kind < 3 for kind in data.kinds):
        for row, name in enumerate(BASE_PARAMETERS):
            log_value, width = final.point.base[row], t_quantile * float(sigma[row])
            out[name] = Estimate(exp(log_value), BASE_UNITS[name], exp(log_value - width), exp(log_value + width))
    for row, free in enumerate(final.free, start=len(BASE_PARAMETERS)):
        # A logarithm that the data leave open would overflow its exponential.
        number, width = free.read_value(final.point.terms), t_quantile * float(min(sigma[row], 50.0))
        ends = (number - width, number + width)
        value, low, high = (exp(min(x, 300.0)) if free.logarithmic else x for x in (number, *ends))
        at_limit = is_at_limit(final, free)
        # At a limit the interval is not cut, or it would have no width and pass for exact.
        if not at_limit:
            low, high = max(low, free.parameter.low), min(high, free.parameter.high)
        for name in free.names:
            out[f"{free.key}.{name}"] = Estimate(value, free.parameter.unit, low, high, at_limit)
    return out


def limit_sizes(
    problem: FitProblem, final: ModelFit, hypotheses: Iterable[Hypothesis], estimates: dict[str, Estimate]
) -> dict[str, Estimate]:
    """Return the estimates, with the intervals of sizes that seem to contain no effect by their profile likelihood.

    An effect of several shapes has sizes and shapes that trade against each other, and an interval from the curvature
    at the best fit then reaches no effect though no shape fits without it.
    """
    out, limit = dict(estimates), final.chi2 + float(stdtrit(count_noise_degrees(problem.data), 0.975)) ** 2
    for item in hypotheses:
        for free in _list_sizes(item):
            name = f"{free.key}.{free.names[0]}"
            # The profile costs fits, and is needed only where the curvature doubts a size.
            if _describe_doubt(free, estimates[name]):
                low, high = estimates[name].low, estimates[name].high
                nearest = _find_size_bound(problem, final, free, limit)
                ends = (low, nearest) if estimates[name].value < 0.0 else (nearest, high)
                out |= {
                    f"{free.key}.{each}": replace(estimates[name], low=ends[0], high=ends[1]) for each in free.names
                }
    return out


def _find_size_bound(problem: FitProblem, final: ModelFit, free: FreeParameter, limit: float) -> float:
    """Return the size towards no effect that all other numbers, fitted beside it, do not bring below this χ²."""
    others = [item for item in final.free if item != free]
    value, absent = free.read_value(final.point.terms), free.limits[0] if free.logarithmic else 0.0
    excluded, kept = 0.0, 1.0
    for _ in range(PROFILE_STEPS):
        # What is returned is excluded by a fit: the bound errs towards no effect, by a step at most.
        share = 0.5 * (excluded + kept)
        terms = free.with_value(final.point.terms, absent + share * (value - absent))
        if fit(problem, replace(final.point, terms=terms), others, PROFILE_ITERATIONS).chi2 > limit:
            excluded = share
        else:
            kept = share
    number = absent + excluded * (value - absent)
    return exp(number) if free.logarithmic else number


def is_at_limit(final: ModelFit, free: FreeParameter) -> bool:
    """Return whether a fitted number that is no shape lies at a limit of its range other than zero."""
    value, item = final.point.terms[free.key][free.names[0]], free.parameter
    limits = [limit for limit in (item.low, item.high) if limit != 0.0]
    return not item.is_shape and any(abs(value - limit) <= LIMIT_SHARE * abs(limit) for limit in limits)


def describe_doubts(hypotheses: Iterable[Hypothesis], estimates: dict[str, Estimate]) -> dict[str, str]:
    """Return, by cause, a clause for each named cause whose size the data do not establish.

    A size is established if its interval excludes no effect: zero, or for a positive size the smallest plausible one. A
    cause with several sizes is in doubt if all of them are.
    """
    doubts = {}
    for item in hypotheses:
        clauses = [_describe_doubt(free, estimates[f"{free.key}.{free.names[0]}"]) for free in _list_sizes(item)]
        # One size that is established establishes the cause.
        if all(clauses):
            doubts[item.key] = " and ".join(clauses)
    return doubts


def describe_limits(hypotheses: Iterable[Hypothesis], estimates: dict[str, Estimate]) -> dict[str, str]:
    """Return, by cause, a clause for each named cause of which a number lies at a limit of its plausible range."""
    doubts: dict[str, str] = {}
    for item in hypotheses:
        ended = [free.label for free in item.free if _ends_at_limit(free, estimates[f"{free.key}.{free.names[0]}"])]
        if ended:
            places = "lies at a limit of its plausible range" if len(ended) == 1 else "lie at limits of their ranges"
            doubts[item.key] = f"{' and '.join(ended)} {places}"
    return doubts


def _list_sizes(item: Hypothesis) -> tuple[FreeParameter, ...]:
    return item.free if item.is_linear else item.free[:1]


def _ends_at_limit(free: FreeParameter, estimate: Estimate) -> bool:
    """Return whether a number lies at a limit: a size at any, a shape at its largest value, unless that is a share."""
    high = free.parameter.high
    # A time constant at its largest value means a longer one; a share of 1 is a whole.
    is_largest = free.parameter.is_shape and high != 1.0 and abs(estimate.value - high) <= LIMIT_SHARE * abs(high)
    return estimate.at_limit or is_largest


def _describe_doubt(free: FreeParameter, estimate: Estimate) -> str:
    """Return the doubt about one size, or nothing."""
    absent = free.parameter.low if free.logarithmic else 0.0
    if estimate.at_limit or not estimate.low <= absent <= estimate.high:
        return ""
    interval = format_range(estimate.low, estimate.high, free.parameter.unit)
    contained = "the smallest plausible size" if free.logarithmic else "zero"
    return f"the 95 % interval of {free.label}, {interval}, contains {contained}"


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
    total = compute_normal_equations(data, np.hstack([jacobian, basis_columns, residual]), problem.noise, sensitivity)
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
