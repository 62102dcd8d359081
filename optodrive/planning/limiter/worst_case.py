"""Worst-case coefficients of the thermal bound over the declared parameter box.

Theory of operation

Problem. Parameters of a display are known to some percent, and the bound must hold for all of them. Trying the corners
of the box would take 2⁸ runs, and the worst case need not be a corner. So each coefficient of the bound is taken at the
end of its range that makes temperatures higher, once, when a display is loaded.

Which end. Temperatures rise monotonically with absorbed power, resistances, coupling, shares and exponent, so these are
taken at one end. Capacities and lags are not monotone: a smaller one warms faster, a larger one cools more slowly. Each
such node is bounded with both ends, and `specht_ratio` is the proven price of the values in between.

Concave loss. A bridge conducts less when hot: its loss is concave, and chords from 0 to the cap lie below it. Less loss
is the worse case. Where the exponent is uncertain, chords are laid even for a nominally constant bridge.

Delays. The bound lets heat arrive at once. Where a node in between delays it, it arrives later, when the counted heat
has already decayed; a factor 1 / (1 − rate × delay) makes up for that, and exists only if the node is slow enough
against the delay: otherwise the display is refused by name. The touch surface is bounded by a weighted sum of itself,
absorber and gas, whose weights are chosen so that the sum obeys an equation of first order (`_build_touch_bound`). The
panel warms walls and touch surface by its whole rise, increased as each follows it late.

Credits. `wall_transit_credit`, `touch_transit_credit` and the lower bound of the absorber are the opposite: they reduce
a bound, and are therefore taken at the other end, with deficits for what neighbours and panel warm.

Invariant. Every field of `Uncertainty` and of `HeatBound` enters here or, for the panel, in `panel_bound.py`; a test
walks over all declared uncertainties and requires each to be counted. Judged by an integrator that shares no code with
the limiter (`tests/reference_models`). Decision: 41 (skew of stages).
"""

from dataclasses import dataclass
from math import exp, inf

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.quantity import format_quantity
from optodrive.core.types.arrays import FloatArray
from optodrive.planning.limiter.budget import HeatBound
from optodrive.planning.limiter.caps import CapValues
from optodrive.planning.limiter.panel_bound import NominalThermalModel, Uncertainty, build_panel_bound, specht_ratio

CHORDS = 8
STEP_FRACTION = 0.07
"""Step of the heat exchange between walls, as a fraction of the fastest wall's time constant."""


def build_heat_bound(
    model: NominalThermalModel, uncertainty: Uncertainty, caps: CapValues, *power_max_w: float, skew_s: float = 0.0
) -> HeatBound:
    """Compute the worst-case coefficients.

    power_max_w: largest power of a pulse, by stage; skew_s: largest difference between the clocks of two stages. Raises
    InputError if a wall or touch surface is too fast for the absorber, or the panel for the walls.
    """
    epsilon = model.epsilon * (1 + uncertainty.absorbed_power)
    r_high = model.r_k_per_w * (1 + uncertainty.bridge_resistance)
    c_low = model.c_j_per_k * (1 - uncertainty.absorber_capacity)
    # Only the largest capacity grows with heat: the smallest is that of the cold absorber, which warms fastest.
    c_high = model.c_j_per_k * (1 + uncertainty.absorber_capacity) * model.hot_capacity_factor
    knot_k, loss_k = _compute_loss_chords(model, uncertainty, caps)
    resistance_factor = float(knot_k[-1] / loss_k[-1])
    late_j_per_k = c_high * model.delay_factor  # heat that a part behind the absorber returns counts as the absorber's
    tau_max_s = float((r_high * late_j_per_k).max()) * resistance_factor
    slope_min = float(np.min(np.diff(loss_k) / np.diff(knot_k)))
    lag_max_s = float((r_high * late_j_per_k).max()) / slope_min

    epsilon_max = float(epsilon.max())
    wall = _build_wall_bound(model, uncertainty, epsilon_max, late_j_per_k, resistance_factor, tau_max_s, lag_max_s)
    touch = _build_touch_bound(
        model, uncertainty, epsilon_max, float(r_high.max()) * resistance_factor, tau_max_s, wall
    )
    lags_s = lag_max_s, float(wall.j_per_k[1]), float(touch.lag_s[1])
    panel = build_panel_bound(model, uncertainty, epsilon_max, sum(power_max_w), *lags_s)
    # Last: its deficits need the fastest rise of the panel and the coupling of walls and touch surface.
    lower = _build_lower_bound(model, uncertainty, caps, c_low, c_high, wall, touch, panel.k_per_s)
    bound = HeatBound(
        epsilon=epsilon,
        r_k_per_w=r_high,
        c_low_j_per_k=c_low,
        c_high_j_per_k=c_high,
        knot_k=knot_k,
        loss_k=loss_k,
        absorber_wall_factor=wall.absorber_wall_factor,
        wall_w_per_k=wall.w_per_k,
        wall_j_per_k=wall.j_per_k,
        wall_k_per_j=wall.k_per_j,
        wall_specht_ratio=wall.specht_ratio,
        neighbours=np.ascontiguousarray(model.neighbours),
        # What another stage does later than planned has cooled less by the time it counts.
        lateral_w_per_k=wall.lateral_w_per_k * exp(wall.rate_per_s * skew_s),
        exchange_step_s=wall.exchange_step_s,
        touch_lag_s=touch.lag_s,
        touch_k_per_j=touch.k_per_j,
        touch_per_wall_k=touch.per_wall_k,
        touch_specht_ratio=touch.specht_ratio,
        panel_k_per_j=panel.k_per_j * np.exp(skew_s / panel.tau_s),
        panel_tau_s=panel.tau_s,
        panel_specht_ratio=panel.specht_ratio,
        absorber_per_panel=panel.per_absorber,
        wall_per_panel=panel.per_wall,
        touch_per_panel=panel.per_touch,
        panel_k_per_s=panel.k_per_s,
        panel_floor_k=panel.floor_k,
        lower_bound_k_per_w=lower.k_per_w,
        lower_bound_rate_per_s=lower.rate_per_s,
        deficit_k=lower.deficit_k,
        wall_transit_credit=float(c_low.min()) / (wall.retained_fraction * float(wall.j_per_k[1])),
        touch_transit_credit=float(c_low.min()) * float(touch.k_per_j[1]) / epsilon_max,
        touch_deficit_k=lower.touch_deficit_k,
        power_max_w=np.array(power_max_w),
        skew_s=skew_s,
    )
    for column in bound:
        if isinstance(column, np.ndarray):
            # Shared by all plans and threads; a kernel that wrote to it would loosen the bound of all later ones.
            column.setflags(write=False)
    return bound


def _compute_loss_chords(
    model: NominalThermalModel, uncertainty: Uncertainty, caps: CapValues
) -> tuple[FloatArray, FloatArray]:
    """Return knots and values of chords of the loss u R₀ / R(u), from 0 to the cap.

    The loss is concave, so the chords lie below it.
    """
    # The largest n: a hot bridge then conducts least and keeps its heat longest.
    exponent = model.exponent + uncertainty.exponent
    knot_k = np.linspace(0.0, caps.absorber_k, (CHORDS if exponent > 0 else 1) + 1)
    return knot_k, knot_k * _compute_bridge_ratio(model, caps, knot_k) ** -exponent


def _compute_bridge_ratio(model: NominalThermalModel, caps: CapValues, rise_k: FloatArray) -> FloatArray:
    """Return the largest mean temperature of a bridge over ambient, for rises of an absorber over its wall."""
    # The far end is as hot as caps permit: the mean temperature of the bridge is then the largest.
    wall_k = min(caps.wall_k, caps.touch_k) if model.walls is not None or model.panel is not None else 0.0
    far_end_k = model.extra_rise_k + (wall_k if np.isfinite(wall_k) else 0.0)
    return (model.ambient_k + far_end_k + 0.5 * rise_k) / model.ambient_k


@dataclass(frozen=True, eq=False)
class _WallBound:
    """Worst-case coefficients of the walls, or those that leave the bound at zero without walls."""

    w_per_k: FloatArray
    j_per_k: FloatArray
    k_per_j: FloatArray
    specht_ratio: float
    lateral_w_per_k: float
    exchange_step_s: float
    rate_per_s: float
    retained_fraction: float
    absorber_wall_factor: float


def _build_wall_bound(
    model: NominalThermalModel,
    uncertainty: Uncertainty,
    epsilon: float,
    c_absorber_j_per_k: FloatArray,
    resistance_factor: float,
    tau_max_s: float,
    lag_max_s: float,
) -> _WallBound:
    pixels = len(model.epsilon)
    walls = model.walls
    if walls is None:
        return _WallBound(np.ones(pixels), np.ones(2), np.zeros(2), 1.0, 0.0, inf, 0.0, 1.0, 1.0)
    neighbour_count = np.count_nonzero(model.neighbours >= 0, axis=1)

    def compute_conductance(wall_factor: float, lateral_factor: float) -> FloatArray:
        rim = model.frame_edges / (walls.frame_k_per_w * lateral_factor)
        return np.asarray(
            1 / (walls.r_k_per_w * wall_factor) + neighbour_count / (walls.lateral_k_per_w * lateral_factor) + rim,
            dtype=np.float64,
        )

    # A wall loses heat by the smallest conductance and gives its neighbours heat by the largest: no wall does both.
    min_w_per_k = compute_conductance(1 + uncertainty.wall_resistance, 1 + uncertainty.side_resistance)
    max_w_per_k = compute_conductance(1 - uncertainty.wall_resistance, 1 - uncertainty.side_resistance)
    c_low = walls.c_j_per_k * (1 - uncertainty.wall_capacity)
    # The bound puts all heat of a pulse into the wall at once, but the heat arrives over the absorber's time constant.
    # With a factor of 1 / (1 − rate × time constant) the bound stays above the wall at all later times.
    retained_fraction = 1.0 - float(max_w_per_k.max()) / c_low * tau_max_s
    lag_retained_fraction = 1.0 - float(min_w_per_k.max()) / c_low * lag_max_s
    # At 0.5 a pulse's heat counts twice; towards 0 it counts without limit, and would trim everything without saying
    # why.
    if min(retained_fraction, lag_retained_fraction) < 0.5:
        raise InputError(
            "terms.wall_heating",
            f"a wall time constant of {format_quantity(c_low / float(max_w_per_k.max()), 's')}",
            f"more than twice the absorber's {format_quantity(max(tau_max_s, lag_max_s), 's')}",
        )
    # The absorber follows a cooling wall and adds its own heat capacity.
    carried_j_per_k = float(c_absorber_j_per_k.max()) / retained_fraction
    capacities = np.array([c_low, walls.c_j_per_k * (1 + uncertainty.wall_capacity) + carried_j_per_k])
    # An absorber that is colder than its wall, which neighbours warm, lags more than a hot one.
    cold_absorber_factor = 1 + carried_j_per_k / (c_low + carried_j_per_k) * (resistance_factor - 1)
    return _WallBound(
        w_per_k=min_w_per_k,
        j_per_k=capacities,
        k_per_j=epsilon / capacities / retained_fraction,
        specht_ratio=specht_ratio(capacities[1] / capacities[0]),
        lateral_w_per_k=cold_absorber_factor / (walls.lateral_k_per_w * (1 - uncertainty.side_resistance)),
        exchange_step_s=STEP_FRACTION * c_low / float(min_w_per_k.max()),
        rate_per_s=float(max_w_per_k.max()) / c_low,
        retained_fraction=retained_fraction,
        absorber_wall_factor=1.0 / lag_retained_fraction,
    )


@dataclass(frozen=True, eq=False)
class _TouchBound:
    """Worst-case coefficients of the touch surface.

    gas_s: weight of the gas's rise over the wall
    """

    lag_s: FloatArray
    k_per_j: FloatArray
    per_wall_k: float
    specht_ratio: float
    gas_s: float


def _build_touch_bound(
    model: NominalThermalModel,
    uncertainty: Uncertainty,
    epsilon: float,
    r_k_per_w: float,
    tau_max_s: float,
    wall: _WallBound,
) -> _TouchBound:
    """Bound s + c₁ u + c₂ h, with the touch surface s, the absorber over its wall u and the gas over the wall h.

    With c₂ = gas share × τ_g / (lag − τ_g) and c₁ = gas share / 2 × τ / lag / ((1 − τ_g / lag) (1 − τ / lag)), its rate
    is at most (drive − value) / lag + the heating by the pulse. Absorber and gas lag behind a cooling wall, so the
    drive is the wall × (both shares + (c₁ + c₂) lag × the wall's fastest rate).
    """
    touch = model.touch
    if touch is None:
        return _TouchBound(np.ones(2), np.zeros(2), 0.0, 1.0, 0.0)
    lags_s = touch.lag_s * np.array([1 - uncertainty.touch_lag, 1 + uncertainty.touch_lag])
    gas_share, wall_share = (
        # Shares are relative: one of zero stays zero, however uncertain.
        touch.gas_share * (1 + uncertainty.touch_share),
        touch.wall_share * (1 + uncertainty.touch_share),
    )
    tau_g_s = model.tau_g_s * (1 + uncertainty.gas_lag)
    retained_fraction = (1.0 - tau_max_s / lags_s[0]) * (1.0 - tau_g_s / lags_s[0])
    if retained_fraction < 0.5 or lags_s[0] < tau_max_s:
        raise InputError(
            "terms.touch_surface.lag", touch.lag_s, f"well above the absorber's {format_quantity(tau_max_s, 's')}"
        )
    gas_s = gas_share * tau_g_s / (1.0 - tau_g_s / float(lags_s[0]))
    absorber_s = 0.5 * gas_share * tau_max_s / retained_fraction
    return _TouchBound(
        lag_s=lags_s,
        k_per_j=0.5 * gas_share * epsilon * r_k_per_w / lags_s / retained_fraction,
        per_wall_k=gas_share + wall_share + (absorber_s + gas_s) * wall.rate_per_s,
        specht_ratio=specht_ratio(lags_s[1] / lags_s[0]),
        gas_s=gas_s,
    )


@dataclass(frozen=True, eq=False)
class _LowerBound:
    """Coefficients of the lower bound of an absorber's rise over its wall."""

    k_per_w: FloatArray
    rate_per_s: FloatArray
    deficit_k: float
    touch_deficit_k: float


def _build_lower_bound(
    model: NominalThermalModel,
    uncertainty: Uncertainty,
    caps: CapValues,
    c_low: FloatArray,
    c_high: FloatArray,
    wall: _WallBound,
    touch: _TouchBound,
    panel_k_per_s: float,
) -> _LowerBound:
    """Bound the absorber's rise over its wall from below: a wall that only the absorber's own heat warms.

    panel_k_per_s: fastest rise of the panel
    """
    cold_ratio = _compute_bridge_ratio(model, caps, np.array(caps.absorber_k)) ** min(
        0.0, model.exponent - uncertainty.exponent
    )
    # Of a lower bound every end is the other one: little power, little resistance, heat that leaves fast.
    r_low = model.r_k_per_w * (1 - uncertainty.bridge_resistance) * cold_ratio
    coupling_factor = 1 + c_high / wall.j_per_k[0] if model.walls is not None else np.ones_like(c_high)
    rate_per_s = np.stack([coupling_factor / (r_low * c_high), coupling_factor / (r_low * c_low)], axis=1)
    k_per_w = model.epsilon * (1 - uncertainty.absorbed_power) * r_low / coupling_factor
    inflow_k_per_s = panel_k_per_s
    if wall.lateral_w_per_k > 0.0:
        max_wall_k = min(caps.wall_k, caps.touch_k)
        if touch.per_wall_k > 0.0:
            max_wall_k = min(max_wall_k, caps.touch_k / (touch.per_wall_k * touch.specht_ratio))
        inflow_k_per_s += 4 * wall.lateral_w_per_k * max_wall_k / float(wall.j_per_k[0])
    deficit_k, gas_lag_s = inflow_k_per_s / float(rate_per_s.min()), model.tau_g_s * (1 + uncertainty.gas_lag)
    gas_deficit_k = gas_lag_s * inflow_k_per_s + 0.5 * deficit_k
    touch_deficit_k = touch.gas_s / float(touch.lag_s[0]) * gas_deficit_k if touch.gas_s > 0.0 else 0.0
    return _LowerBound(k_per_w, rate_per_s, deficit_k, touch_deficit_k)
