"""Largest power of a pulse for its wall and touch surface, with a credit for heat in transit. Kernels.

Theory of operation

Problem. Wall and touch surface lag behind the absorber. Their bounds count the heat of a pulse as if it arrived at the
pulse's end, and their caps must also hold at all times after the pulse, with any other pixels driven meanwhile.

Caps that suffice. With the gate off no wall gets hotter than the hottest wall, and no touch surface hotter than a
steady one over the hottest wall. If walls are held below the smaller of their cap and of what a touch surface may have
when steady (`_wall_cap_k`), then the set of states below all caps is left by no cooling, and it is enough to judge each
pulse when it is granted. Caps are counted over the panel, which rises while other pixels are driven: the set shrinks,
and a wall at its cap must fall faster than the cap does. It does so above a floor; below it nothing is granted.

Power. The first answer is linear: the power at which all heat at once just reaches the cap. Where it is less than
requested, the heat that is certainly still in the absorber is credited: y − credit × u, with y the bound and u a lower
bound of the absorber's rise (smallest power and resistance, largest capacity while warming, smallest while cooling,
warmed by nothing else, less a deficit for walls that neighbours warm). The power is then bisected, because the
condition is monotone in it but not linear.

During the pulse y and u are single exponentials, so the maximum of their difference lies at an end or at one point in
closed form (`_credited_peak_k`). After the pulse u decays and its heat arrives: y − u could rise again. So only as much
is credited as lets the difference fall at least as fast as the cap may (`_is_within_cap`): y falls at a rate of at
least λ (y − d) towards its drive d, u at most at its own rate. The drive is taken at its largest (neighbours at their
caps; for a touch surface, a wall that such neighbours have warmed for two absorber times), and when a larger one could
have arisen, y alone is below the cap.

Invariants. Without credit the result is a lower bound of the power with credit, and the bisection starts there: a
credit never costs power. The result never exceeds the requested power. A power of 0 always passes, because the state
before the pulse was within the set, unless the panel has taken the cap away.

Rejected: one run per corner of the parameter box, as the worst case need not be a corner, and a wall whose capacity may
change at any moment, with which a train ratchets up by the ratio of both capacities.
"""

from math import exp, inf, log
from typing import NamedTuple

from optodrive.core.kernels import kernel
from optodrive.planning.limiter.budget import Budget, HeatBound
from optodrive.planning.limiter.heat_bound import (
    ThermalNodes,
    lower_bound_after_k,
    touch_after_k,
    wall_after_k,
    wall_bound_k,
)

# 2⁻¹⁶ of the requested power: about one step of the board's duty (1/65535).
BISECTIONS = 16
LOOK_AHEAD_TAUS = 2.0
"""Number of absorber time constants over which the warming of a wall is added to its touch surface's drive."""
WALL_NODE, TOUCH_NODE = range(2)


class PulseRequest(NamedTuple):
    """A pulse as requested. panel_k: bound on the panel's rise during it, which is left from the caps."""

    pixel: int
    stage: int
    start_s: float
    width_s: float
    x_rad: float
    y_rad: float
    power_w: float
    panel_k: float


@kernel
def _touch_cap_k(budget: Budget, panel_k: float) -> float:
    """Return the touch surface's cap as a rise over its warming by the panel, negative for a panel above the cap."""
    return budget.caps.touch_k - budget.heat.touch_per_panel * panel_k


@kernel
def _wall_cap_k(budget: Budget, panel_k: float) -> float:
    """Return the wall's cap over the panel, or the smaller rise at which the touch surface has its cap when steady.

    A finger between the pixels touches the walls: the touch surface's cap is theirs, too.

    Pulses on other pixels lower these caps while they warm the panel. A wall at its cap falls faster than that if the
    cap is above a floor; below it no pulse is allowed. A touch surface falls as fast if its wall is lower by what the
    panel rises within the touch surface's lag.
    """
    heat = budget.heat
    # The lower of both: between two pixels a finger lies on a wall.
    cap_k = min(budget.caps.wall_k, budget.caps.touch_k) - heat.wall_per_panel * panel_k
    if heat.touch_per_wall_k > 0.0:
        # A touch surface follows its wall late: until it has, the panel may rise further.
        touch_k = _touch_cap_k(budget, panel_k + heat.panel_k_per_s * heat.touch_lag_s[1])
        cap_k = min(cap_k, touch_k / (heat.touch_per_wall_k * heat.touch_specht_ratio))
    # Below the floor a wall falls more slowly than its cap while others warm the panel: the set would no longer be
    # invariant.
    return cap_k if cap_k >= heat.panel_floor_k else -1.0


@kernel
def slow_node_limits_w(
    budget: Budget, nodes: ThermalNodes, request: PulseRequest, lower_bound_k: float
) -> tuple[float, float]:
    """Return the largest power of a pulse for the wall and for the touch surface, W.

    The power is computed as if all heat arrived by the pulse's end. If that is less than requested, the in-transit heat
    is credited.
    """
    heat, pixel, width_s = budget.heat, request.pixel, request.width_s
    wall_w = inf
    # The cap is divided once here, so that both ends of the capacity are compared with one number.
    cap_k = _wall_cap_k(budget, request.panel_k) / heat.wall_specht_ratio
    for capacity in range(2):
        if heat.wall_k_per_j[capacity] > 0.0:
            off_k = wall_after_k(heat, nodes, pixel, capacity, width_s)
            wall_w = min(wall_w, (cap_k - off_k) / (heat.wall_k_per_j[capacity] * width_s))
    # The touch surface is driven by the wall without this pulse; what the pulse adds to the wall is in k_per_w below.
    wall_k = wall_peak_k(budget, nodes, request, 0.0)
    touch_cap_k = _touch_cap_k(budget, request.panel_k)
    touch_w = inf if touch_cap_k >= 0.0 else 0.0
    wall_k_per_w = heat.wall_specht_ratio * heat.wall_k_per_j[0] * width_s
    for lag in range(2):
        if heat.touch_k_per_j[lag] > 0.0:
            response = 1.0 - exp(-width_s / heat.touch_lag_s[lag])
            off_k = touch_after_k(heat, nodes, pixel, lag, heat.touch_per_wall_k * wall_k, width_s)
            k_per_w = heat.touch_k_per_j[lag] * width_s + heat.touch_per_wall_k * wall_k_per_w * response
            touch_w = min(touch_w, (touch_cap_k / heat.touch_specht_ratio - off_k) / k_per_w)
    if wall_w < request.power_w:
        # The credit costs a bisection, so it is computed only where the linear answer trims.
        wall_w = _max_node_power_w(budget, nodes, request, lower_bound_k, WALL_NODE, max(0.0, wall_w))
    if touch_w < request.power_w:
        touch_w = _max_node_power_w(budget, nodes, request, lower_bound_k, TOUCH_NODE, max(0.0, touch_w))
    return wall_w, touch_w


@kernel
def _max_node_power_w(
    budget: Budget, nodes: ThermalNodes, request: PulseRequest, lower_bound_k: float, node: int, feasible_w: float
) -> float:
    """Bisect for the largest power, from `feasible_w` to the requested power, that keeps a node within its cap."""
    if _is_within_cap(budget, nodes, request, lower_bound_k, node, request.power_w):
        # Most pulses that need the credit are granted whole: one evaluation in place of sixteen.
        return request.power_w
    low_w, high_w = feasible_w, request.power_w
    for _ in range(BISECTIONS):
        middle_w = 0.5 * (low_w + high_w)
        if _is_within_cap(budget, nodes, request, lower_bound_k, node, middle_w):
            low_w = middle_w
        else:
            high_w = middle_w
    # The lower end: it was tested and passes, the middle of the last interval was not.
    return low_w


@kernel
def _is_within_cap(
    budget: Budget, nodes: ThermalNodes, request: PulseRequest, lower_bound_k: float, node: int, power_w: float
) -> bool:
    """Return whether a wall or touch surface stays within its cap during a pulse and at all times after it, gate off.

    After the pulse the node's bound y decays towards its drive d, and the in-transit heat h decays faster, so y − h
    may rise. Only as much of h is credited as lets y − h fall as fast as the cap may with the panel: y falls at a rate
    of at least λ (y − d), h at most at its own rate. By the time a larger drive replaces d, y itself is below the cap.
    """
    heat, pixel = budget.heat, request.pixel
    end_k = lower_bound_after_k(heat, pixel, lower_bound_k, power_w, request.width_s)
    # The fastest that the credited heat may leave the absorber, with its smallest capacity.
    min_tau_s = 1.0 / heat.lower_bound_rate_per_s[pixel, 1]
    neighbours_w = 0.0
    for side in range(4):
        if heat.neighbours[pixel, side] >= 0:
            # Neighbours at their cap: no pulse that is granted to them later makes them warmer.
            neighbours_w += heat.lateral_w_per_k * _wall_cap_k(budget, request.panel_k)
    wall_k = wall_peak_k(budget, nodes, request, power_w)
    if node == WALL_NODE:
        cap_k, credit = _wall_cap_k(budget, request.panel_k), heat.wall_transit_credit
        deficit_k = credit * heat.deficit_k
        peak_k, after_k = wall_credited_peak_k(budget, nodes, request, lower_bound_k, power_w), wall_k
        # The largest capacity, index 1: the slowest fall, which is the worse one here.
        rate, drive_k = heat.wall_w_per_k[pixel] / heat.wall_j_per_k[1], neighbours_w / heat.wall_w_per_k[pixel]
        cap_fall_k_per_s = heat.wall_per_panel * heat.panel_k_per_s
    else:
        cap_k, credit = _touch_cap_k(budget, request.panel_k), heat.touch_transit_credit
        deficit_k = credit * heat.deficit_k + heat.touch_deficit_k
        peak_k, after_k = _touch_credited_peak_k(budget, nodes, request, lower_bound_k, power_w)
        wall_increase_k = neighbours_w / heat.wall_j_per_k[0] * LOOK_AHEAD_TAUS * min_tau_s
        rate = 1.0 / heat.touch_lag_s[1]
        drive_k = heat.touch_per_wall_k * min(_wall_cap_k(budget, request.panel_k), wall_k + wall_increase_k)
        cap_fall_k_per_s = heat.touch_per_panel * heat.panel_k_per_s
    fall_k_per_s = rate * (after_k - drive_k) - cap_fall_k_per_s
    # No more than what arrives while y falls as fast: otherwise y − h would rise after the pulse.
    in_transit_k = min(credit * end_k - deficit_k, min_tau_s * fall_k_per_s)
    # Negative where neighbours warm the node: then nothing is credited, and the full bound decides.
    return bool(max(peak_k, after_k - max(0.0, in_transit_k)) <= cap_k)


@kernel
def wall_credited_peak_k(
    budget: Budget, nodes: ThermalNodes, request: PulseRequest, lower_bound_k: float, power_w: float
) -> float:
    """Return the peak bound on the pixel's wall during a pulse, less the heat still in the absorber."""
    heat, pixel = budget.heat, request.pixel
    peak_k = 0.0
    for capacity in range(2):
        rate = heat.wall_w_per_k[pixel] / heat.wall_j_per_k[capacity]
        # The steady rise by a pulse that never ends: within the pulse y relaxes towards it.
        steady_k = nodes.inflow_w[pixel] / heat.wall_w_per_k[pixel] + heat.wall_k_per_j[capacity] * power_w / rate
        peak_k = max(
            peak_k,
            _credited_peak_k(
                heat,
                request,
                lower_bound_k,
                power_w,
                nodes.wall_k[pixel, capacity],
                steady_k,
                rate,
                heat.wall_transit_credit / heat.wall_specht_ratio,
            ),
        )
    # The deficit is added once, outside the maximum over both capacities: it does not depend on them.
    peak_k = heat.wall_specht_ratio * peak_k + heat.wall_transit_credit * heat.deficit_k
    # A credit may only lower the bound, never raise it.
    return min(peak_k, wall_peak_k(budget, nodes, request, power_w))


@kernel
def _touch_credited_peak_k(
    budget: Budget, nodes: ThermalNodes, request: PulseRequest, lower_bound_k: float, power_w: float
) -> tuple[float, float]:
    """Return the peak bound on the touch surface during a pulse less in-transit heat, and its full bound at the end."""
    heat, pixel = budget.heat, request.pixel
    drive_k = heat.touch_per_wall_k * wall_credited_peak_k(budget, nodes, request, lower_bound_k, power_w)
    peak_k = bound_k = after_k = 0.0
    for lag in range(2):
        rate, heating_k_per_s = 1.0 / heat.touch_lag_s[lag], heat.touch_k_per_j[lag] * power_w
        before_k = nodes.touch_k[pixel, lag]
        end_k = touch_after_k(heat, nodes, pixel, lag, drive_k, request.width_s) + heating_k_per_s * request.width_s
        after_k, bound_k = max(after_k, end_k), max(bound_k, before_k, end_k)
        peak_k = max(
            peak_k,
            _credited_peak_k(
                heat,
                request,
                lower_bound_k,
                power_w,
                before_k,
                drive_k + heating_k_per_s / rate,
                rate,
                heat.touch_transit_credit / heat.touch_specht_ratio,
            ),
        )
    peak_k = heat.touch_specht_ratio * peak_k + heat.touch_transit_credit * heat.deficit_k + heat.touch_deficit_k
    return min(peak_k, heat.touch_specht_ratio * bound_k), heat.touch_specht_ratio * after_k


@kernel
def _credited_peak_k(
    heat: HeatBound,
    request: PulseRequest,
    lower_bound_k: float,
    power_w: float,
    before_k: float,
    steady_k: float,
    rate: float,
    credit: float,
) -> float:
    """Return the largest value of y − credit × u during a pulse.

    y relaxes from `before_k` to `steady_k`; u is the lower bound of the absorber's rise.
    """
    lower_steady_k = heat.lower_bound_k_per_w[request.pixel] * power_w
    lower_rate = heat.lower_bound_rate_per_s[request.pixel, 0 if lower_steady_k > lower_bound_k else 1]
    peak_k = before_k - credit * lower_bound_k
    node_fall, credit_fall = rate * (before_k - steady_k), credit * lower_rate * (lower_bound_k - lower_steady_k)
    at_s = request.width_s
    # First the end of the pulse, then the point in between if there is one: a second pass costs two exponentials and no
    # search.
    for _ in range(2):
        y_k = steady_k + (before_k - steady_k) * exp(-rate * at_s)
        u_k = lower_steady_k + (lower_bound_k - lower_steady_k) * exp(-lower_rate * at_s)
        peak_k = max(peak_k, y_k - credit * u_k)
        # If both fall, the difference may peak in between.
        if credit_fall > node_fall > 0.0 and lower_rate > rate:
            at_s = min(at_s, log(credit_fall / node_fall) / (lower_rate - rate))
    return float(peak_k)


@kernel
def wall_peak_k(budget: Budget, nodes: ThermalNodes, request: PulseRequest, power_w: float) -> float:
    """Return the peak bound on the pixel's wall over the panel during a pulse."""
    heat = budget.heat
    max_k = wall_bound_k(heat, nodes, request.pixel)
    for capacity in range(2):
        off_k = wall_after_k(heat, nodes, request.pixel, capacity, request.width_s)
        max_k = max(max_k, heat.wall_specht_ratio * (off_k + heat.wall_k_per_j[capacity] * power_w * request.width_s))
    return max_k
