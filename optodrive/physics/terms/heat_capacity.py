"""Heat capacity of graphite that increases from 0.71 to 1.12 J/(g K) between 300 and 450 K."""

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.physics.hypothesis import TermParameter
from optodrive.physics.term import ABSORBER, HeatGainBound, Kernels, OperatingEnvelope, Term, TermValues


@kernel
def heat_capacity(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
    """Scale the absorber's heat capacity by 1 + slope · θ."""
    return float(x * (1.0 + v[0] * y[ABSORBER]))


class HeatCapacity(Term):
    """C = C₀ (1 + slope · θ), J/K."""

    key = "heat_capacity"
    label = "the absorber stores more heat when hot"
    parameters = (
        TermParameter(
            "slope",
            "1/K",
            2e-3,
            0.0,
            4e-3,
            "c_p of graphite, 300 to 450 K: 3.9e-3; lower if other material shares the heat",
        ),
    )
    kernels = Kernels(heat_capacity=heat_capacity)
    signature = "initial slopes at several powers, with unchanged plateaus"

    def bound_heat_gain(self, values: TermValues, envelope: OperatingEnvelope) -> HeatGainBound:
        """Return the capacity of the hottest absorber over C₀. The capacity is never below C₀."""
        return HeatGainBound(capacity_factor=1.0 + values["slope"] * envelope.absorber_k)


TERM = HeatCapacity()
