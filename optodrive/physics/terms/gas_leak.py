"""Gas leak: gas leaves the hot cell and returns to the cold one."""

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.physics.hypothesis import TermParameter
from optodrive.physics.term import GAS, Kernels, Term


@kernel
def rates(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: FloatArray) -> None:
    """Let the leaked amount follow the gas's rise at the leak rate."""
    x[s] = v[0] * (y[GAS] - y[s])


@kernel
def gas_drive(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
    """Subtract the leaked amount from the gas's rise, K."""
    return float(x - y[s])


class GasLeak(Term):
    """dm/dt = rate · (γ − m), with m the leaked amount as the gas rise γ that it cancels."""

    key = "gas_leak"
    label = "gas leaks out of the warm cell"
    parameters = (TermParameter("rate", "1/s", 1.0, 1e-3, 20.0, "0.1 to 10 1/s", starts=(0.3, 2.0, 8.0)),)
    followers = ("leaked_k",)
    kernels = Kernels(rates=rates, membrane_drive=gas_drive, force_drive=gas_drive)
    cannot_add_heat = True
    signature = "long trains, undershoot on cooling"


TERM = GasLeak()
