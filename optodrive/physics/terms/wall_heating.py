"""Heating of the wall at the bridge's far end, which cools slowly to its surroundings."""

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.physics.hypothesis import TermParameter
from optodrive.physics.term import BRIDGE_FLOW_W, WALL, Kernels, Term, TermValues

SHORTEST_S = 0.1
"""Shortest time constant of a wall. What follows the absorber faster is another part of the pixel, and no wall."""


@kernel
def rates(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: FloatArray) -> None:
    """Heat the wall by the bridge's flow and cool it to its surroundings, in no less than SHORTEST_S."""
    x[WALL] = (c[BRIDGE_FLOW_W] - y[WALL] / v[0]) / max(v[1], SHORTEST_S / v[0])


def compute_capacity(values: TermValues) -> float:
    """Return the heat capacity that gives a wall no shorter time constant than SHORTEST_S, J/K."""
    return max(values["capacity"], SHORTEST_S / values["resistance"])


class WallHeating(Term):
    """C dw/dt = bridge flow − w / R, with R C of 0.1 s or more. Bridge and gas see the wall's rise w."""

    key = "wall_heating"
    label = "the walls heat up"
    parameters = (
        TermParameter(
            "resistance",
            "K/W",
            20.0,
            0.05,
            40.0,
            "a cell of the laminate to its surroundings, by its materials",
            starts=(8.0,),
        ),
        TermParameter(
            "capacity", "J/K", 0.06, 2.5e-3, 200.0, "0.1 to 10 s with the resistance", starts=(0.02, 0.08, 0.3, 1.0)
        ),
    )
    states = (WALL,)
    kernels = Kernels(rates=rates)
    signature = "trains of several seconds and the slow tail after them"


TERM = WallHeating()
