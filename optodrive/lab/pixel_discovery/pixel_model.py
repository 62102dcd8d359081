"""The nominal pixel as a simulation that a discovery extends, and where a term may enter it.

Theory of operation. States are the rises of absorber and gas, and one hidden state, the memory: what follows the
absorber with a time constant of its own. Nothing depends on it unless a term does, as where heat flows into a further
part. The light of a pulse is held between gate edges. A term may depend on the quantities that physics offers: a
temperature, the rate at which the absorber warms (a heat capacity multiplies it), the difference that drives the gas,
the light, and the time since the gate has opened or closed. Only places that mean something are tried: every further
one is a further chance of a false discovery.
"""

from collections.abc import Sequence
from typing import Any

from optodrive.lab.discovery import OdeModel, Parameter
from optodrive.lab.discovery.memory import DAHL, DELAY, FOLLOWER, LAG, OSCILLATION, SLIP

TEMPERATURE, DISPLACEMENT, FORCE = OUTPUTS = ("temperature", "displacement", "force")
"""Outputs in the order of the signals' kinds: rise of the absorber, K; m; N."""
LIGHT, AFTER, ON_S, OFF_S = INPUTS = ("light", "after", "on_s", "off_s")
"""Absorbed light, W; that of the last pulse while the gate is closed, W; times of the last opening and closing, s."""
MEMORY_S = (0.03, 5e-3, 0.3)
"""Time constant of the memory: start, low, high; what is slower is a wall."""
RANGE = 4.0
"""Largest factor between a fitted parameter and its start."""
ABSORBER_PLACES = (
    ("absorber", ""),
    ("absorber", "heating"),
    ("absorber", "light"),
    ("gas", ""),
    ("memory", ""),
    ("light", ""),
    ("since_opening", "light"),
    ("since_closing", "after"),
)
GAS_PLACES = (("drive", ""), ("gas", ""), ("absorber", ""), ("memory", ""))
OUTPUT_PLACES = {
    TEMPERATURE: (("absorber", ""), ("heating", ""), ("light", ""), ("t", "")),
    DISPLACEMENT: (("gas", ""), ("drive", ""), ("absorber", ""), ("light", ""), ("t", "")),
    FORCE: (("gas", ""), ("drive", ""), ("light", ""), ("t", "")),
}
OF_MEMBRANE, OF_METER = (LAG, DAHL, SLIP, DELAY, OSCILLATION), (FOLLOWER, DELAY)
MEMORIES = {DISPLACEMENT: ("gas", OF_MEMBRANE), FORCE: ("gas", OF_MEMBRANE), TEMPERATURE: ("absorber", OF_METER)}
"""What a signal may remember: membranes creep, slip, ring and are late, thermometers lag or are late."""


def compute_rates(t: Any, state: Any, u: Any, p: Any) -> Sequence[Any]:
    """Return the rates of absorber, gas and memory, K/s."""
    absorber, gas, memory = state
    return [(u[0] - absorber / p.R) / p.C, (0.5 * absorber - gas) / p.tau_g, (absorber - memory) / p.tau_m]


def compute_signals(state: Any, u: Any, p: Any) -> Sequence[Any]:
    """Return the rise of the absorber, K, the displacement, m, and the force, N."""
    return [state[0], p.kappa * state[1], p.phi * state[1]]


def compute_quantities(t: Any, state: Any, u: Any, p: Any) -> Sequence[Any]:
    """Return the nominal rate of the absorber, K/s, the gas's drive, K, and the times since the gate's edges, s."""
    return [
        (u[0] - state[0] / p.R) / p.C,
        0.5 * state[0] - state[1],
        (t - u[2]) * (u[0] > 0.0),
        (t - u[3]) * (u[1] > 0.0),
    ]


def start_cold(first: Any, p: Any) -> Sequence[float]:
    """Return the states of a pixel at rest."""
    return [0.0, 0.0, 0.0]


def build_model(base: Sequence[float], measured: Sequence[str]) -> OdeModel:
    """Return the model of a pixel.

    base: R, C, τ_g, κ and φ of the nominal fit, SI; measured: outputs that were recorded
    """
    names = ("R", "C", "tau_g", "kappa", "phi")
    parameters = {
        name: Parameter(value, value / RANGE, value * RANGE) for name, value in zip(names, base, strict=True)
    } | {"tau_m": Parameter(*MEMORY_S)}
    places = [("dabsorber/dt", *place) for place in ABSORBER_PLACES] + [("dgas/dt", *place) for place in GAS_PLACES]
    places += [(output, *place) for output in OUTPUTS if output in measured for place in OUTPUT_PLACES[output]]
    memories = [(output, *MEMORIES[output]) for output in OUTPUTS if output in measured]
    return OdeModel(
        states=("absorber", "gas", "memory"),
        inputs=INPUTS,
        outputs=OUTPUTS,
        parameters=parameters,
        rhs=compute_rates,
        output=compute_signals,
        initial=start_cold,
        quantities=("heating", "drive", "since_opening", "since_closing"),
        quantity=compute_quantities,
        places=tuple(places),
        memories=(*memories, ("dgas/dt", "gas", (FOLLOWER,))),
        followers=("memory",),
        from_rest=True,
    )
