"""The same cause in another form than its term's: how its effect may bend before another cause is looked for.

A droop need not follow the power, wear need not be even, a rise need not be exponential, an emissivity may grow with
the temperature. What a fitted cause leaves is first compared with its own effect, growing or fading with power, with
heat, with dose and over the session, with its term at other times, and with the term's other sides.
"""

from collections.abc import Sequence

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.lab.diagnosis.fitting import Fit, Problem, jitter, slopes
from optodrive.lab.diagnosis.hypotheses import Hypothesis
from optodrive.lab.diagnosis.normal_equations import normal, solve
from optodrive.lab.diagnosis.prediction import Point, predict

WEAK = 0.02
"""Less power than this share of the full one counts as this."""
BENT = 0.2
"""Standard deviation of how much of a cause's effect takes another form."""


def bent(problem: Problem, fitted: Fit, hypotheses: Sequence[Hypothesis], known: Sequence[Hypothesis]) -> FloatArray:
    """[m, k] columns beside a fit that has these hypotheses, of all those known, in it."""
    data, terms = problem.data, fitted.point.terms
    power, dose, session, heat = (np.zeros(len(data.value)) for _ in range(4))
    for block in data.blocks:
        own = fitted.prediction[block.part]
        most = max(float(np.ptp(fitted.prediction[item.part])) for item in data.blocks if item.kind == block.kind)
        heat[block.part] = (own - own.min()) / max(most, 1e-300)
    for scene, places in data.scenes:
        for place in places:
            if place >= 0:
                part = data.blocks[place].part
                power[part] = scene.pulses[:, 2].max(initial=0.0) / scene.full_w
                dose[part] = scene.dose_before
                session[part] = scene.session
    columns: list[FloatArray] = []
    for item in hypotheses:
        others = {key: own for key, own in terms.items() if key != item.key}
        effect = fitted.prediction - predict(data, Point(fitted.point.base, others), problem.epsilon)
        columns += [effect * power, effect / np.maximum(power, WEAK), effect * dose, effect * session, effect * heat]
        for side in known:
            if side.key == item.key and side.label != item.label:
                sizes = {free.names[0]: side.starts[0][free.names[0]] for free in side.free}
                there = Point(fitted.point.base, {**terms, item.key: {**terms[item.key], **sizes}})
                columns.append(predict(data, there, problem.epsilon) - fitted.prediction)
        for start in () if item.linear or item.every else item.starts:
            there = Point(fitted.point.base, {**others, item.key: start})
            columns.append(predict(data, there, problem.epsilon) - fitted.prediction)
    seen = [column for column in columns if np.abs(column).max(initial=0.0) > 0.0]
    return np.stack(seen, axis=1) if seen else np.zeros((len(data.value), 0))


def covariance(
    problem: Problem, fitted: Fit, hypotheses: Sequence[Hypothesis], known: Sequence[Hypothesis]
) -> FloatArray:
    """[k, k] of a fit's numbers where each cause may also act in other forms, by `BENT` of its effect."""
    shape = bent(problem, fitted, hypotheses, known)
    if not shape.shape[1]:
        return fitted.covariance
    data, point = problem.data, fitted.point
    bare = {key: own for key, own in point.terms.items() if key not in {item.key for item in hypotheses}}
    effect = fitted.prediction - predict(data, Point(point.base, bare), problem.epsilon)
    # How large the effect is, is the number itself: another form is what differs from that.
    shape = shape - np.outer(effect, effect @ shape / max(float(effect @ effect), 1e-300))
    shared = jitter(data, fitted.point, problem.epsilon, fitted.prediction)
    own = slopes(problem, fitted.point, fitted.free, fitted.prediction)
    count, forms = own.shape[1], shape.shape[1]
    total = normal(data, np.hstack([own, shape]), problem.noise, shared.power, shared.timing).total()
    base = len(problem.prior.sigma)
    weights = np.concatenate(
        [1.0 / np.square(problem.prior.sigma), np.zeros(count - base), np.full(forms, 1.0 / BENT**2)]
    )
    return solve(total + np.diag(weights), np.eye(count + forms))[:count, :count]
