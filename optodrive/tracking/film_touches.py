"""Touches at known pixels, of which the calibration of a film is made."""

from collections.abc import Iterable, Iterator

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.device.config import PixelLayout
from optodrive.tracking.contacts import Contact, ContactReport

TOUCH_MIN_S = 0.2
"""Shortest time of a touch. A shorter contact is the brush of a hand."""


def choose_corner_pixels(layout: PixelLayout) -> tuple[int, ...]:
    """Return the pixels nearest to the corners of a display, around it: one that is nearest to two, once."""
    x_m, y_m = layout.x_m, layout.y_m
    corners_m = [(x_m.min(), y_m.min()), (x_m.max(), y_m.min()), (x_m.max(), y_m.max()), (x_m.min(), y_m.max())]
    nearest = (int(np.hypot(x_m - corner[0], y_m - corner[1]).argmin()) for corner in corners_m)
    return tuple(dict.fromkeys(nearest))


def iterate_touches(reports: Iterable[ContactReport]) -> Iterator[FloatArray]:
    """Yield the middle [2] of every touch on a film when it ends, in units of the film.

    A touch is one contact from its begin to its end, of TOUCH_MIN_S or more, with no other beside it.
    """
    touch: list[tuple[float, Contact]] = []
    is_alone = True
    for report in reports:
        if touch and touch[0][1].number not in {contact.number for contact in report.contacts}:
            if is_alone and report.at_s - touch[0][0] >= TOUCH_MIN_S:
                yield np.median([contact[1:] for _, contact in touch], axis=0)
            touch, is_alone = [], True
        if report.contacts:
            is_alone = is_alone and len(report.contacts) == 1
            touch.append((report.at_s, report.contacts[0]))
