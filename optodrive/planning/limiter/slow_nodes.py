"""What walls and touch surfaces bear of a pulse: as if its heat had arrived, and less the heat on its way. Kernels."""

from math import exp, inf, log
from typing import NamedTuple

from optodrive.core.kernels import kernel
from optodrive.planning.limiter.budget import Budget, HeatBound
from optodrive.planning.limiter.heat_bound import Nodes, least_after_k, touch_after_k, wall_after_k, wall_bound_k

FEWER_HALVINGS = 16
AHEAD = 2.0
"""How many of an absorber's own times a wall is looked ahead for its touch surface."""
WALL_NODE, TOUCH_NODE = range(2)


class Ask(NamedTuple):
    """One pulse as asked for."""

    pixel: int
    start_s: float
    width_s: float
    x_rad: float
    y_rad: float
    power_w: float


@kernel
def _wall_cap_k(budget: Budget) -> float:
    """No wall may be warmer than the touch surface can bear for ever: then no later moment in the dark is too warm."""
    per_wall = budget.heat.touch_per_wall_k * budget.heat.touch_spread
    return min(budget.caps.wall_k, budget.caps.touch_k / per_wall) if per_wall > 0.0 else budget.caps.wall_k


@kernel
def slow_nodes_allow(budget: Budget, nodes: Nodes, ask: Ask, least_k: float) -> tuple[float, float]:
    """Largest power for wall and touch surface.

    First as if all its heat had arrived by the pulse's end; where that is too little, less the heat on its way.
    """
    heat, pixel, width_s = budget.heat, ask.pixel, ask.width_s
    wall_w = touch_w = inf
    cap_k = _wall_cap_k(budget) / heat.wall_spread
    for capacity in range(2):
        if heat.wall_k_per_j[capacity] > 0.0:
            dark_k = wall_after_k(heat, nodes, pixel, capacity, width_s)
            wall_w = min(wall_w, (cap_k - dark_k) / (heat.wall_k_per_j[capacity] * width_s))
    wall_k = wall_over_k(budget, nodes, ask, 0.0)
    wall_k_per_w = heat.wall_spread * heat.wall_k_per_j[0] * width_s
    for lag in range(2):
        if heat.touch_k_per_j[lag] > 0.0:
            caught_up = 1.0 - exp(-width_s / heat.touch_lag_s[lag])
            dark_k = touch_after_k(heat, nodes, pixel, lag, heat.touch_per_wall_k * wall_k, width_s)
            k_per_w = heat.touch_k_per_j[lag] * width_s + heat.touch_per_wall_k * wall_k_per_w * caught_up
            touch_w = min(touch_w, (budget.caps.touch_k / heat.touch_spread - dark_k) / k_per_w)
    if wall_w < ask.power_w:
        wall_w = _borne_w(budget, nodes, ask, least_k, WALL_NODE, max(0.0, wall_w))
    if touch_w < ask.power_w:
        touch_w = _borne_w(budget, nodes, ask, least_k, TOUCH_NODE, max(0.0, touch_w))
    return wall_w, touch_w


@kernel
def _borne_w(budget: Budget, nodes: Nodes, ask: Ask, least_k: float, node: int, sure_w: float) -> float:
    """The largest power, from sure_w up to what is asked for, that a wall or touch surface bears."""
    if _bears(budget, nodes, ask, least_k, node, ask.power_w):
        return ask.power_w
    low_w, high_w = sure_w, ask.power_w
    for _ in range(FEWER_HALVINGS):
        middle_w = 0.5 * (low_w + high_w)
        if _bears(budget, nodes, ask, least_k, node, middle_w):
            low_w = middle_w
        else:
            high_w = middle_w
    return low_w


@kernel
def _bears(budget: Budget, nodes: Nodes, ask: Ask, least_k: float, node: int, power_w: float) -> bool:
    """Whether a wall or touch surface stays within its cap during a pulse, and for ever in the dark after it.

    In that dark its bound, y, falls towards what drives it, d, and the heat on its way, h, falls more quickly: y − h
    may rise. Of h only so much counts that it does not: y falls at λ (y − d) at least, h at its rate at most. By the
    time d is passed by a later one, y itself is below the cap.
    """
    heat, pixel = budget.heat, ask.pixel
    end_k = least_after_k(heat, pixel, least_k, power_w, ask.width_s)
    quickest_s = 1.0 / heat.least_rate_per_s[pixel, 1]
    neighbours_w = 0.0
    for side in range(4):
        if heat.beside[pixel, side] >= 0:
            neighbours_w += heat.side_w_per_k * _wall_cap_k(budget)
    wall_k = wall_over_k(budget, nodes, ask, power_w)
    if node == WALL_NODE:
        cap_k, part, lost_k = _wall_cap_k(budget), heat.wall_flight, heat.wall_flight * heat.lost_k
        highest_k, after_k = wall_during_k(budget, nodes, ask, least_k, power_w), wall_k
        rate, drive_k = heat.wall_w_per_k[pixel] / heat.wall_j_per_k[1], neighbours_w / heat.wall_w_per_k[pixel]
    else:
        cap_k, part = budget.caps.touch_k, heat.touch_flight
        lost_k = part * heat.lost_k + heat.touch_lost_k
        highest_k, after_k = _touch_during_k(budget, nodes, ask, least_k, power_w)
        warmer_k = neighbours_w / heat.wall_j_per_k[0] * AHEAD * quickest_s
        rate, drive_k = 1.0 / heat.touch_lag_s[1], heat.touch_per_wall_k * min(_wall_cap_k(budget), wall_k + warmer_k)
    on_its_way_k = min(part * end_k - lost_k, rate * quickest_s * (after_k - drive_k))
    return bool(max(highest_k, after_k - max(0.0, on_its_way_k)) <= cap_k)


@kernel
def wall_during_k(budget: Budget, nodes: Nodes, ask: Ask, least_k: float, power_w: float) -> float:
    """The pixel's wall at most during a pulse, less the heat still in the absorber."""
    heat, pixel = budget.heat, ask.pixel
    highest_k = 0.0
    for capacity in range(2):
        rate = heat.wall_w_per_k[pixel] / heat.wall_j_per_k[capacity]
        steady_k = nodes.inflow_w[pixel] / heat.wall_w_per_k[pixel] + heat.wall_k_per_j[capacity] * power_w / rate
        highest_k = max(
            highest_k,
            _less_on_its_way_k(
                heat,
                ask,
                least_k,
                power_w,
                nodes.wall_k[pixel, capacity],
                steady_k,
                rate,
                heat.wall_flight / heat.wall_spread,
            ),
        )
    highest_k = heat.wall_spread * highest_k + heat.wall_flight * heat.lost_k
    return min(highest_k, wall_over_k(budget, nodes, ask, power_w))


@kernel
def _touch_during_k(budget: Budget, nodes: Nodes, ask: Ask, least_k: float, power_w: float) -> tuple[float, float]:
    """The pixel's touch surface at most during a pulse, less the heat on its way; and its bound at the pulse's end."""
    heat, pixel = budget.heat, ask.pixel
    drive_k = heat.touch_per_wall_k * wall_during_k(budget, nodes, ask, least_k, power_w)
    highest_k = bound_k = after_k = 0.0
    for lag in range(2):
        rate, brings_k = 1.0 / heat.touch_lag_s[lag], heat.touch_k_per_j[lag] * power_w
        before_k = nodes.touch_k[pixel, lag]
        end_k = touch_after_k(heat, nodes, pixel, lag, drive_k, ask.width_s) + brings_k * ask.width_s
        after_k, bound_k = max(after_k, end_k), max(bound_k, before_k, end_k)
        highest_k = max(
            highest_k,
            _less_on_its_way_k(
                heat,
                ask,
                least_k,
                power_w,
                before_k,
                drive_k + brings_k / rate,
                rate,
                heat.touch_flight / heat.touch_spread,
            ),
        )
    highest_k = heat.touch_spread * highest_k + heat.touch_flight * heat.lost_k + heat.touch_lost_k
    return min(highest_k, heat.touch_spread * bound_k), heat.touch_spread * after_k


@kernel
def _less_on_its_way_k(
    heat: HeatBound,
    ask: Ask,
    least_k: float,
    power_w: float,
    before_k: float,
    steady_k: float,
    rate: float,
    part: float,
) -> float:
    """Largest value of y − part × u during a pulse: y goes from before_k to steady_k, u is the absorber at least."""
    least_steady_k = heat.least_k_per_w[ask.pixel] * power_w
    least_rate = heat.least_rate_per_s[ask.pixel, 0 if least_steady_k > least_k else 1]
    highest_k = before_k - part * least_k
    falls, freed = rate * (before_k - steady_k), part * least_rate * (least_k - least_steady_k)
    at_s = ask.width_s
    for _ in range(2):
        y_k = steady_k + (before_k - steady_k) * exp(-rate * at_s)
        u_k = least_steady_k + (least_k - least_steady_k) * exp(-least_rate * at_s)
        highest_k = max(highest_k, y_k - part * u_k)
        # Where both fall, the difference may peak in between.
        if freed > falls > 0.0 and least_rate > rate:
            at_s = min(at_s, log(freed / falls) / (least_rate - rate))
    return float(highest_k)


@kernel
def wall_over_k(budget: Budget, nodes: Nodes, ask: Ask, power_w: float) -> float:
    """Bound on the pixel's wall during a pulse."""
    heat = budget.heat
    most_k = wall_bound_k(heat, nodes, ask.pixel)
    for capacity in range(2):
        dark_k = wall_after_k(heat, nodes, ask.pixel, capacity, ask.width_s)
        most_k = max(most_k, heat.wall_spread * (dark_k + heat.wall_k_per_j[capacity] * power_w * ask.width_s))
    return most_k
