"""Term of the discovered functions: tabulated, of one quantity each, in up to four places of the pixel.

Theory of operation. A discovery ends in a formula. The pixel gets its values at equal distances over the range that the
data covered, and takes them linearly between these and constant beyond: so no formula is evaluated where nothing was
measured, kernels know one shape only, and no value anywhere, tails included, is larger or smaller than those of knots.

Range. What a function is beyond its ends nobody knows. A plan during which a pixel goes there is refused
(`check_reached`), by the states that heights are planned with, so that only what the bound adds ever meets a tail.

Bound. A file may hold any table, so nothing is assumed of one but what is computed from all of its knots
(`_find_extremes`) or refused. With R the largest resistance of a bridge, f the function, u the absorber's rise over its
wall and v the one that the limiter computes without the term, which never falls faster nor rises more slowly:
- light, a factor 1 + f on the power, or f(P) on top of it: the power is at most (1 + max f) or (1 + max f(P) / P)
  times the nominal one, and so is every rise.
- heat capacity C / (1 + f): warming is that of C under (1 + max f) times the power, since less flows off than
  (1 + f) u / R; cooling is that of the largest capacity.
- heat flow into the absorber, f(u) ≤ b u for u > 0, or f(m) ≤ b m by the rise m of a memory, a mean of earlier u: with
  U(t) the largest u so far, v + R b U is a supersolution, hence U ≤ v / (1 − R b). For u < 0, f(u) drives u towards 0
  and never past it, because f(0) = 0. A memory below 0 would add heat out of cooling and is refused (f(m) ≤ 0, m < 0).
  U is the largest rise over a wall that was colder then. So the cap on u and the wall's rise w together is kept if
  R b / (1 − R b) times the mean age of that heat (the memory's time and R C) times the fastest rise of w is left of it.
  To the wall the heat comes later, with the time constant 1 / λ of the slowest mode of absorber and memory. With
  λ τ = 1 − 1 / g, there the memory is g times as warm as the absorber, and λ = (1 / R − b g) / C; without a memory g
  is 1. A smaller C makes g larger, a larger C and R make λ smaller, and each is taken at that end.
  All three are rises over the wall: a flow that followed the wall's own rise would feed on that of the whole panel.
- heat flow by the rise of the gas: only one that is nowhere positive is bounded.
- gas: it is at most τ max f warmer, of which a finger feels the share that the touch surface takes.
- displacement and force heat nothing.
Factors of light multiply; functions of a heat capacity add up, and so do feedbacks b R and b R g: with fewer of them g
is only larger. A product of places, such as light and flow, is a supersolution of a supersolution.

Proof obligations, each of which a table could break and a mutant in the tests does:
1. f(0) = 0 of each added function, to an absolute `ZERO_SHARE` of the largest plausible value: f(z) / z is then
   largest at a knot, and the cold pixel in the dark stays cold. A tolerance relative to the table's own values is none.
2. Extremes are taken over every knot, those beyond any temperature too, as the tails are constant.
3. The slowest mode is at least as slow as that of every pixel within the declared uncertainty: b R g < `MAX_FEEDBACK`.
4. No factor 1 + f is negative: the product of two would be light.
5. All memories have one time constant, as the pixel has one memory.
6. Every number is within `RANGES` and `LARGEST`, so that no sum, ratio or time constant leaves the range of floats.
"""

from collections.abc import Sequence
from math import inf, sqrt
from typing import Annotated, Literal, NamedTuple, Self

import numpy as np
from pydantic import Field, model_validator

from optodrive.core.errors import InputError, Unquoted
from optodrive.core.kernels import kernel
from optodrive.core.quantity import format_quantity
from optodrive.core.toml_model import ConflictError, Section
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
MEMORY_TIME, MAX_POWER = MAX_SLOTS * SLOT, MAX_SLOTS * SLOT + 1
"""Columns of the memory's time constant, s, and of the largest power of the data, W, 0 where there is none."""
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
RANGES = {"power": (0.0, 100.0, "W"), "since_opening": (0.0, 1000.0, "s")}
RISES = (-2000.0, 2000.0, "K")
"""Plausible ends of a table, by the quantity, and those of all others, which are rises."""
MIN_SPAN = 1e-3
"""Smallest plausible distance of a table's ends, in the quantity's unit."""
LARGEST = {"light": 10.0, "heat_capacity": 10.0, "absorber": 10.0, "gas": 1e6, "displacement": 0.01, "force": 1.0}
"""Largest plausible value in each place, in the unit of `UNITS`; of light by its power in W."""
RANGE_SHARE = 0.01
"""Share of a range by which a pixel may leave it: as far as two integrators, and maxima between steps, differ."""
ZERO_SHARE = 1e-9
"""Share of the largest plausible value that counts as 0: of a heat flow 10 nW, or some microkelvin."""


class DiscoveredTerm(Section):
    """One function that a parameter set adds to the pixel, and where.

    where: key of `UNITS`; depends_on: rises of absorber, gas or memory, K, over the wall for a heat flow, the drive of
    the gas, half the absorber's rise less the gas's, K, the incident power, W, or the time since the gate has opened,
    s; low, high: range of the data; values: of the function at 65 equal distances from low to high, constant beyond;
    light: relative to the power, on the power itself in W; heat_capacity: f in C / (1 + f); memory_time_s: time
    constant with which the memory follows the absorber's rise over its wall; max_power_w: largest incident power of the
    data, if stated
    """

    where: Literal["light", "heat_capacity", "absorber", "gas", "displacement", "force"]
    depends_on: Literal["absorber", "gas", "memory", "drive", "power", "since_opening"]
    unit: str
    formula: str
    low: float
    high: float
    values: tuple[float, ...]
    memory_time_s: Annotated[float, Field(gt=SHORTEST_S, le=10.0)] | None = None
    max_power_w: Annotated[float, Field(gt=0.0, le=RANGES["power"][1])] | None = None
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
        # Before anything is computed from the values: inf and NaN end here.
        self._check_plausible(unit)
        if (self.memory_time_s is not None) != (self.depends_on == "memory"):
            raise ValueError("memory_time_s together with depends_on = 'memory', and only with it")
        # `not <=` and not `>`: NaN is refused, too.
        if self.where in ADDED and not abs(self._compute_at_zero()) <= find_zero(self.where):
            expected = f"0 {unit} where {self.depends_on} is 0: a cold pixel stays cold"
            raise ConflictError("values", self._compute_at_zero(), expected)
        if self.where == "absorber" and self.depends_on == "memory":
            z = np.linspace(self.low, self.high, KNOTS)
            for number in np.flatnonzero((z < 0.0) & (np.array(self.values) > find_zero(self.where))):
                expected = "at most 0 W where the memory is colder than the wall: its cold would heat"
                raise ConflictError(f"values.{number}", self.values[number], expected)
        return self

    def _check_plausible(self, unit: str) -> None:
        """Raise ConflictError for an end or a value that no pixel has."""
        lowest, highest, end_unit = RANGES.get(self.depends_on, RISES)
        for name, end in (("low", self.low), ("high", self.high)):
            if not lowest <= end <= highest:
                raise ConflictError(name, end, f"{lowest:g} to {highest:g} {end_unit}")
        if not self.high - self.low >= MIN_SPAN:
            raise ConflictError("high", self.high, f"at least {MIN_SPAN:g} {end_unit} above low, {self.low:g}")
        lowest, highest = self._find_plausible_values()
        for number, value in enumerate(self.values):
            if not lowest <= value <= highest:
                raise ConflictError(f"values.{number}", value, f"{lowest:g} to {highest:g} {unit}")

    def _find_plausible_values(self) -> tuple[float, float]:
        """Return the smallest and the largest plausible value."""
        highest = LARGEST[self.where]
        if self.where == "heat_capacity":
            return MIN_CAPACITY_SHARE - 1.0, highest
        return -1.0 if self.where == "light" and self.depends_on != "power" else -highest, highest

    def _compute_at_zero(self) -> float:
        """Return the value where the quantity is 0."""
        return float(np.interp(0.0, np.linspace(self.low, self.high, KNOTS), self.values))

    def find_rate_per_s(self, c_j_per_k: float) -> float:
        """Return the largest rate at which the term alone moves the state that it depends on, or oscillates with it."""
        steepest = float(np.abs(np.diff(self.values)).max()) * (KNOTS - 1) / (self.high - self.low)
        if self.where == "absorber" and self.depends_on == "absorber":
            return steepest / c_j_per_k
        if self.where == "absorber" and self.memory_time_s is not None:
            return sqrt(steepest / (c_j_per_k * self.memory_time_s))
        return steepest if self.where == "gas" and self.depends_on in ("gas", "drive") else 0.0


def find_zero(where: str) -> float:
    """Return the largest value that counts as 0 in a place, in its unit."""
    return ZERO_SHARE * LARGEST[where]


def check_set(terms: Sequence[DiscoveredTerm], where: str, c_j_per_k: float) -> None:
    """Raise InputError for terms that do not go together, or are too fast for the integrator's steps.

    where: place of the tables; c_j_per_k: the smallest heat capacity of an absorber
    """
    times_s = [term.memory_time_s for term in terms]
    first_s = next((time_s for time_s in times_s if time_s is not None), None)
    for number, (term, time_s) in enumerate(zip(terms, times_s, strict=True)):
        if time_s not in (None, first_s):
            expected = f"{first_s:g} s as of the other terms: the pixel has one memory"
            raise InputError(f"{where}.{number}.memory_time_s", time_s, expected)
        # The steepest part, with the smallest capacity: the fastest that the integrator may meet.
        rate_per_s = term.find_rate_per_s(c_j_per_k)
        if rate_per_s * SHORTEST_S > 1.0:
            found, expected = format_quantity(1.0 / rate_per_s, "s", 2), f"{format_quantity(SHORTEST_S, 's')} or more"
            raise InputError(f"{where}.{number}.values", Unquoted(f"a time constant of {found}"), expected)


def list_values(terms: Sequence[DiscoveredTerm]) -> dict[str, float]:
    """Return the numbers of the term by the columns of its row that are not zero."""
    row = np.zeros(MAX_POWER + 1)
    for slot, term in enumerate(terms):
        head = (PLACES.index(term.where), QUANTITIES.index(term.depends_on), term.low)
        row[slot * SLOT : (slot + 1) * SLOT] = (*head, (term.high - term.low) / (KNOTS - 1), *term.values)
        row[MEMORY_TIME] = term.memory_time_s or row[MEMORY_TIME]
    row[MAX_POWER] = min((term.max_power_w for term in terms if term.max_power_w is not None), default=0.0)
    return {str(column): float(row[column]) for column in np.flatnonzero(row)}


def build_unreached(pixels: int) -> FloatArray:
    """Return extremes of pixels without any pulse: [pixels, functions and the power, 2]."""
    return np.stack([np.full((pixels, MAX_SLOTS + 1), inf), np.full((pixels, MAX_SLOTS + 1), -inf)], axis=2)


def check_reached(values: TermValues, reached: FloatArray) -> None:
    """Raise InputError for the pixel that goes furthest beyond the data of a function.

    values: as of `list_values`; reached: extremes, as of `build_unreached`
    """
    row = Discovered().pack(values)
    slots = row[: MAX_SLOTS * SLOT].reshape(MAX_SLOTS, SLOT)
    low = np.append(slots[:, 2], 0.0)
    high = np.append(slots[:, 2] + (KNOTS - 1) * slots[:, 3], row[MAX_POWER])
    beyond = np.maximum(low - reached[:, :, 0], reached[:, :, 1] - high)
    is_used = high > low  # neither an empty slot nor an unstated power
    beyond[:, is_used] /= (high - low)[is_used]
    beyond[:, ~is_used] = -inf
    pixel, number = (int(each) for each in np.unravel_index(np.argmax(beyond), beyond.shape))
    if not beyond[pixel, number] > RANGE_SHARE:
        return
    quantity, what = "power", "discovered terms"
    if number < MAX_SLOTS:
        quantity, what = QUANTITIES[int(slots[number, 1])], f"the discovered term in {PLACES[int(slots[number, 0])]}"
    unit = RANGES.get(quantity, RISES)[2]
    is_high = reached[pixel, number, 1] - high[number] > low[number] - reached[pixel, number, 0]
    ends = " to ".join(format_quantity(float(end), unit) for end in (low[number], high[number]))
    raise InputError(
        f"pixel {pixel}: {quantity} of {what}",
        Unquoted(format_quantity(float(reached[pixel, number, int(is_high)]), unit, 4)),
        f"{ends}, the range of its data, outside of which nothing is known of it",
        code="untested",
    )


@kernel
def _read_quantity(v: FloatArray, slot: int, y: FloatArray, s: int, c: FloatArray) -> float:
    """Return the quantity that the function of a slot depends on."""
    quantity, wall_k = int(v[slot + 1]), c[FAR_END_K] if v[slot] == HEAT_FLOW else 0.0
    if quantity == OF_ABSORBER:
        return float(y[ABSORBER] - wall_k)
    if quantity == OF_GAS:
        return float(y[GAS] - wall_k)
    if quantity == OF_MEMORY:
        return float(y[s])
    if quantity == OF_DRIVE:
        return float(0.5 * y[ABSORBER] - y[GAS])
    return float(c[POWER_W] if quantity == OF_POWER else c[SINCE_EDGE_S])


@kernel
def note_reached(v: FloatArray, y: FloatArray, s: int, c: FloatArray, low: FloatArray, high: FloatArray) -> None:
    """Lower and raise the extremes of each function's quantity, and, behind these, of the power, to those here."""
    for number in range(MAX_SLOTS):
        place = v[number * SLOT]
        if place != NOWHERE and (place != LIGHT or c[POWER_W] > 0.0):
            z = _read_quantity(v, number * SLOT, y, s, c)
            low[number], high[number] = min(low[number], z), max(high[number], z)
    high[MAX_SLOTS] = max(high[MAX_SLOTS], c[POWER_W])


@kernel
def _evaluate(v: FloatArray, slot: int, y: FloatArray, s: int, c: FloatArray) -> float:
    """Return the function of a slot at the present states."""
    z = _read_quantity(v, slot, y, s, c)
    place = (z - v[slot + 2]) / v[slot + 3]
    # Constant beyond the ends. `not >`: NaN takes the low end and cannot index the table.
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
    # Darkness is the least: two factors below it would be light.
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
    row_length = MAX_POWER + 1
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
        rise_k = feedback = late_feedback = age_s = 0.0
        slots = [row[slot * SLOT : (slot + 1) * SLOT] for slot in range(MAX_SLOTS)]
        for slot in sorted(slots, key=lambda slot: slot[0]):  # heat capacities before heat flows
            place, quantity = int(slot[0]), int(slot[1])
            lowest, highest, ratio = _find_extremes(slot)
            if place == LIGHT:
                power *= 1.0 + (ratio if quantity == OF_POWER else highest)
            elif place == HEAT_CAPACITY:
                fastest, slowest = fastest + highest, slowest + lowest
            elif place == HEAT_FLOW and highest > find_zero("absorber"):
                own, memory_s = ratio * envelope.r_k_per_w, 0.0
                # At 1 each joule brings another one: no bound exists.
                if quantity == OF_GAS or not own < 1.0:
                    return None
                late = own
                if quantity == OF_MEMORY and own > 0.0:
                    memory_s = float(row[MEMORY_TIME])
                    late = _find_late_feedback(own, memory_s / (envelope.r_k_per_w * envelope.c_min_j_per_k / fastest))
                feedback, late_feedback = feedback + own, late_feedback + late
                age_s += own * (memory_s + envelope.r_k_per_w * envelope.c_max_j_per_k)
            elif place == GAS_RATE:
                rise_k += envelope.gas_share * envelope.tau_g_s * highest
        # None refuses the set by name; a bound that is too large would trim every plan without a word.
        if not power < inf or late_feedback > MAX_FEEDBACK or slowest < MIN_CAPACITY_SHARE:
            return None
        return HeatGainBound(
            power_factor=power * fastest / (1.0 - feedback),
            capacity_factor=1.0 / slowest,
            delay_factor=1.0 / (1.0 - late_feedback),
            uniform_rise_k=rise_k,
            absorber_age_s=age_s / (1.0 - feedback),
        )


class _Extremes(NamedTuple):
    """Bounds of a function over all that can be reached.

    lowest, highest: smallest and largest value, at most and at least 0; ratio: largest f(z) / z for z > 0, at least 0,
    infinite if the function is positive at 0
    """

    lowest: float
    highest: float
    ratio: float


def _find_extremes(slot: FloatArray) -> _Extremes:
    """Return the extremes of a slot's function.

    Values between knots and beyond them lie between those of knots. Between knots the ratio is monotone, and beyond the
    last one it falls in size.
    """
    z, values = slot[2] + slot[3] * np.arange(KNOTS), slot[HEAD:]
    lowest, highest, positive = min(0.0, float(values.min())), max(0.0, float(values.max())), z > 0.0
    if int(slot[0]) not in (LIGHT, HEAT_FLOW):
        return _Extremes(lowest, highest, 0.0)
    if float(np.interp(0.0, z, values)) > find_zero(PLACES[int(slot[0])]):
        return _Extremes(lowest, highest, inf)
    ratio = max(0.0, float((values[positive] / z[positive]).max())) if positive.any() else 0.0
    return _Extremes(lowest, highest, ratio)


def _find_late_feedback(feedback: float, ratio: float) -> float:
    """Return the feedback b R g of the slowest mode of absorber and memory, at least b R.

    feedback: b R; ratio: the memory's time constant over R C, with the smallest C. With g = 1 / (1 − λ τ) and
    λ τ = ratio (1 − b R g), g solves b R ratio g² + (1 − ratio) g − 1 = 0.
    """
    excess = ratio - 1.0
    return (excess + sqrt(excess**2 + 4.0 * feedback * ratio)) / (2.0 * ratio)
