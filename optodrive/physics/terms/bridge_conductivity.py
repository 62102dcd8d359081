"""Graphite conducts worse when hot: the bridge's resistance grows with its mean temperature."""

from optodrive.flow import FloatArray
from optodrive.physics.term import Term, TermParameter, Values, View


class BridgeConductivity(Term):
    """R = R₀ (T / T₀)ⁿ with T the mean of absorber and wall; n = 1 is k ~ 1/T (Text S2)."""

    key = "bridge_conductivity"
    parameters = (TermParameter("exponent", "1", 0.0, 1.3, "k_xy = 3.6e5 / T is 1 (Text S2)"),)

    def bridge_k_per_w(self, values: Values, view: View, r_k_per_w: FloatArray) -> FloatArray:
        """[p] K/W."""
        mean_k = view.ambient_k + 0.5 * (view.rise_k["absorber_k"] + view.wall_k())
        return r_k_per_w * (mean_k / view.ambient_k) ** values["exponent"]


TERM = BridgeConductivity()
