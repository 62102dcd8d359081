"""Force area: the blocked gas pushes on less than the whole aperture, at constant volume."""

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.physics.hypothesis import TermParameter
from optodrive.physics.pixel import GAS_FRACTION
from optodrive.physics.term import AMBIENT_K, GAS, Kernels, Term
from optodrive.physics.terms.gas_membrane import ATMOSPHERE_PA


@kernel
def force(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
    """Replace the force by that of an ideal gas at constant volume, N."""
    return float(v[0] * ATMOSPHERE_PA * v[1] / GAS_FRACTION * y[GAS] / c[AMBIENT_K])


class ForceArea(Term):
    """F = A P_atm ΔT / T₀ with ΔT the gas's rise, and share the steady rise of the gas over the absorber's."""

    key = "force_area"
    label = "the blocked force acts on less than the whole aperture"
    parameters = (
        TermParameter("area", "m^2", 1e-6, 0.1e-6, 7.1e-6, "at most the aperture's 7.07 mm2"),
        TermParameter("share", "1", 0.33, 0.1, 0.5, "at most half, because heat is conducted both ways (Text S1)"),
    )
    kernels = Kernels(force=force)
    cannot_add_heat = True


TERM = ForceArea()
