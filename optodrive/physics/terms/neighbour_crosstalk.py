"""Neighbour crosstalk: the wall warms with the neighbouring absorbers."""

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.physics.hypothesis import Hypothesis, RecordingScope, TermParameter
from optodrive.physics.term import NEIGHBOUR, HeatGainBound, Kernels, OperatingEnvelope, Term, TermValues, add_follower


@kernel
def rates(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: FloatArray) -> None:
    """Let the wall follow a share of the neighbour's rise with a first-order lag."""
    x[s] = (v[0] * y[NEIGHBOUR] - y[s]) / v[1]


class NeighbourCrosstalk(Term):
    """lag · dn/dt = share · θ_neighbour − n, with n the rise of the bridge's far end."""

    key = "neighbour_crosstalk"
    label = "pixels heat their neighbours"
    parameters = (
        TermParameter("share", "1", 0.02, 0.0, 0.15, "a wall's rise over its neighbour's rise, 0.002 to 0.1"),
        TermParameter("lag", "s", 0.02, 2.5e-3, 1.0, "conduction through one cell's wall", starts=(0.003, 0.03, 0.2)),
    )
    followers = ("crosstalk_k",)
    kernels = Kernels(rates=rates, wall_rise=add_follower)
    couples_neighbours = True
    signature = "runs in which only a neighbour is illuminated"

    def bound_heat_gain(self, values: TermValues, envelope: OperatingEnvelope) -> HeatGainBound:
        """Return a rise of everything as if all heat of the display were next to every pixel."""
        return HeatGainBound(uniform_rise_k=values["share"] * envelope.summed_absorbers_k)

    def build_hypotheses(self, scope: RecordingScope) -> list[Hypothesis]:
        """Return the default hypothesis if the recording has pulses on neighbours of a measured pixel."""
        return super().build_hypotheses(scope) if scope.has_neighbour_pulses else []


TERM = NeighbourCrosstalk()
