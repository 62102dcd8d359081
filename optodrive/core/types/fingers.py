"""Places of fingertips on the display, as a tracker sees them."""

from typing import NamedTuple


class FingerPlace(NamedTuple):
    """A fingertip.

    number: the same for one fingertip as long as it is tracked; x_m, y_m: centre of its contact in the coordinates of
    the display's layout; radius_m: of the contact
    """

    number: int
    x_m: float
    y_m: float
    radius_m: float


class FingerReport(NamedTuple):
    """All fingertips on the display at a time.

    at_s: of their measurement, on a clock that its source states
    """

    at_s: float
    places: tuple[FingerPlace, ...]
