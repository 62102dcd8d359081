"""The factor by which values of a parameter within its range can exceed the worse of its ends."""

from math import e, log


def specht_ratio(ratio: float) -> float:
    """Return the factor by which a sum of responses (1/c) e^(−t/rc) can exceed its larger value at the ends of c.

    ratio: larger over smaller end of c.

    With s = 1/c each response is s e^(−xs). For s between its ends, with weights linear in s, e^(−xs) is the weighted
    geometric mean of its end values, and no mean of two values exceeds the larger one. s itself exceeds the weighted
    geometric mean of its ends by at most Specht's ratio.
    """
    if ratio == 1.0:
        return 1.0
    return float((ratio - 1) * ratio ** (1 / (ratio - 1)) / (e * log(ratio)))
