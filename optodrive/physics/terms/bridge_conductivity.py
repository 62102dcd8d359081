"""Graphite conducts worse when hot: the bridge's resistance grows with its mean temperature."""

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.physics.term import ABSORBER, AMBIENT_K, FAR_END_K, Kernels, StateView, Term, TermParameter, TermValues


@kernel
def bridge_resistance(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
    """R = R₀ (T / T₀)ⁿ."""
    mean_k = c[AMBIENT_K] + 0.5 * (y[ABSORBER] + c[FAR_END_K])
    return float(x * (mean_k / c[AMBIENT_K]) ** v[0])


class BridgeConductivity(Term):
    """R = R₀ (T / T₀)ⁿ with T the mean of absorber and wall; n = 1 is k ~ 1/T (Text S2)."""

    key = "bridge_conductivity"
    parameters = (TermParameter("exponent", "1", 0.5, 0.0, 1.3, "k_xy = 3.6e5 / T is 1 (Text S2)"),)
    kernels = Kernels(bridge_resistance=bridge_resistance)
    varies_between_runs = True
    signature = "a ladder of powers held to the plateau"

    def bridge_k_per_w(self, values: TermValues, view: StateView, r_k_per_w: FloatArray) -> FloatArray:
        """[p] K/W."""
        mean_k = view.ambient_k + 0.5 * (view.rise_k["absorber_k"] + view.wall_k())
        return r_k_per_w * (mean_k / view.ambient_k) ** values["exponent"]


TERM = BridgeConductivity()
