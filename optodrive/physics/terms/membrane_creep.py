"""Membrane creep: silicone creeps, so the membrane keeps rising under constant pressure."""

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.physics.hypothesis import TermParameter
from optodrive.physics.term import GAS, Kernels, Term

MIN_TIME_S = 2.5e-3
"""Shortest time constant; anything faster than the gas is not creep."""


@kernel
def rates(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: FloatArray) -> None:
    """Let three creep states follow the gas with time constants that are `spread` apart."""
    x[s] = (y[GAS] - y[s]) / max(MIN_TIME_S, v[1] / v[2])
    x[s + 1] = (y[GAS] - y[s + 1]) / max(MIN_TIME_S, v[1])
    x[s + 2] = (y[GAS] - y[s + 2]) / max(MIN_TIME_S, v[1] * v[2])


@kernel
def membrane_drive(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
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
    kernels = Kernels(rates=rates, membrane_drive=membrane_drive)
    cannot_add_heat = True
    signature = "lags and tails of the displacement, but not in temperature"


TERM = MembraneCreep()
