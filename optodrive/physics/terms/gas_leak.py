"""Gas leaks out of the warm cell and back into the cold one."""

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.physics.term import GAS, Kernels, Term, TermParameter


@kernel
def rates(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: FloatArray) -> None:
    """What has leaked, as the rise that it undoes."""
    x[s] = v[0] * (y[GAS] - y[s])


@kernel
def membrane_drive(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
    """γ − m."""
    return float(x - y[s])


class GasLeak(Term):
    """What has leaked, as the rise that it undoes."""

    key = "gas_leak"
    parameters = (TermParameter("rate", "1/s", 1.0, 0.02, 20.0, "0.1 to 10 1/s"),)
    followers = ("leaked_k",)
    kernels = Kernels(rates=rates, membrane_drive=membrane_drive, force_drive=membrane_drive)
    cannot_add_heat = True
    signature = "long trains, undershoot on cooling"


TERM = GasLeak()
