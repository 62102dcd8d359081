"""Term of the discovered functions: tabulated, of one quantity each, in up to four places of the pixel.

Theory of operation. A discovery ends in a formula. The pixel gets its values at equal distances over the range that the
data covered, and takes them linearly between these and constant beyond: so no formula is evaluated where nothing was
measured, kernels know one shape only, and its largest value, by which the limiter bounds it, is that of a knot.

Bound. With R the largest resistance of a bridge, f the function and θ the absorber's rise:
- light, a factor 1 + f on the power, or f(P) on top of it: the power is at most (1 + max f) or (1 + max f(P) / P) times
  the nominal one, and so is every rise.
- heat capacity C / (1 + f): warming is that of C under (1 + max f) times the power, since less flows off than
  (1 + f) θ / R; cooling is that of the largest capacity.
- heat flow f(θ) ≤ b θ into the absorber, or by the rise of a memory, which is never warmer than the absorber was: it
  raises the absorber by R b of its own largest rise at most, which is therefore at most 1 / (1 − R b) times that
  without the flow; so is the heat that reaches the wall. It does so later, with the time constant 1 / λ of the slowest
  mode of absorber and memory. With λ τ = 1 − 1 / g, there the memory is g times as warm as the absorber, and
  λ = (1 / R − b g) / C; without a memory g is 1.
  All three are rises over the wall: a flow that followed the wall's own rise would feed on that of the whole panel.
- heat flow by the rise of the gas: only one that is nowhere positive is bounded.
- gas: it is at most τ max f warmer, of which a finger feels the share that the touch surface takes.
- displacement and force heat nothing.
Factors of light multiply; functions of a heat capacity add up, and so do feedbacks b R and b R g: with fewer of them g
is only larger.
"""

from collections.abc import Sequence
from math import inf, sqrt
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from optodrive.core.kernels import kernel
from optodrive.core.toml_model import Section
from optodrive.core.types.arrays import FloatArray
from optodrive.physics.term import (
    ABSORBER,
    FAR_END_K,
    GAS,
    POWER_W,
    SINCE_EDGE_S,
    HeatGainBound,
    Kernels,
    OperatingEnvelope,
    Term,
    TermValues,
)

KEY = "discovered"
KNOTS = 65
MAX_SLOTS = 4
HEAD = 4
SLOT = HEAD + KNOTS
"""A slot's numbers: place, quantity, low end and distance of the knots; then the values."""
MEMORY_TIME = MAX_SLOTS * SLOT
"""Column of the memory's time constant, s, 0 without a memory."""
NOWHERE, LIGHT, HEAT_CAPACITY, HEAT_FLOW, GAS_RATE, DISPLACEMENT, FORCE = range(7)
OF_ABSORBER, OF_GAS, OF_MEMORY, OF_DRIVE, OF_POWER, OF_TIME = range(6)
PLACES = ("", "light", "heat_capacity", "absorber", "gas", "displacement", "force")
QUANTITIES = ("absorber", "gas", "memory", "drive", "power", "since_opening")
UNITS = {"light": "1", "heat_capacity": "1", "absorber": "W", "gas": "K/s", "displacement": "m", "force": "N"}
ALLOWED = {
    "light": ("absorber", "power", "since_opening"),
    "heat_capacity": ("absorber",),
    "absorber": ("absorber", "gas", "memory"),
    "gas": ("absorber", "gas", "memory", "drive"),
    "displacement": ("absorber", "gas", "drive"),
    "force": ("gas", "drive"),
}
"""Quantities that a term in each place can depend on."""
ADDED = ("absorber", "gas", "displacement", "force")
"""Places whose functions are added, and would act on a pixel without light."""
MIN_CAPACITY_SHARE = 0.1
"""Smallest 1 + f of a heat capacity C / (1 + f), below which the integrator's steps would be too long."""
MAX_FEEDBACK = 0.8
"""Largest R b g of a heat flow that the limiter bounds: heat then leaves an absorber five times as slowly."""
SHORTEST_S = 2.5e-3
"""Shortest time constant that the integrator's longest step resolves."""
NEGLIGIBLE = 1e-6


class DiscoveredTerm(Section):
    """One function that a parameter set adds to the pixel, and where.

    where: key of `UNITS`; depends_on: rises of absorber, gas or memory, K, over the wall for a heat flow, the drive of
    the gas, half the absorber's rise less the gas's, K, the incident power, W, or the time since the gate has opened,
    s; values: of the function at 65 equal distances from low to high, constant beyond; light: relative to the power, on
    the power itself in W; heat_capacity: f in C / (1 + f); memory_time_s: time constant with which the memory follows
    the absorber's rise over its wall
    """

    where: Literal["light", "heat_capacity", "absorber", "gas", "displacement", "force"]
    depends_on: Literal["absorber", "gas", "memory", "drive", "power", "since_opening"]
    unit: str
    formula: str
    low: float
    high: float
    values: tuple[float, ...]
    memory_time_s: Annotated[float, Field(gt=SHORTEST_S, le=10.0)] | None = None
    source: str

    @model_validator(mode="after")
    def _check(self) -> Self:
        unit = "W" if self.depends_on == "power" else UNITS[self.where]
        if len(self.values) != KNOTS:
            raise ValueError(f"{KNOTS} values, not {len(self.values)}")
        if self.depends_on not in ALLOWED[self.where]:
            raise ValueError(f"depends_on one of {', '.join(ALLOWED[self.where])} where the term is in {self.where}")
        if self.unit != unit:
            raise ValueError(f"unit {unit}, not '{self.unit}'")
        if not self.low < self.high:
            raise ValueError(f"low less than high, not {self.low:g} and {self.high:g}")
        if (self.memory_time_s is not None) != (self.depends_on == "memory"):
            raise ValueError("memory_time_s together with depends_on = 'memory', and only with it")
        at_zero = float(np.interp(0.0, np.linspace(self.low, self.high, KNOTS), self.values))
        if self.where in ADDED and abs(at_zero) > NEGLIGIBLE * max(map(abs, self.values)):
            raise ValueError(f"values that are 0 where {self.depends_on} is 0: a cold pixel stays cold")
        if self.where == "heat_capacity" and 1.0 + min(self.values) < MIN_CAPACITY_SHARE:
            raise ValueError(f"values above {MIN_CAPACITY_SHARE - 1.0:g}, of which a heat capacity is divided by 1 + f")
        return self

    def find_rate_per_s(self, c_j_per_k: float) -> float:
        """Return the largest rate at which the term alone moves the state that it depends on."""
        steepest = float(np.abs(np.diff(self.values)).max()) * (KNOTS - 1) / (self.high - self.low)
        if self.where == "absorber" and self.depends_on == "absorber":
            return steepest / c_j_per_k
        return steepest if self.where == "gas" and self.depends_on in ("gas", "drive") else 0.0


def list_values(terms: Sequence[DiscoveredTerm]) -> dict[str, float]:
    """Return the numbers of the term by the columns of its row that are not zero."""
    row = np.zeros(MEMORY_TIME + 1)
    for slot, term in enumerate(terms):
        head = (PLACES.index(term.where), QUANTITIES.index(term.depends_on), term.low)
        row[slot * SLOT : (slot + 1) * SLOT] = (*head, (term.high - term.low) / (KNOTS - 1), *term.values)
        row[MEMORY_TIME] = max(row[MEMORY_TIME], term.memory_time_s or 0.0)
    return {str(column): float(row[column]) for column in np.flatnonzero(row)}


@kernel
def _evaluate(v: FloatArray, slot: int, y: FloatArray, s: int, c: FloatArray) -> float:
    """Return the function of a slot at the present states."""
    quantity, wall_k = int(v[slot + 1]), c[FAR_END_K] if v[slot] == HEAT_FLOW else 0.0
    if quantity == OF_ABSORBER:
        z = y[ABSORBER] - wall_k
    elif quantity == OF_GAS:
        z = y[GAS] - wall_k
    elif quantity == OF_MEMORY:
        z = y[s]
    elif quantity == OF_DRIVE:
        z = 0.5 * y[ABSORBER] - y[GAS]
    elif quantity == OF_POWER:
        z = c[POWER_W]
    else:
        z = c[SINCE_EDGE_S]
    place = (z - v[slot + 2]) / v[slot + 3]
    if not place > 0.0:
        return float(v[slot + HEAD])
    if place >= KNOTS - 1.0:
        return float(v[slot + HEAD + KNOTS - 1])
    left = int(place)
    low, high = v[slot + HEAD + left], v[slot + HEAD + left + 1]
    return float(low + (place - left) * (high - low))


@kernel
def _add_all(v: FloatArray, place: int, y: FloatArray, s: int, c: FloatArray) -> float:
    """Return the sum of all functions in one place."""
    total = 0.0
    for number in range(MAX_SLOTS):
        if v[number * SLOT] == place:
            total += _evaluate(v, number * SLOT, y, s, c)
    return total


@kernel
def optical_power(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
    """Scale the power by 1 + f of a rise or the time, and add f of the power."""
    for number in range(MAX_SLOTS):
        if v[number * SLOT] == LIGHT:
            value = _evaluate(v, number * SLOT, y, s, c)
            x = x + value if v[number * SLOT + 1] == OF_POWER else x * (1.0 + value)
    return max(0.0, x)


@kernel
def heat_capacity(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
    """Return C / (1 + f)."""
    return float(x / (1.0 + _add_all(v, HEAT_CAPACITY, y, s, c)))


@kernel
def heat_loss(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
    """Reduce the heat loss by the flow into the absorber, W."""
    return float(x - _add_all(v, HEAT_FLOW, y, s, c))


@kernel
def rates(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: FloatArray) -> None:
    """Add to the gas's rate, and let the memory follow the absorber."""
    x[GAS] += _add_all(v, GAS_RATE, y, s, c)
    x[s] = (y[ABSORBER] - c[FAR_END_K] - y[s]) / v[MEMORY_TIME] if v[MEMORY_TIME] > 0.0 else 0.0


@kernel
def displacement(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
    """Add to the displacement, m."""
    return float(x + _add_all(v, DISPLACEMENT, y, s, c))


@kernel
def force(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
    """Add to the force, N."""
    return float(x + _add_all(v, FORCE, y, s, c))


class Discovered(Term):
    """Functions that a discovery found in a recording, the `[[discovered]]` tables of a parameter set."""

    key = KEY
    label = "a term that was discovered"
    followers = ("memory_k",)
    row_length = MEMORY_TIME + 1
    is_fast = True
    kernels = Kernels(
        optical_power=optical_power,
        heat_capacity=heat_capacity,
        heat_loss=heat_loss,
        rates=rates,
        displacement=displacement,
        force=force,
    )

    def pack(self, values: TermValues) -> FloatArray:
        """Return the row, zero in every column without a number."""
        row = np.zeros(self.row_length)
        for column, value in values.items():
            row[int(column)] = value
        return row

    def bound_heat_gain(self, values: TermValues, envelope: OperatingEnvelope) -> HeatGainBound | None:
        """Return the bound of all functions together, see the theory of operation, or None if one of them has none."""
        row = self.pack(values)
        power = fastest = slowest = 1.0
        rise_k = feedback = late_feedback = 0.0
        slots = [row[slot * SLOT : (slot + 1) * SLOT] for slot in range(MAX_SLOTS)]
        for slot in sorted(slots, key=lambda slot: slot[0]):  # heat capacities before heat flows
            place, quantity = int(slot[0]), int(slot[1])
            highest, lowest = max(0.0, float(slot[HEAD:].max())), min(0.0, float(slot[HEAD:].min()))
            ratio = _find_largest_ratio(slot) if place in (LIGHT, HEAT_FLOW) else 0.0
            if place == LIGHT and quantity != OF_POWER:
                power *= 1.0 + highest
            elif place == LIGHT:
                power *= 1.0 + ratio
            elif place == HEAT_CAPACITY:
                fastest, slowest = fastest + highest, slowest + lowest
            elif place == HEAT_FLOW and highest > 0.0:
                own = inf if quantity == OF_GAS else ratio * envelope.r_k_per_w
                feedback += own
                if quantity == OF_MEMORY and own < inf:
                    absorber_s = envelope.r_k_per_w * envelope.c_j_per_k / fastest
                    own *= _find_memory_share(own, float(row[MEMORY_TIME]) / absorber_s)
                late_feedback += own
            elif place == GAS_RATE:
                rise_k += envelope.gas_share * envelope.tau_g_s * highest
        if not power < inf or late_feedback > MAX_FEEDBACK or slowest < MIN_CAPACITY_SHARE:
            return None
        return HeatGainBound(
            power * fastest / (1.0 - feedback), 1.0 / slowest, 1.0 / (1.0 - late_feedback), uniform_rise_k=rise_k
        )


def _find_largest_ratio(slot: FloatArray) -> float:
    """Return the largest f(z) / z of a function for z > 0, at least 0, infinite if it is positive at 0.

    Between knots the ratio is monotone, and beyond the last one it falls.
    """
    z, values = slot[2] + slot[3] * np.arange(KNOTS), slot[HEAD:]
    if float(np.interp(0.0, z, values)) > NEGLIGIBLE * float(np.abs(values).max()):
        return inf
    positive = z > 0.0
    return max(0.0, float((values[positive] / z[positive]).max())) if positive.any() else 0.0


def _find_memory_share(feedback: float, ratio: float) -> float:
    """Return how warm the memory is beside the absorber in the slowest mode of both, 1 or more.

    feedback: b R; ratio: the memory's time constant over R C. With g = 1 / (1 − λ τ) and λ τ = ratio (1 − b R g), g
    solves b R ratio g² + (1 − ratio) g − 1 = 0.
    """
    slope = 1.0 - ratio
    return 2.0 / (slope + sqrt(slope**2 + 4.0 * feedback * ratio))
