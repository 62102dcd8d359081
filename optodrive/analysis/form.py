"""The same cause in another form than its term's: how its effect may bend before another cause is looked for.

A droop need not follow the power, wear need not be even, a rise need not be exponential. What a fitted cause leaves is
first compared with its own effect, growing or fading with power, with dose and over the session, and with its term at
other times.
"""

from collections.abc import Sequence

import numpy as np

from optodrive.analysis.causes import Hypothesis
from optodrive.analysis.fit import Fit, Problem
from optodrive.analysis.predict import Point, predict
from optodrive.flow import FloatArray


def bent(problem: Problem, fitted: Fit, hypotheses: Sequence[Hypothesis]) -> FloatArray:
    """[m, k] columns beside a fit that has these hypotheses in it."""
    data, terms = problem.data, fitted.point.terms
    power, dose, session = (np.zeros(len(data.value)) for _ in range(3))
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
        columns += [effect * power, effect * dose, effect * session]
        for start in () if item.linear or item.every else item.starts:
            there = Point(fitted.point.base, {**others, item.key: start})
            columns.append(predict(data, there, problem.epsilon) - fitted.prediction)
    seen = [column / np.abs(column).max() for column in columns if np.abs(column).max(initial=0.0) > 0.0]
    return np.stack(seen, axis=1) if seen else np.zeros((len(data.value), 0))
