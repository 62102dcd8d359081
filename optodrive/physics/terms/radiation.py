"""Radiation: the hot absorber radiates to the room."""

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.physics.hypothesis import TermParameter
from optodrive.physics.term import ABSORBER, AMBIENT_K, Kernels, Term

STEFAN_BOLTZMANN = 5.670374e-8
"""W/(m² K⁴)."""


@kernel
def heat_loss(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
    """Add the radiated power, W."""
    warm_k = c[AMBIENT_K] + y[ABSORBER]
    return float(x + v[0] * STEFAN_BOLTZMANN * (warm_k**4 - c[AMBIENT_K] ** 4))


class Radiation(Term):
    """εA σ (T⁴ − T₀⁴), W, from the absorber to ambient."""

    key = "radiation"
    label = "the hot absorber radiates"
    parameters = (
        TermParameter(
            "emitting_area",
            "m^2",
            4e-6,
            1e-8,
            2e-5,
            "both faces of a 2 mm x 1.5 mm absorber and its bridges, emissivity 0.5 to 0.9",
        ),
    )
    kernels = Kernels(heat_loss=heat_loss)
    varies_between_runs = True
    cannot_add_heat = True
    signature = "hot pixels with narrow bridges, whose cooling slows down"


TERM = Radiation()
