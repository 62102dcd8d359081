"""Heating of the wall at the bridge's far end, which cools slowly to its surroundings."""

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.physics.hypothesis import TermParameter
from optodrive.physics.term import BRIDGE_FLOW_W, WALL, Kernels, Term


@kernel
def rates(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: FloatArray) -> None:
    """Heat the wall by the bridge's flow and cool it to its surroundings."""
    x[WALL] = (c[BRIDGE_FLOW_W] - y[WALL] / v[0]) / v[1]


class WallHeating(Term):
    """C dw/dt = bridge flow − w / R. Bridge and gas see the wall's rise w."""

    key = "wall_heating"
    label = "the walls heat up"
    parameters = (
        TermParameter(
            "resistance",
            "K/W",
            20.0,
            1.0,
            40.0,
            "a cell of the laminate to its surroundings, by its materials",
            starts=(8.0,),
        ),
        TermParameter(
            "capacity", "J/K", 0.06, 2.5e-3, 10.0, "0.1 to 10 s with the resistance", starts=(0.02, 0.08, 0.3, 1.0)
        ),
    )
    states = (WALL,)
    kernels = Kernels(rates=rates)
    signature = "trains of several seconds and the slow tail after them"


TERM = WallHeating()
