"""Membrane stiffening: a stretched membrane resists more, so displacement grows more slowly than the gas's rise."""

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.physics.hypothesis import TermParameter
from optodrive.physics.term import Kernels, Term


@kernel
def membrane_drive(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
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
    kernels = Kernels(membrane_drive=membrane_drive)
    cannot_add_heat = True
    signature = "displacement peaks against power, with linear force"


TERM = MembraneStiffening()
