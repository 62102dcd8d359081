"""The wall at the bridge's far end is no sink: it warms, and cools to its surroundings more slowly."""

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.physics.term import BRIDGE_FLOW_W, WALL, HeatFlows, Kernels, StateView, Term, TermParameter, TermValues


@kernel
def rates(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: FloatArray) -> None:
    """C dw/dt = flow − w / R."""
    x[WALL] = (c[BRIDGE_FLOW_W] - y[WALL] / v[0]) / v[1]


class WallHeating(Term):
    """C dw/dt = what the bridge brings − w / R; the bridge and the gas feel the wall's rise."""

    key = "wall_heating"
    parameters = (
        TermParameter(
            "resistance", "K/W", 20.0, 1.0, 40.0, "a cell of the laminate to its surroundings, by its materials"
        ),
        TermParameter("capacity", "J/K", 0.06, 2.5e-3, 10.0, "0.1 to 10 s with the resistance"),
    )
    heat_nodes = {"wall_k": "capacity"}  # noqa: RUF012 - a Mapping, never written to

    kernels = Kernels(rates=rates)
    signature = "trains of seconds, then the slow tail"

    def add_flows(self, values: TermValues, view: StateView, flows: HeatFlows) -> None:
        """Wall to ambient."""
        flows.add_flow("wall_k", None, view.rise_k["wall_k"] / values["resistance"])


TERM = WallHeating()
