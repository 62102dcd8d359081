"""Evidence for a term from held-out blocks, which no choice and no fit has used."""

from collections.abc import Sequence
from math import e, erfc, log, sqrt

import numpy as np

from optodrive.lab.discovery.blocks import Data
from optodrive.lab.discovery.fitting import Point, Simulation, weigh
from optodrive.lab.discovery.screening import Filtered

PARTS = 8
"""Parts of a held-out block whose products of change and error are taken as independent."""


def find_p_value(
    simulation: Simulation, data: Data, filtered: Sequence[Filtered], shorter: Point, longer: Point
) -> float:
    """Return the probability that noise makes the longer model predict held-out blocks as much better as it does.

    The change d of the predictions by the term does not depend on the noise of held-out samples, so without an effect
    the sum of d times the error e of the shorter model has mean zero. Its variance is estimated from sums over parts
    of blocks, from the longer model's errors, which the effect itself does not inflate. 1 if the error does not fall.
    """
    score, squares, reduction = 0.0, 0.0, 0.0
    for each, mask in zip(filtered, data.masks(data.held_out), strict=True):
        before = simulation.run(each.record, shorter, each.line.gains)[0]
        after = simulation.run(each.record, longer, each.line.gains)[0]
        if not np.isfinite(after[mask]).all():
            return 1.0
        error0 = weigh(each.record, np.nan_to_num(each.record.outputs - before), each.weights)
        error1 = weigh(each.record, np.nan_to_num(each.record.outputs - after), each.weights)
        change = (error0 - error1) * mask[:, None]
        score += float(np.sum(change * error0))
        reduction += float(np.sum(mask[:, None] * (error0**2 - error1**2)))
        for label in np.unique(each.block[mask]):
            for part in np.array_split(np.flatnonzero(each.block == label), PARTS):
                squares += float(np.sum(change[part] * error1[part])) ** 2
    if reduction <= 0.0 or squares == 0.0:
        return 1.0 if reduction <= 0.0 else 0.0
    return 0.5 * erfc(score / sqrt(2.0 * squares))


def compute_probability(p_value: float) -> float:
    """Return the probability of an effect at even odds beforehand.

    The Bayes factor is at least 1 / (−e p ln p) (Sellke, Bayarri & Berger 2001); the probability is that of this bound.
    """
    p = max(p_value, 1e-300)
    return 1.0 / (1.0 - e * p * log(p)) if p < 1.0 / e else 0.5
