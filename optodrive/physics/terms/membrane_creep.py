"""Silicone creeps: the membrane goes on rising under the same pressure."""

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.physics.term import GAS, Kernels, Term, TermParameter

MIN_TIME_S = 2.5e-3
"""Quicker than the gas it is no creep."""


@kernel
def rates(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: FloatArray) -> None:
    """Follows the gas."""
    x[s] = (y[GAS] - y[s]) / max(MIN_TIME_S, v[1] / v[2])
    x[s + 1] = (y[GAS] - y[s + 1]) / max(MIN_TIME_S, v[1])
    x[s + 2] = (y[GAS] - y[s + 2]) / max(MIN_TIME_S, v[1] * v[2])


@kernel
def membrane_drive(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
    """γ + share × mean q."""
    return float(x + v[0] * (y[s] + y[s + 1] + y[s + 2]) / 3.0)


class MembraneCreep(Term):
    """Follows the gas."""

    key = "membrane_creep"
    parameters = (
        TermParameter("share", "1", 0.1, 0.0, 1.0, "creep compliance over the instantaneous one, 0.03 to 0.5"),
        TermParameter("time", "s", 0.1, 3e-3, 3.0, "10 ms to 1 s"),
        TermParameter(
            "spread", "1", 1.5, 1.0, 30.0, "third time over second, second over first: silicone creeps over decades"
        ),
    )
    followers = ("crept_soon_k", "crept_k", "crept_late_k")
    kernels = Kernels(rates=rates, membrane_drive=membrane_drive)
    cannot_add_heat = True
    signature = "displacement lags and tails, temperature clean"


TERM = MembraneCreep()
