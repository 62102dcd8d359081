"""The wall rises with the absorbers beside it."""

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.physics.term import NEIGHBOUR, HeatGainBound, Kernels, OperatingEnvelope, Term, TermParameter, TermValues


@kernel
def rates(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: FloatArray) -> None:
    """The share arrives after a lag."""
    x[s] = (v[0] * y[NEIGHBOUR] - y[s]) / v[1]


@kernel
def wall_rise(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
    """Rise of the bridge's far end, K."""
    return float(x + y[s])


class NeighbourCrosstalk(Term):
    """The share arrives after a lag."""

    key = "neighbour_crosstalk"
    parameters = (
        TermParameter("share", "1", 0.02, 0.0, 0.15, "a wall's rise over its neighbour's rise, 0.002 to 0.1"),
        TermParameter("lag", "s", 0.02, 2.5e-3, 1.0, "conduction through one cell's wall"),
    )
    followers = ("crosstalk_k",)
    kernels = Kernels(rates=rates, wall_rise=wall_rise)
    signature = "runs in which only a neighbour is lit"

    def bound_heat_gain(self, values: TermValues, envelope: OperatingEnvelope) -> HeatGainBound:
        """All the heat that one beam leaves on a display, beside this very pixel."""
        return HeatGainBound(uniform_rise_k=values["share"] * envelope.summed_absorbers_k)


TERM = NeighbourCrosstalk()
