"""Gas and membrane: the gas expands under a membrane that stiffens as it rises."""

from math import pi

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.physics.hypothesis import TermParameter
from optodrive.physics.paper_facts import load_paper_facts
from optodrive.physics.pixel import GAS_FRACTION
from optodrive.physics.term import AMBIENT_K, MEMBRANE_DRIVE_K, Kernels, Term

ATMOSPHERE_PA = 101_325.0
BISECTION_STEPS = 60


def _load_membrane() -> tuple[float, float, float]:
    """Return the plate's Pa/m, the cap's Pa/m³ and the membrane's volume per height, m², from the paper's facts."""
    facts = load_paper_facts()
    e_pa, nu = facts["membrane_E"].value, facts["membrane_nu"].value
    h_m, r_m = facts["membrane_h"].value, facts["cavity_r"].value
    plate_pa_per_m = 16 * e_pa * h_m**3 / (3 * (1 - nu**2) * r_m**4)
    cap_pa_per_m3 = 8 * e_pa * h_m / (3 * (1 - nu) * r_m**4)
    return plate_pa_per_m, cap_pa_per_m3, 0.5 * pi * r_m**2


PLATE_PA_PER_M, CAP_PA_PER_M3, SWEPT_M2 = _load_membrane()


@kernel
def equilibrium_height_m(relative_rise: float, volume_m3: float) -> float:
    """Return the height at which membrane and gas are in equilibrium, m, by bisection to rounding.

    relative_rise: rise of the gas temperature over ambient temperature; volume_m3: of the cavity
    """
    # At zero pressure the gas has expanded as far as it can: the height lies between zero and that.
    low_m, high_m = 0.0, relative_rise * volume_m3 / SWEPT_M2
    for _ in range(BISECTION_STEPS):
        z_m = 0.5 * (low_m + high_m)
        gas_pa = ATMOSPHERE_PA * ((1.0 + relative_rise) / (1.0 + SWEPT_M2 * z_m / volume_m3) - 1.0)
        if (gas_pa > PLATE_PA_PER_M * z_m + CAP_PA_PER_M3 * z_m**3) == (relative_rise > 0.0):
            low_m = z_m
        else:
            high_m = z_m
    return 0.5 * (low_m + high_m)


@kernel
def displacement(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
    """Replace the displacement by the height at which membrane and gas are in equilibrium, m."""
    return equilibrium_height_m(v[0] / GAS_FRACTION * c[MEMBRANE_DRIVE_K] / c[AMBIENT_K], v[1])


class GasMembrane(Term):
    """P(z) = P_atm (T/T₀ · V₀/(V₀ + ½πr²z) − 1), held by a clamped plate that becomes a stretched membrane.

    The plate's 16Eh³z / 3(1−ν²)r⁴ (Text S1 with 3/16) and the spherical cap's 8Ehz³ / 3(1−ν)r⁴ (bulge test; Small and
    Nix, J. Mater. Res. 7, 1553, 1992) add up. E, ν, h, r: Table S4 and Display fabrication.
    share: steady rise of the gas over the absorber's.
    """

    key = "gas_membrane"
    label = "the gas expands under a membrane that stiffens"
    parameters = (
        TermParameter("share", "1", 0.33, 0.1, 0.5, "at most half, because heat is conducted both ways (Text S1)"),
        TermParameter("volume", "m^3", 7.8e-9, 6.0e-9, 9.0e-9, "7.1 to 7.8 uL (Text S3, Display fabrication)"),
    )
    kernels = Kernels(displacement=displacement)
    cannot_add_heat = True


TERM = GasMembrane()
