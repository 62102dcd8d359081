"""Lateral conduction: neighbouring walls exchange heat, and the frame cools the rim."""

from optodrive.physics.hypothesis import TermParameter
from optodrive.physics.term import Term


class LateralConduction(Term):
    """(w − w') / resistance between neighbours, w / frame_resistance at each edge on the frame.

    The limiter's bound on heat accounts for it; the pixels that heights are planned with are uncoupled.
    """

    key = "lateral_conduction"
    label = "neighbouring walls exchange heat"
    requires = ("wall_heating",)
    parameters = (
        TermParameter("resistance", "K/W", 430.0, 40.0, 10_000.0, "neighbours rise by 0.002 to 0.1 of a wall's rise"),
        TermParameter("frame_resistance", "K/W", 430.0, 40.0, 10_000.0, "as between neighbours"),
    )
    in_pixel = False


TERM = LateralConduction()
