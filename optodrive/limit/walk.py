"""A plan, pulse by pulse, through the bound: what each cap allows, and what a fired pulse leaves. Kernels."""

from math import exp, inf, log
from typing import NamedTuple

from optodrive.compiled import kernel
from optodrive.flow import FloatArray, IntArray
from optodrive.limit.budget import Budget, HeatBound, Mirrors
from optodrive.limit.nodes import (
    Nodes,
    absorber_after_k,
    exchange,
    least_after_k,
    settle,
    touch_after_k,
    wall_after_k,
    wall_bound_k,
)
from optodrive.limit.windows import Chains, Pulses, allowed_w, append

ROUNDING = 1e-9
"""Relative excess that floating-point rounding may cause; anything larger is a real excess."""
HALVINGS = 50
FEWER_HALVINGS = 16
AHEAD = 2.0
"""How many of an absorber's own times a wall is looked ahead for its touch surface."""

NOTHING, ABSORBER, WIDTH, ENERGY, SPOT, PIXEL_MEAN, DISPLAY_MEAN, WALL, TOUCH, GALVO, ORDER = range(11)
TRIM, STOP, FIRE = range(3)
"""What to do with a pulse that a cap does not allow: take power away, stop there, or count it all the same."""


class Spots(NamedTuple):
    """What each pixel's own pulses leave, and the mirrors; arrays are written to.

    bucket_j, on_s: [p] at the end of the pixel's last pulse; end_s: [1] end of the display's last pulse
    peak_k: [p] largest bound on the absorber so far
    mirror_rad: [2] where the mirrors stand; acceleration2: [2] their mean-square acceleration at mirror_at_s [1]
    """

    bucket_j: FloatArray
    on_s: FloatArray
    end_s: FloatArray
    peak_k: FloatArray
    mirror_rad: FloatArray
    acceleration2: FloatArray
    mirror_at_s: FloatArray


class Ledger(NamedTuple):
    """Everything that changes while a plan is walked through."""

    nodes: Nodes
    spots: Spots
    pulses: Pulses
    per_pixel: Chains
    display: Chains


class Ask(NamedTuple):
    """One pulse as asked for."""

    pixel: int
    start_s: float
    width_s: float
    x_rad: float
    y_rad: float
    power_w: float


@kernel
def replay(ledger: Ledger) -> None:
    """Chain the pulses that were fired before the plan."""
    for row in range(ledger.pulses.fired[0]):
        append(ledger.per_pixel, ledger.pulses.pixel[row], ledger.pulses, row)
        append(ledger.display, 0, ledger.pulses, row)


@kernel
def walk(
    budget: Budget,
    ledger: Ledger,
    pixel: IntArray,
    start_s: FloatArray,
    width_s: FloatArray,
    x_rad: FloatArray,
    y_rad: FloatArray,
    power_w: FloatArray,
    policy: int,
    given_w: FloatArray,
    cause: IntArray,
) -> int:
    """Walk n pulses in order of time; the ledger, given_w and cause [n] are written. Returns how many were walked.

    Fewer than n under STOP: then given_w and cause of the next row say what would have been allowed, and by which cap.
    """
    for row in range(len(pixel)):
        ask = Ask(pixel[row], start_s[row], width_s[row], x_rad[row], y_rad[row], power_w[row])
        given_w[row], cause[row] = ask.power_w, NOTHING
        if policy != FIRE:
            most_w, binding = _allowed(budget, ledger, ask)
            if ask.power_w > most_w * (1 + ROUNDING):
                given_w[row], cause[row] = max(0.0, most_w), binding
                if policy == STOP or most_w < 0.0:
                    return row
        if given_w[row] > 0.0:
            _fire(budget, ledger, ask, given_w[row])
    return len(pixel)


@kernel
def _before(budget: Budget, ledger: Ledger, ask: Ask) -> tuple[float, float, float, float]:
    """The pixel as a pulse begins: absorber over wall, and that at least (K), bucket (J), light without a rest (s)."""
    exchange(budget.heat, ledger.nodes, ask.start_s, budget.caps.pulse_width_s)
    settle(budget.heat, ledger.nodes, ask.pixel, ask.start_s)
    spots, pixel = ledger.spots, ask.pixel
    dark_s = max(0.0, ask.start_s - ledger.nodes.dark_since_s[pixel])
    rise_k = absorber_after_k(budget.heat, pixel, ledger.nodes.absorber_k[pixel], 0.0, dark_s)
    least_k = least_after_k(budget.heat, pixel, ledger.nodes.least_k[pixel], 0.0, dark_s)
    bucket_j = max(0.0, spots.bucket_j[pixel] - dark_s * budget.caps.pixel_mean_w)
    rested = dark_s >= budget.caps.pulse_rest_s - ROUNDING
    return rise_k, least_k, bucket_j, 0.0 if rested else spots.on_s[pixel]


@kernel
def _allowed(budget: Budget, ledger: Ledger, ask: Ask) -> tuple[float, int]:
    """Largest power the caps allow a pulse, W, and the cap that binds; below zero for a pulse no power makes right."""
    caps, width_s = budget.caps, ask.width_s
    if ask.start_s < ledger.spots.end_s[0] - ROUNDING:
        return -1.0, ORDER
    if width_s > caps.pulse_width_s * (1 + ROUNDING):
        return -1.0, WIDTH
    rise_k, least_k, bucket_j, on_s = _before(budget, ledger, ask)
    if on_s + width_s > caps.pulse_width_s + ROUNDING:
        return 0.0, WIDTH
    if max(_accelerated(budget.mirrors, ledger.spots, ask)) > caps.galvo_rad2_per_s4 * (1 + ROUNDING):
        return 0.0, GALVO
    most_w, binding = caps.pulse_energy_j / width_s, ENERGY
    spot_w = (caps.pulse_energy_j - bucket_j) / width_s
    if spot_w < most_w:
        most_w, binding = spot_w, SPOT
    pixel_w = allowed_w(
        ledger.per_pixel, ask.pixel, ledger.pulses, ask.start_s, width_s, caps.pixel_window_s, caps.pixel_mean_w
    )
    if pixel_w < most_w:
        most_w, binding = pixel_w, PIXEL_MEAN
    display_w = allowed_w(
        ledger.display, 0, ledger.pulses, ask.start_s, width_s, caps.display_window_s, caps.display_mean_w
    )
    if display_w < most_w:
        most_w, binding = display_w, DISPLAY_MEAN
    wall_w, touch_w = _slow_nodes_allow(budget, ledger, ask, least_k)
    if wall_w < most_w:
        most_w, binding = wall_w, WALL
    if touch_w < most_w:
        most_w, binding = touch_w, TOUCH
    absorber_w = _absorber_allows(budget, ledger, ask, rise_k, min(most_w, ask.power_w))
    if absorber_w < min(most_w, ask.power_w):
        most_w, binding = absorber_w, ABSORBER
    return max(0.0, most_w), binding


@kernel
def _wall_cap_k(budget: Budget) -> float:
    """No wall may be warmer than the touch surface can bear for ever: then no later moment in the dark is too warm."""
    per_wall = budget.heat.touch_per_wall_k * budget.heat.touch_spread
    return min(budget.caps.wall_k, budget.caps.touch_k / per_wall) if per_wall > 0.0 else budget.caps.wall_k


@kernel
def _slow_nodes_allow(budget: Budget, ledger: Ledger, ask: Ask, least_k: float) -> tuple[float, float]:
    """Largest power for wall and touch surface.

    First as if all its heat had arrived by the pulse's end; where that is too little, less the heat on its way.
    """
    heat, nodes, pixel, width_s = budget.heat, ledger.nodes, ask.pixel, ask.width_s
    wall_w = touch_w = inf
    cap_k = _wall_cap_k(budget) / heat.wall_spread
    for capacity in range(2):
        if heat.wall_k_per_j[capacity] > 0.0:
            dark_k = wall_after_k(heat, nodes, pixel, capacity, width_s)
            wall_w = min(wall_w, (cap_k - dark_k) / (heat.wall_k_per_j[capacity] * width_s))
    wall_k = _wall_over_k(budget, ledger, ask, 0.0)
    wall_k_per_w = heat.wall_spread * heat.wall_k_per_j[0] * width_s
    for lag in range(2):
        if heat.touch_k_per_j[lag] > 0.0:
            caught_up = 1.0 - exp(-width_s / heat.touch_lag_s[lag])
            dark_k = touch_after_k(heat, nodes, pixel, lag, heat.touch_per_wall_k * wall_k, width_s)
            k_per_w = heat.touch_k_per_j[lag] * width_s + heat.touch_per_wall_k * wall_k_per_w * caught_up
            touch_w = min(touch_w, (budget.caps.touch_k / heat.touch_spread - dark_k) / k_per_w)
    if wall_w < ask.power_w:
        wall_w = _borne_w(budget, ledger, ask, least_k, WALL, max(0.0, wall_w))
    if touch_w < ask.power_w:
        touch_w = _borne_w(budget, ledger, ask, least_k, TOUCH, max(0.0, touch_w))
    return wall_w, touch_w


@kernel
def _borne_w(budget: Budget, ledger: Ledger, ask: Ask, least_k: float, node: int, sure_w: float) -> float:
    """The largest power, from sure_w up to what is asked for, that a wall or touch surface bears."""
    if _bears(budget, ledger, ask, least_k, node, ask.power_w):
        return ask.power_w
    low_w, high_w = sure_w, ask.power_w
    for _ in range(FEWER_HALVINGS):
        middle_w = 0.5 * (low_w + high_w)
        if _bears(budget, ledger, ask, least_k, node, middle_w):
            low_w = middle_w
        else:
            high_w = middle_w
    return low_w


@kernel
def _bears(budget: Budget, ledger: Ledger, ask: Ask, least_k: float, node: int, power_w: float) -> bool:
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
    wall_k = _wall_over_k(budget, ledger, ask, power_w)
    if node == WALL:
        cap_k, part, lost_k = _wall_cap_k(budget), heat.wall_flight, heat.wall_flight * heat.lost_k
        highest_k, after_k = _wall_during_k(budget, ledger, ask, least_k, power_w), wall_k
        rate, drive_k = heat.wall_w_per_k[pixel] / heat.wall_j_per_k[1], neighbours_w / heat.wall_w_per_k[pixel]
    else:
        cap_k, part = budget.caps.touch_k, heat.touch_flight
        lost_k = part * heat.lost_k + heat.touch_lost_k
        highest_k, after_k = _touch_during_k(budget, ledger, ask, least_k, power_w)
        warmer_k = neighbours_w / heat.wall_j_per_k[0] * AHEAD * quickest_s
        rate, drive_k = 1.0 / heat.touch_lag_s[1], heat.touch_per_wall_k * min(_wall_cap_k(budget), wall_k + warmer_k)
    on_its_way_k = min(part * end_k - lost_k, rate * quickest_s * (after_k - drive_k))
    return bool(max(highest_k, after_k - max(0.0, on_its_way_k)) <= cap_k)


@kernel
def _wall_during_k(budget: Budget, ledger: Ledger, ask: Ask, least_k: float, power_w: float) -> float:
    """The pixel's wall at most during a pulse, less the heat still in the absorber."""
    heat, nodes, pixel = budget.heat, ledger.nodes, ask.pixel
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
    return min(highest_k, _wall_over_k(budget, ledger, ask, power_w))


@kernel
def _touch_during_k(budget: Budget, ledger: Ledger, ask: Ask, least_k: float, power_w: float) -> tuple[float, float]:
    """The pixel's touch surface at most during a pulse, less the heat on its way; and its bound at the pulse's end."""
    heat, nodes, pixel = budget.heat, ledger.nodes, ask.pixel
    drive_k = heat.touch_per_wall_k * _wall_during_k(budget, ledger, ask, least_k, power_w)
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
def _wall_over_k(budget: Budget, ledger: Ledger, ask: Ask, power_w: float) -> float:
    """Bound on the pixel's wall during a pulse."""
    heat, nodes = budget.heat, ledger.nodes
    most_k = wall_bound_k(heat, nodes, ask.pixel)
    for capacity in range(2):
        dark_k = wall_after_k(heat, nodes, ask.pixel, capacity, ask.width_s)
        most_k = max(most_k, heat.wall_spread * (dark_k + heat.wall_k_per_j[capacity] * power_w * ask.width_s))
    return most_k


@kernel
def _absorber_over_k(budget: Budget, ledger: Ledger, ask: Ask, rise_k: float, power_w: float) -> float:
    """Bound on the absorber during a pulse, above ambient."""
    own_k = max(rise_k, absorber_after_k(budget.heat, ask.pixel, rise_k, power_w, ask.width_s))
    return own_k + budget.heat.absorber_wall * _wall_over_k(budget, ledger, ask, power_w)


@kernel
def _absorber_allows(budget: Budget, ledger: Ledger, ask: Ask, rise_k: float, wanted_w: float) -> float:
    """wanted_w where the absorber bears it, else the largest power that it bears, W."""
    cap_k = budget.caps.absorber_k
    if wanted_w <= 0.0 or _absorber_over_k(budget, ledger, ask, rise_k, wanted_w) <= cap_k:
        return wanted_w
    low_w, high_w = 0.0, wanted_w
    for _ in range(HALVINGS):
        middle_w = 0.5 * (low_w + high_w)
        if _absorber_over_k(budget, ledger, ask, rise_k, middle_w) <= cap_k:
            low_w = middle_w
        else:
            high_w = middle_w
    return low_w


@kernel
def _accelerated(mirrors: Mirrors, spots: Spots, ask: Ask) -> tuple[float, float]:
    """Mean-square acceleration of x and y after the move to a pulse, rad²/s⁴; zero where there is no move."""
    dx_rad, dy_rad = abs(ask.x_rad - spots.mirror_rad[0]), abs(ask.y_rad - spots.mirror_rad[1])
    if dx_rad == 0.0 and dy_rad == 0.0:
        return 0.0, 0.0
    dx_rad, dy_rad = dx_rad + mirrors.code_rad, dy_rad + mirrors.code_rad
    move_s = mirrors.settle_s + max(dx_rad, dy_rad) / mirrors.slew_rad_per_s
    kept = exp(-max(0.0, ask.start_s - move_s - spots.mirror_at_s[0]) / mirrors.mean_s)
    # Full acceleration over half the time, full braking over the other: a = 4 d / t², on for t.
    x2 = spots.acceleration2[0] * kept + 16.0 * dx_rad**2 / move_s**3 / mirrors.mean_s
    y2 = spots.acceleration2[1] * kept + 16.0 * dy_rad**2 / move_s**3 / mirrors.mean_s
    return x2, y2


@kernel
def _fire(budget: Budget, ledger: Ledger, ask: Ask, power_w: float) -> None:
    """Count a pulse as fired."""
    heat, nodes, spots, pixel = budget.heat, ledger.nodes, ledger.spots, ask.pixel
    rise_k, least_k, bucket_j, on_s = _before(budget, ledger, ask)
    end_s = ask.start_s + ask.width_s
    spots.peak_k[pixel] = max(spots.peak_k[pixel], _absorber_over_k(budget, ledger, ask, rise_k, power_w))
    nodes.absorber_k[pixel] = absorber_after_k(heat, pixel, rise_k, power_w, ask.width_s)
    drive_k = heat.touch_per_wall_k * _wall_during_k(budget, ledger, ask, least_k, power_w)
    nodes.least_k[pixel] = least_after_k(heat, pixel, least_k, power_w, ask.width_s)
    nodes.dark_since_s[pixel] = spots.end_s[0] = end_s

    for lag in range(2):
        touch_k = touch_after_k(heat, nodes, pixel, lag, drive_k, ask.width_s)
        nodes.touch_k[pixel, lag] = touch_k + heat.touch_k_per_j[lag] * power_w * ask.width_s
    for capacity in range(2):
        wall_k = wall_after_k(heat, nodes, pixel, capacity, ask.width_s)
        nodes.wall_k[pixel, capacity] = wall_k + heat.wall_k_per_j[capacity] * power_w * ask.width_s
    nodes.nodes_at_s[pixel] = end_s

    spots.bucket_j[pixel] = max(0.0, bucket_j + (power_w - budget.caps.pixel_mean_w) * ask.width_s)
    spots.on_s[pixel] = on_s + ask.width_s
    if ask.x_rad != spots.mirror_rad[0] or ask.y_rad != spots.mirror_rad[1]:
        spots.acceleration2[0], spots.acceleration2[1] = _accelerated(budget.mirrors, spots, ask)
        spots.mirror_rad[0], spots.mirror_rad[1] = ask.x_rad, ask.y_rad
        spots.mirror_at_s[0] = ask.start_s

    pulses = ledger.pulses
    row = pulses.fired[0]
    pulses.start_s[row], pulses.width_s[row] = ask.start_s, ask.width_s
    pulses.power_w[row], pulses.pixel[row] = power_w, pixel
    pulses.fired[0] = row + 1
    append(ledger.per_pixel, pixel, pulses, row)
    append(ledger.display, 0, pulses, row)
