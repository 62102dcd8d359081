"""Bridge conductivity: graphite conducts less heat when hot, so the bridge's resistance rises with temperature."""

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.physics.hypothesis import TermParameter
from optodrive.physics.term import ABSORBER, AMBIENT_K, FAR_END_K, Kernels, Term


@kernel
def bridge_resistance(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
    """Scale the resistance by (T / T₀)ⁿ with T the mean of the bridge's two ends."""
    mean_k = c[AMBIENT_K] + 0.5 * (y[ABSORBER] + c[FAR_END_K])
    return float(x * (mean_k / c[AMBIENT_K]) ** v[0])


class BridgeConductivity(Term):
    """R = R₀ (T / T₀)ⁿ with T the mean of absorber and wall and T₀ ambient, where n = 1 is k ~ 1/T (Text S2)."""

    key = "bridge_conductivity"
    label = "the bridges conduct less heat when hot"
    parameters = (TermParameter("exponent", "1", 0.5, 0.0, 1.3, "k_xy = 3.6e5 / T is 1 (Text S2)"),)
    kernels = Kernels(bridge_resistance=bridge_resistance)
    varies_between_runs = True
    signature = "plateaus at several powers"


TERM = BridgeConductivity()
