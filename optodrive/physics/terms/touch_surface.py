"""The membrane's outer side, where the finger is: it follows the gas below and the wall around it."""

from optodrive.core.types.arrays import FloatArray
from optodrive.physics.term import StateView, Term, TermParameter, TermValues


class TouchSurface(Term):
    """lag · ds/dt = gas_share · γ + wall_share · w − s."""

    key = "touch_surface"
    parameters = (
        TermParameter("gas_share", "1", 0.3, 0.05, 0.6, "conduction through gas, membrane and finger in series"),
        TermParameter("wall_share", "1", 0.4, 0.1, 0.6, "conduction in the membrane to its rim"),
        TermParameter("lag", "s", 1.2, 0.3, 5.0, "heat capacity of the membrane over those conductances"),
    )
    followers = ("touch_k",)

    def rates_k_per_s(self, values: TermValues, view: StateView) -> dict[str, FloatArray]:
        """K/s."""
        drive_k = values["gas_share"] * view.rise_k["gas_k"] + values["wall_share"] * view.wall_k()
        return {"touch_k": (drive_k - view.rise_k["touch_k"]) / values["lag"]}


TERM = TouchSurface()
