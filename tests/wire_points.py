"""Points for the link's tests, which no planner has made."""

import numpy as np

from optodrive.link.protocol.quantisation import CENTRE_CODE, WirePoints
from optodrive.link.protocol.stage_points import StagePoints


def build_points(count, duty, dark_us=2000, on_us=200):
    """Return points that light the centre of the field. duty: tells the points of one push from those of another."""
    table = np.array([(CENTRE_CODE, CENTRE_CODE, dark_us, on_us, duty)] * count, dtype=np.uint16).reshape(-1, 5)
    return WirePoints(table, np.arange(count))


def build_stage_points(count, duty, dark_us=2000, on_us=200):
    """Return the same points for the only stage."""
    return StagePoints((build_points(count, duty, dark_us, on_us),))
