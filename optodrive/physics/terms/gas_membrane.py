"""Gas that makes room for itself under a membrane that stiffens: V grows with z, z with the pressure left."""

from math import pi

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.physics.paper_facts import load_paper_facts
from optodrive.physics.pixel import GAS_FRACTION
from optodrive.physics.term import StateView, Term, TermParameter, TermValues

ATMOSPHERE_PA = 101_325.0
BISECTION_STEPS = 60


class GasMembrane(Term):
    """P(z) = P_atm (T/T₀ · V₀/(V₀ + ½πr²z) − 1), held by a clamped plate that becomes a stretched membrane.

    The plate's 16Eh³z / 3(1−ν²)r⁴ (Text S1 with 3/16) and the spherical cap's 8Ehz³ / 3(1−ν)r⁴ (bulge test; Small and
    Nix, J. Mater. Res. 7, 1553, 1992) add up. E, ν, h, r: Table S4 and Display fabrication.
    share: the gas's steady rise over the absorber's.
    """

    key = "gas_membrane"
    cannot_add_heat = True
    parameters = (
        TermParameter("share", "1", 0.33, 0.1, 0.5, "half at most, conduction both ways (Text S1)"),
        TermParameter("volume", "m^3", 7.8e-9, 6.0e-9, 9.0e-9, "7.1 to 7.8 uL (Text S3, Display fabrication)"),
    )

    def displacement_m(self, values: TermValues, view: StateView, displacement_m: FloatArray) -> FloatArray:
        """[p] m; found by bisection, exact to rounding."""
        warmer = values["share"] / GAS_FRACTION * view.rise_k["gas_k"] / view.ambient_k
        facts = load_paper_facts()
        e_pa, nu = facts["membrane_E"].value, facts["membrane_nu"].value
        h_m, r_m = facts["membrane_h"].value, facts["cavity_r"].value
        plate = 16 * e_pa * h_m**3 / (3 * (1 - nu**2) * r_m**4)
        cap = 8 * e_pa * h_m / (3 * (1 - nu) * r_m**4)
        swept_m2 = 0.5 * pi * r_m**2
        # At no pressure the gas has swollen as far as it can: z lies between rest and there.
        low_m, high_m = np.zeros_like(warmer), warmer * values["volume"] / swept_m2
        for _ in range(BISECTION_STEPS):
            z_m = 0.5 * (low_m + high_m)
            gas_pa = ATMOSPHERE_PA * ((1 + warmer) / (1 + swept_m2 * z_m / values["volume"]) - 1)
            rises = (gas_pa > plate * z_m + cap * z_m**3) == (warmer > 0)
            low_m, high_m = np.where(rises, z_m, low_m), np.where(rises, high_m, z_m)
        return 0.5 * (low_m + high_m)


TERM = GasMembrane()
