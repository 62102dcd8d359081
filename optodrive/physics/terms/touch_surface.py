"""Touch surface: the membrane's outer side, where the finger is, follows the gas below and the wall around it."""

from optodrive.physics.hypothesis import TermParameter
from optodrive.physics.term import Term


class TouchSurface(Term):
    """lag · ds/dt = p + gas_share · (γ − p) + wall_share · (w − p) − s, with p the panel's rise.

    The limiter's bound on heat accounts for it; neither displacement nor any recorded signal depends on it.
    """

    key = "touch_surface"
    label = "the touch surface warms"
    parameters = (
        TermParameter("gas_share", "1", 0.3, 0.05, 0.6, "conduction through gas, membrane and finger in series"),
        TermParameter("wall_share", "1", 0.4, 0.1, 0.6, "conduction in the membrane to its rim"),
        TermParameter("lag", "s", 1.2, 0.3, 5.0, "heat capacity of the membrane over those conductances"),
    )
    in_pixel = False


TERM = TouchSurface()
