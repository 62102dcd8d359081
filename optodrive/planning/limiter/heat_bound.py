"""Upper bounds on absorber, wall and touch surface temperatures, in closed form between two events. Kernels.

Theory of operation

Problem. A pulse that is granted now heats its absorber for 30 ms, its wall for seconds, its neighbours for longer and
the panel for minutes. Nothing that is granted may ever pass a cap, for no parameters within the declared uncertainty,
and a pulse must be judged in microseconds. Simulating the future of every pixel for every pulse is out of the question.

Comparison principle. The nodes form a cooperative system: a higher temperature of one node never lowers another one
later. A supersolution, which starts above the solution and never rises more slowly or falls faster, therefore stays
above it at all times. Every function here advances a supersolution, except the lower bound of the absorber's rise. Its
coefficients are the worst of the parameter box (`worst_case.py`), so it holds for all parameters at once.

Nodes. The absorber's rise over its wall is integrated along chords below the bridge's concave loss, each an
exponential: warming with the smallest capacity, cooling with the largest. Walls and touch surfaces get a pulse's heat
at once, at its end, increased so that the bound stays above heat that arrives later. Their capacity or lag is uncertain
in a direction that changes (a small one warms faster, a large one keeps heat longer), so each carries two bounds, one
per end; between the ends no sum of responses exceeds the larger by more than Specht's ratio. The panel does likewise,
and everything else is bounded over it.

Time. Every pixel has a time of its own (`nodes_at_s`) and is advanced when it is touched: a plan of thousands of pulses
must not touch 1,511 pixels for each. Only the exchange between walls couples pixels. It runs in steps shorter than the
fastest wall's time constant, growing while nothing is driven, and leaves each pixel an upper bound on its inflow for
the step and one more pulse (`inflow_w`): a fixed-point bound, from all walls as warm as the warmest to what that inflow
allows. So between two exchanges a pixel depends on no other.

Invariants. Bounds are never below the truth and never lowered but by cooling at the slowest rate. `panel_at_s`,
`exchanged_at_s` and `nodes_at_s` never go back. Pulses of another stage may overlap: a pixel's own time then lies ahead
(`_wall_since_k`).

Decision: 41 (stages).
"""

from math import exp, inf, log
from typing import NamedTuple

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.planning.limiter.budget import HeatBound

COOLING_STEP_GROWTH = 1.1
"""Largest ratio of two successive exchange steps while the gate is off."""


class ThermalNodes(NamedTuple):
    """Temperature bounds of all nodes while a plan is applied. The arrays are modified.

    absorber_k, lower_bound_k: [p] upper and lower bound of the absorber's rise over its wall at last_pulse_end_s [p]
    wall_k, touch_k: [p, 2] bounds for the smallest and the largest capacity or lag, at nodes_at_s [p]
    inflow_w: [p] upper bound on the heat flow from neighbours until the next exchange
    panel_k: [2] bounds of the panel for its smallest and largest capacity, at panel_at_s [1]; walls and touch surfaces
    are bounded over the panel
    exchanged_at_s: [1] time of the last exchange between walls; coarse_k, refined_k: [p] scratch arrays
    """

    absorber_k: FloatArray
    lower_bound_k: FloatArray
    last_pulse_end_s: FloatArray
    wall_k: FloatArray
    touch_k: FloatArray
    nodes_at_s: FloatArray
    inflow_w: FloatArray
    exchanged_at_s: FloatArray
    panel_k: FloatArray
    panel_at_s: FloatArray
    coarse_k: FloatArray
    refined_k: FloatArray


@kernel
def absorber_after_k(heat: HeatBound, pixel: int, rise_k: float, power_w: float, time_s: float) -> float:
    """Return the absorber's rise over its wall after `time_s` at constant power, along the chords below the loss.

    Warming uses the smallest heat capacity, cooling the largest.
    """
    r_k_per_w = heat.r_k_per_w[pixel]
    drive_w = heat.epsilon[pixel] * power_w
    last = len(heat.knot_k) - 2
    chord = 0
    while chord < last and heat.knot_k[chord + 1] <= rise_k:
        chord += 1
    remaining_s = time_s
    while True:
        low_k, high_k = heat.knot_k[chord], heat.knot_k[chord + 1]
        slope = (heat.loss_k[chord + 1] - heat.loss_k[chord]) / (high_k - low_k) / r_k_per_w
        steady_k = low_k + (drive_w - heat.loss_k[chord] / r_k_per_w) / slope
        warms = steady_k > rise_k
        # The worse end for each direction: neither has to be the true capacity.
        rate = slope / (heat.c_low_j_per_k[pixel] if warms else heat.c_high_j_per_k[pixel])
        end_k = steady_k + (rise_k - steady_k) * exp(-rate * remaining_s)
        # The exponential of a chord holds up to its end: solve for the time at which it is reached, and go on with the
        # next one.
        if warms and end_k > high_k and chord < last:
            remaining_s -= log((steady_k - rise_k) / (steady_k - high_k)) / rate
            rise_k, chord = high_k, chord + 1
        elif not warms and end_k < low_k and chord > 0:
            remaining_s -= log((rise_k - steady_k) / (low_k - steady_k)) / rate
            rise_k, chord = low_k, chord - 1
        else:
            return float(end_k)
        if remaining_s <= 0.0:
            # Rounding at a knot may leave a negative rest: the time ends there.
            return float(rise_k)


@kernel
def lower_bound_after_k(heat: HeatBound, pixel: int, lower_bound_k: float, power_w: float, time_s: float) -> float:
    """Return the lower bound of the absorber's rise over its wall after `time_s` at constant power."""
    steady_k = heat.lower_bound_k_per_w[pixel] * power_w
    rate = heat.lower_bound_rate_per_s[pixel, 0 if steady_k > lower_bound_k else 1]
    return float(steady_k + (lower_bound_k - steady_k) * exp(-rate * time_s))


@kernel
def panel_peak_k(heat: HeatBound, panel_k: FloatArray, off_s: float, energy_j: float) -> float:
    """Return the bound on the panel's rise during a pulse, and at all times after it with the gate off.

    panel_k: [2] bounds off_s before the pulse
    """
    peak_k = 0.0
    for capacity in range(2):
        before_k = panel_k[capacity] * exp(-max(0.0, off_s) / heat.panel_tau_s[capacity])
        peak_k = max(peak_k, before_k + heat.panel_k_per_j[capacity] * energy_j)
    # All of the energy counts at the start: during the pulse and after it the panel is no warmer.
    return float(heat.panel_specht_ratio * peak_k)


@kernel
def warm_panel(heat: HeatBound, nodes: ThermalNodes, start_s: float, width_s: float, energy_j: float) -> None:
    """Advance the panel to the start of a pulse, with as much heat as leaves the pulse's own at its end."""
    off_s = max(0.0, start_s - nodes.panel_at_s[0])
    for capacity in range(2):
        nodes.panel_k[capacity] *= exp(-off_s / heat.panel_tau_s[capacity])
        own_k = heat.panel_k_per_j[capacity] * energy_j
        # The panel keeps its time at the pulse's start, because a pulse of another stage may begin before this one
        # ends.
        nodes.panel_k[capacity] += own_k * exp(width_s / heat.panel_tau_s[capacity])
    nodes.panel_at_s[0] = max(start_s, nodes.panel_at_s[0])


@kernel
def panel_rise_by_others_k(heat: HeatBound, stage: int, width_s: float) -> float:
    """Return by how much the pulses of other stages may warm the panel during a pulse, K."""
    all_w = heat.power_max_w.sum()
    # The own pulse is counted by its energy; others may emit throughout it, and as early or late as their clocks are
    # off.
    return float(heat.panel_k_per_s * (all_w - heat.power_max_w[stage]) / all_w * (width_s + heat.skew_s))


@kernel
def wall_bound_k(heat: HeatBound, nodes: ThermalNodes, pixel: int) -> float:
    """Return the bound on the wall's rise over the panel at its own time for every capacity within the uncertainty."""
    return float(heat.wall_specht_ratio * max(nodes.wall_k[pixel, 0], nodes.wall_k[pixel, 1]))


@kernel
def wall_after_k(heat: HeatBound, nodes: ThermalNodes, pixel: int, capacity: int, time_s: float) -> float:
    """Return one of a wall's two bounds `time_s` after its own time, with the gate off."""
    steady_k = nodes.inflow_w[pixel] / heat.wall_w_per_k[pixel]
    rate = heat.wall_w_per_k[pixel] / heat.wall_j_per_k[capacity]
    return float(steady_k + (nodes.wall_k[pixel, capacity] - steady_k) * exp(-rate * time_s))


@kernel
def touch_after_k(heat: HeatBound, nodes: ThermalNodes, pixel: int, lag: int, drive_k: float, time_s: float) -> float:
    """Return one of a touch surface's two bounds `time_s` later, driven towards `drive_k`."""
    return float(drive_k + (nodes.touch_k[pixel, lag] - drive_k) * exp(-time_s / heat.touch_lag_s[lag]))


@kernel
def advance_pixel(heat: HeatBound, nodes: ThermalNodes, pixel: int, to_s: float) -> None:
    """Advance a pixel's wall and touch surface to a later time, with the gate off."""
    time_s = to_s - nodes.nodes_at_s[pixel]
    if time_s <= 0.0:
        return
    rate_w_per_k = heat.wall_w_per_k[pixel]
    _relax(
        heat,
        nodes,
        pixel,
        exp(-rate_w_per_k / heat.wall_j_per_k[0] * time_s),
        exp(-rate_w_per_k / heat.wall_j_per_k[1] * time_s),
        exp(-time_s / heat.touch_lag_s[0]),
        exp(-time_s / heat.touch_lag_s[1]),
    )
    nodes.nodes_at_s[pixel] = to_s


@kernel
def _relax(
    heat: HeatBound, nodes: ThermalNodes, pixel: int, wall_0: float, wall_1: float, touch_0: float, touch_1: float
) -> None:
    """Reduce the distances of wall and touch surface from their steady values to the given fractions."""
    steady_k = nodes.inflow_w[pixel] / heat.wall_w_per_k[pixel]
    walls_k, touch_k = nodes.wall_k[pixel], nodes.touch_k[pixel]
    before_k = max(walls_k[0], walls_k[1])
    # Walls before touch surfaces: these are driven by the larger of a wall's values at both ends of the interval.
    walls_k[0] = steady_k + (walls_k[0] - steady_k) * wall_0
    walls_k[1] = steady_k + (walls_k[1] - steady_k) * wall_1
    # A wall is monotone between events, so its maximum lies at one end.
    drive_k = heat.touch_per_wall_k * heat.wall_specht_ratio * max(before_k, walls_k[0], walls_k[1])
    touch_k[0] = drive_k + (touch_k[0] - drive_k) * touch_0
    touch_k[1] = drive_k + (touch_k[1] - drive_k) * touch_1


@kernel
def _advance_all(heat: HeatBound, nodes: ThermalNodes, from_s: float, to_s: float) -> None:
    """Advance every pixel to a later time. Pixels without a pulse since `from_s` share their decay factors."""
    cached_w_per_k, wall_0, wall_1 = -1.0, 1.0, 1.0
    touch_0 = exp(-(to_s - from_s) / heat.touch_lag_s[0])
    touch_1 = exp(-(to_s - from_s) / heat.touch_lag_s[1])
    for pixel in range(len(nodes.nodes_at_s)):
        # A pixel that had a pulse since the last exchange has a time of its own, and pays for its own exponentials.
        if nodes.nodes_at_s[pixel] != from_s:
            advance_pixel(heat, nodes, pixel, to_s)
            continue
        rate_w_per_k = heat.wall_w_per_k[pixel]
        if cached_w_per_k != rate_w_per_k:
            cached_w_per_k = rate_w_per_k
            wall_0 = exp(-rate_w_per_k / heat.wall_j_per_k[0] * (to_s - from_s))
            wall_1 = exp(-rate_w_per_k / heat.wall_j_per_k[1] * (to_s - from_s))
        _relax(heat, nodes, pixel, wall_0, wall_1, touch_0, touch_1)
        nodes.nodes_at_s[pixel] = to_s


@kernel
def exchange_wall_heat(heat: HeatBound, nodes: ThermalNodes, to_s: float, pulse_width_s: float) -> None:
    """Exchange heat between walls up to `to_s` in steps. `inflow_w` then holds for one step and one more pulse."""
    if heat.exchange_step_s == inf:  # no walls
        return
    if nodes.exchanged_at_s[0] == -inf:
        # Cold until now: one step back is as good as any time, because nothing has flowed.
        nodes.exchanged_at_s[0] = to_s - heat.exchange_step_s
    step_s = heat.exchange_step_s
    while to_s - nodes.exchanged_at_s[0] >= heat.exchange_step_s:
        now_s = nodes.exchanged_at_s[0] + step_s
        # All pixels first, then their flows: a flow from walls of different times is the bound of none.
        _advance_all(heat, nodes, nodes.exchanged_at_s[0], now_s)
        nodes.exchanged_at_s[0] = now_s
        remaining_s = to_s - now_s
        if remaining_s >= heat.exchange_step_s:
            step_s = min(COOLING_STEP_GROWTH * step_s, remaining_s)
            # A long dark time: steps grow, since walls that cool exchange less and less.
            _update_inflow(heat, nodes, now_s, step_s, 0.0)
        else:
            # The flow is used until the next exchange, and a pulse that begins just before it is judged with it up to
            # its end.
            horizon_s = heat.exchange_step_s + pulse_width_s + heat.skew_s
            max_pulse_k = heat.wall_specht_ratio * heat.wall_k_per_j[0] * heat.power_max_w.sum() * horizon_s
            _update_inflow(heat, nodes, now_s, horizon_s, max_pulse_k)


@kernel
def _update_inflow(heat: HeatBound, nodes: ThermalNodes, now_s: float, horizon_s: float, pulses_k: float) -> None:
    """Update the upper bound on the heat flow from neighbours from `now_s` on, during `horizon_s`.

    pulses_k: total rise of the walls by all pulses in that time.

    Two iterations of a fixed-point bound: all walls are first assumed as warm as the warmest one, then as warm as the
    resulting inflow allows.
    """
    pixels = len(nodes.inflow_w)
    warmest_k = pulses_k
    for pixel in range(pixels):
        # Every pulse of the step might fall on the warmest wall: which one is not known yet.
        warmest_k = max(warmest_k, _wall_since_k(heat, nodes, pixel, now_s) + pulses_k)
    for pixel in range(pixels):
        neighbour_count = 0
        for side in range(4):
            if heat.neighbours[pixel, side] >= 0:
                neighbour_count += 1
        nodes.coarse_k[pixel] = _max_wall_k(
            heat, nodes, pixel, heat.lateral_w_per_k * neighbour_count * warmest_k, now_s, horizon_s
        )
    for pixel in range(pixels):
        nodes.refined_k[pixel] = _max_wall_k(
            heat, nodes, pixel, _lateral_inflow_w(heat, nodes.coarse_k, pixel, pulses_k), now_s, horizon_s
        )
    for pixel in range(pixels):
        nodes.inflow_w[pixel] = _lateral_inflow_w(heat, nodes.refined_k, pixel, pulses_k)


@kernel
def _lateral_inflow_w(heat: HeatBound, walls_k: FloatArray, pixel: int, pulses_k: float) -> float:
    sum_k = pulses_k
    for side in range(4):
        other = heat.neighbours[pixel, side]
        if other >= 0:
            sum_k += walls_k[other]
    return heat.lateral_w_per_k * sum_k


@kernel
def _wall_since_k(heat: HeatBound, nodes: ThermalNodes, pixel: int, now_s: float) -> float:
    """Return the bound on a wall from `now_s` until its own time, the end of a pulse that another stage may overlap.

    The pulse's heat counts as arrived at its end, and the wall was warmer before by what it lost meanwhile.
    """
    wall_k, ahead_s = wall_bound_k(heat, nodes, pixel), nodes.nodes_at_s[pixel] - now_s
    if ahead_s <= 0.0:
        return wall_k
    return float(wall_k * exp(heat.wall_w_per_k[pixel] / heat.wall_j_per_k[0] * ahead_s))


@kernel
def _max_wall_k(
    heat: HeatBound, nodes: ThermalNodes, pixel: int, inflow_w: float, now_s: float, time_s: float
) -> float:
    """Return the largest rise that a wall reaches within `time_s` by its inflow alone."""
    wall_k = _wall_since_k(heat, nodes, pixel, now_s)
    steady_k = inflow_w / heat.wall_w_per_k[pixel]
    fraction = min(1.0, heat.wall_w_per_k[pixel] / heat.wall_j_per_k[0] * time_s)
    return float(wall_k + fraction * max(0.0, steady_k - wall_k))
