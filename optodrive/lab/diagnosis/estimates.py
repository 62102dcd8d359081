"""Fitted parameters with their intervals, and the doubts that these leave about a named cause."""

from collections.abc import Iterable
from dataclasses import replace
from math import exp

import numpy as np
from scipy.special import stdtrit

from optodrive.core.quantity import format_range
from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.discrepancy import Estimate
from optodrive.lab.diagnosis.dataset import Dataset
from optodrive.lab.diagnosis.fitting import FitProblem, ModelFit, fit
from optodrive.lab.diagnosis.noise_certainty import count_noise_degrees
from optodrive.lab.diagnosis.prediction import BASE_PARAMETERS, BASE_UNITS
from optodrive.physics.hypothesis import FreeParameter, Hypothesis

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
