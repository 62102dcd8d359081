"""Terms of gas and membrane, between the rise of the gas and the height or force under a finger.

- Gas and membrane: the gas expands under a membrane that stiffens as it rises.
- Force area: the blocked gas pushes on less than the whole aperture, at constant volume.
- Gas leak: gas leaves the hot cell and returns to the cold one.
- Membrane creep: silicone creeps, so the membrane keeps rising under constant pressure.
- Membrane stiffening: a stretched membrane resists more, so displacement grows more slowly than the gas's rise.
"""

from math import pi

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.physics.hypothesis import TermParameter
from optodrive.physics.paper_facts import load_paper_facts
from optodrive.physics.pixel import GAS_FRACTION
from optodrive.physics.term import AMBIENT_K, GAS, MEMBRANE_DRIVE_K, Kernels, Term

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
def gas_membrane_displacement(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
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
    kernels = Kernels(displacement=gas_membrane_displacement)
    cannot_add_heat = True


@kernel
def force_area_force(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
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
    kernels = Kernels(force=force_area_force)
    cannot_add_heat = True


@kernel
def gas_leak_rates(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: FloatArray) -> None:
    """Let the leaked amount follow the gas's rise at the leak rate."""
    x[s] = v[0] * (y[GAS] - y[s])


@kernel
def gas_leak_drive(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
    """Subtract the leaked amount from the gas's rise, K."""
    return float(x - y[s])


class GasLeak(Term):
    """dm/dt = rate · (γ − m), with m the leaked amount as the gas rise γ that it cancels."""

    key = "gas_leak"
    label = "gas leaks out of the warm cell"
    parameters = (TermParameter("rate", "1/s", 1.0, 1e-3, 20.0, "0.1 to 10 1/s", starts=(0.3, 2.0, 8.0)),)
    followers = ("leaked_k",)
    kernels = Kernels(rates=gas_leak_rates, membrane_drive=gas_leak_drive, force_drive=gas_leak_drive)
    cannot_add_heat = True
    signature = "long trains, undershoot on cooling"


MIN_CREEP_S = 2.5e-3
"""Shortest time constant; anything faster than the gas is not creep."""


@kernel
def membrane_creep_rates(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: FloatArray) -> None:
    """Let three creep states follow the gas with time constants that are `spread` apart."""
    x[s] = (y[GAS] - y[s]) / max(MIN_CREEP_S, v[1] / v[2])
    x[s + 1] = (y[GAS] - y[s + 1]) / max(MIN_CREEP_S, v[1])
    x[s + 2] = (y[GAS] - y[s + 2]) / max(MIN_CREEP_S, v[1] * v[2])


@kernel
def membrane_creep_membrane_drive(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
    """Add share · mean of the three creep states, K."""
    return float(x + v[0] * (y[s] + y[s + 1] + y[s + 2]) / 3.0)


class MembraneCreep(Term):
    """γ + share · (q₁ + q₂ + q₃)/3, with qᵢ following the gas rise γ in time / spread, time and time · spread."""

    key = "membrane_creep"
    label = "the membrane creeps"
    parameters = (
        TermParameter("share", "1", 0.1, 0.0, 1.0, "creep compliance over the instantaneous one, 0.03 to 0.5"),
        TermParameter("time", "s", 0.1, 3e-3, 3.0, "10 ms to 1 s", starts=(0.012, 0.05, 0.25, 1.0)),
        TermParameter(
            "spread",
            "1",
            1.5,
            1.0,
            30.0,
            "third time over second, second over first: silicone creeps over decades",
            is_shape=True,
        ),
    )
    followers = ("crept_soon_k", "crept_k", "crept_late_k")
    kernels = Kernels(rates=membrane_creep_rates, membrane_drive=membrane_creep_membrane_drive)
    cannot_add_heat = True
    signature = "lags and tails of the displacement, but not in temperature"


@kernel
def membrane_stiffening_membrane_drive(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
    """Return γ / (1 + (curvature · γ)ᵒ)^(1/o), K, with o the order: 1 bends early, 3 late."""
    return float(x / (1.0 + (v[0] * max(1e-9, x)) ** v[1]) ** (1.0 / v[1]))


class MembraneStiffening(Term):
    """γ / (1 + (curvature · γ)ᵒ)^(1/o): between a plate and a stretched membrane, for any material."""

    key = "membrane_stiffening"
    label = "the membrane stiffens as it rises"
    parameters = (
        TermParameter("curvature", "1/K", 2e-3, 1e-6, 5e-2, "from a plate to a stretched membrane within the stroke"),
        TermParameter(
            "order", "1", 1.5, 0.7, 4.0, "2 for a cubic balance at small displacement", (1.0, 2.0), is_shape=True
        ),
    )
    kernels = Kernels(membrane_drive=membrane_stiffening_membrane_drive)
    cannot_add_heat = True
    signature = "displacement peaks against power, with linear force"
