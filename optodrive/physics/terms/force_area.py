"""Blocked force: gas at constant volume pushes on less than the whole aperture."""

from optodrive.core.types.arrays import FloatArray
from optodrive.physics.pixel import GAS_FRACTION
from optodrive.physics.term import StateView, Term, TermParameter, TermValues
from optodrive.physics.terms.gas_membrane import ATMOSPHERE_PA


class ForceArea(Term):
    """F = A P_atm ΔT / T₀ with ΔT = the gas's rise; share as in gas_membrane."""

    key = "force_area"
    cannot_add_heat = True
    parameters = (
        TermParameter("area", "m^2", 1e-6, 0.1e-6, 7.1e-6, "at most the aperture's 7.07 mm2"),
        TermParameter("share", "1", 0.33, 0.1, 0.5, "half at most, conduction both ways (Text S1)"),
    )

    def force_n(self, values: TermValues, view: StateView, force_n: FloatArray) -> FloatArray:
        """[p] N."""
        gas_k = values["share"] / GAS_FRACTION * view.rise_k["gas_k"]
        return values["area"] * ATMOSPHERE_PA * gas_k / view.ambient_k


TERM = ForceArea()
