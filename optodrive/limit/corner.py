"""From a declared model with its uncertainty to the coefficients of a bound that holds for all of it.

Heat here flows one way in every parameter but the capacities: more power, more resistance, more share, more heat.
A capacity warms faster when small and remembers longer when large; each node is counted with both (`spread`).
"""

from dataclasses import dataclass
from math import e, inf, log

import numpy as np

from optodrive.errors import InputError
from optodrive.flow import FloatArray, IntArray
from optodrive.limit.budget import Caps, HeatBound

CHORDS = 8
STEP_SHARE = 0.07
"""Walls exchange heat at steps of this share of the quickest wall's own time."""


@dataclass(frozen=True)
class Uncertainty:
    """Declared relative half-widths; exponent: absolute."""

    absorbed_power: float
    bridge_resistance: float
    absorber_capacity: float
    exponent: float
    gas_lag: float
    wall_resistance: float
    wall_capacity: float
    side_resistance: float
    touch_share: float
    touch_lag: float


@dataclass(frozen=True, eq=False)
class Walls:
    """A wall node a pixel, K/W and J/K; side, frame: to a neighbour, to the frame, infinite for none."""

    r_k_per_w: float
    c_j_per_k: float
    side_k_per_w: float
    frame_k_per_w: float


@dataclass(frozen=True)
class Touch:
    """The touch surface: share of the gas's and of the wall's rise, and its lag."""

    gas_share: float
    wall_share: float
    lag_s: float


@dataclass(frozen=True, eq=False)
class Declared:
    """The model in use. epsilon, r_k_per_w, c_j_per_k: [p]; exponent: of R = R₀ (T / T₀)ⁿ, T the bridge's mean.

    beside, frame_edges: [p, 4], [p] the lattice; walls, touch: None where the model has none
    """

    epsilon: FloatArray
    r_k_per_w: FloatArray
    c_j_per_k: FloatArray
    tau_g_s: float
    ambient_k: float
    exponent: float
    beside: IntArray
    frame_edges: IntArray
    walls: Walls | None
    touch: Touch | None


def spread(ratio: float) -> float:
    """By how much a sum of responses (1/c) e^(−t/rc) may exceed the larger of its values at both ends of c.

    ratio: of the ends.

    With s = 1/c each is s e^(−xs). Between the ends let the weights follow s itself: then e^(−xs) is the geometric
    mean of its values at the ends, and no mean of the values at the ends exceeds the larger. s itself exceeds the
    geometric mean of its ends by at most Specht's ratio.
    """
    if ratio == 1.0:
        return 1.0
    return float((ratio - 1) * ratio ** (1 / (ratio - 1)) / (e * log(ratio)))


def heat_bound(model: Declared, unsure: Uncertainty, caps: Caps, power_max_w: float) -> HeatBound:
    """The upper corner; raises InputError where a wall or touch surface is too quick beside the absorber."""
    epsilon = model.epsilon * (1 + unsure.absorbed_power)
    r_high = model.r_k_per_w * (1 + unsure.bridge_resistance)
    c_low = model.c_j_per_k * (1 - unsure.absorber_capacity)
    c_high = model.c_j_per_k * (1 + unsure.absorber_capacity)
    knot_k, loss_k = _chords(model, unsure, caps)
    hottest = float(knot_k[-1] / loss_k[-1])
    tau_max_s = float((r_high * c_high).max()) * hottest
    slope_min = float(np.min(np.diff(loss_k) / np.diff(knot_k)))
    lag_max_s = float((r_high * c_high).max()) / slope_min

    epsilon_max = float(epsilon.max())
    wall = _wall_bound(model, unsure, epsilon_max, float(c_high.max()), tau_max_s, lag_max_s)
    touch = _touch_bound(model, unsure, epsilon_max * float(r_high.max()) * hottest, tau_max_s, wall)
    bound = HeatBound(
        epsilon=epsilon,
        r_k_per_w=r_high,
        c_low_j_per_k=c_low,
        c_high_j_per_k=c_high,
        knot_k=knot_k,
        loss_k=loss_k,
        absorber_wall=wall.absorber_wall,
        wall_w_per_k=wall.w_per_k,
        wall_j_per_k=wall.j_per_k,
        wall_k_per_j=wall.k_per_j,
        wall_spread=wall.spread,
        beside=np.ascontiguousarray(model.beside),
        side_w_per_k=wall.side_w_per_k,
        step_s=wall.step_s,
        touch_lag_s=touch.lag_s,
        touch_k_per_j=touch.k_per_j,
        touch_per_wall_k=touch.per_wall_k,
        touch_spread=touch.spread,
        power_max_w=power_max_w,
    )
    for column in bound:
        if isinstance(column, np.ndarray):
            column.setflags(write=False)
    return bound


def _chords(model: Declared, unsure: Uncertainty, caps: Caps) -> tuple[FloatArray, FloatArray]:
    """Chords of the loss u / R(u), times R₀, from 0 to the cap. The loss is concave, so they lie below it."""
    exponent = model.exponent + unsure.exponent if model.exponent > 0 else 0.0
    knot_k = np.linspace(0.0, caps.absorber_k, (CHORDS if exponent > 0 else 1) + 1)
    wall_k = caps.wall_k if np.isfinite(caps.wall_k) and model.walls is not None else 0.0
    warmer = (model.ambient_k + wall_k + 0.5 * knot_k) / model.ambient_k
    return knot_k, knot_k * warmer**-exponent


@dataclass(frozen=True, eq=False)
class _WallBound:
    w_per_k: FloatArray
    j_per_k: FloatArray
    k_per_j: FloatArray
    spread: float
    side_w_per_k: float
    step_s: float
    rate_per_s: float
    absorber_wall: float


def _wall_bound(
    model: Declared,
    unsure: Uncertainty,
    epsilon: float,
    c_absorber_j_per_k: float,
    tau_max_s: float,
    lag_max_s: float,
) -> _WallBound:
    pixels = len(model.epsilon)
    walls = model.walls
    if walls is None:
        return _WallBound(np.ones(pixels), np.ones(2), np.zeros(2), 1.0, 0.0, inf, 0.0, 1.0)
    sides = np.count_nonzero(model.beside >= 0, axis=1)

    def leaving(own: float, side: float) -> FloatArray:
        rim = model.frame_edges / (walls.frame_k_per_w * side)
        return np.asarray(1 / (walls.r_k_per_w * own) + sides / (walls.side_k_per_w * side) + rim, dtype=np.float64)

    least = leaving(1 + unsure.wall_resistance, 1 + unsure.side_resistance)
    most = leaving(1 - unsure.wall_resistance, 1 - unsure.side_resistance)
    c_low = walls.c_j_per_k * (1 - unsure.wall_capacity)
    # All heat of a pulse is put into the wall at once though it comes over the absorber's time: with 1 / (1 − rate ×
    # time) more of it, the bound lies above the wall at every later moment.
    still_there = 1.0 - float(most.max()) / c_low * tau_max_s
    rate_per_s = float(least.max()) / c_low
    behind = 1.0 - rate_per_s * lag_max_s
    if min(still_there, behind) < 0.5:
        raise InputError(
            "terms.wall_heating",
            f"a wall that cools in {c_low / float(most.max()):.3g} s",
            f"more than twice the absorber's {max(tau_max_s, lag_max_s):.3g} s",
        )
    # A wall that cools takes its absorber's heat along.
    capacities = np.array([c_low, walls.c_j_per_k * (1 + unsure.wall_capacity) + c_absorber_j_per_k])
    return _WallBound(
        w_per_k=least,
        j_per_k=capacities,
        k_per_j=epsilon / capacities / still_there,
        spread=spread(capacities[1] / capacities[0]),
        side_w_per_k=1 / (walls.side_k_per_w * (1 - unsure.side_resistance)),
        step_s=STEP_SHARE / rate_per_s,
        rate_per_s=rate_per_s,
        absorber_wall=1.0 / behind,
    )


@dataclass(frozen=True, eq=False)
class _TouchBound:
    lag_s: FloatArray
    k_per_j: FloatArray
    per_wall_k: float
    spread: float


def _touch_bound(
    model: Declared, unsure: Uncertainty, k_s_per_j: float, tau_max_s: float, wall: _WallBound
) -> _TouchBound:
    """k_s_per_j: integral of the absorber's rise over its wall, per incident joule, at most."""
    touch = model.touch
    if touch is None:
        return _TouchBound(np.ones(2), np.zeros(2), 0.0, 1.0)
    lags_s = touch.lag_s * np.array([1 - unsure.touch_lag, 1 + unsure.touch_lag])
    gas_share, wall_share = touch.gas_share * (1 + unsure.touch_share), touch.wall_share * (1 + unsure.touch_share)
    tau_g_s = model.tau_g_s * (1 + unsure.gas_lag)
    still_there = (1.0 - tau_max_s / lags_s[0]) * (1.0 - tau_g_s / lags_s[0])
    if still_there < 0.5 or lags_s[0] < tau_max_s:
        raise InputError("terms.touch_surface.lag", touch.lag_s, f"well above the absorber's {tau_max_s:.3g} s")
    return _TouchBound(
        lag_s=lags_s,
        k_per_j=0.5 * gas_share * k_s_per_j / lags_s / still_there,
        per_wall_k=gas_share * wall.absorber_wall / (1 - wall.rate_per_s * tau_g_s) + wall_share,
        spread=spread(lags_s[1] / lags_s[0]),
    )
