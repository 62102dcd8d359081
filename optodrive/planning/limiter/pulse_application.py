"""A plan, pulse by pulse, through the bound: what each cap allows, and what a fired pulse leaves. Kernels."""

from typing import NamedTuple

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.planning.limiter.budget import Budget
from optodrive.planning.limiter.energy_windows import Chains, Pulses, allowed_w, append
from optodrive.planning.limiter.galvo_load import Motion, acceleration2_after, moved
from optodrive.planning.limiter.heat_bound import (
    Nodes,
    absorber_after_k,
    exchange,
    least_after_k,
    settle,
    touch_after_k,
    wall_after_k,
)
from optodrive.planning.limiter.slow_nodes import Ask, slow_nodes_allow, wall_during_k, wall_over_k

ROUNDING = 1e-9
"""Relative excess that floating-point rounding may cause; anything larger is a real excess."""
HALVINGS = 32


NOTHING, ABSORBER, WIDTH, ENERGY, SPOT, PIXEL_MEAN, DISPLAY_MEAN, WALL, TOUCH, GALVO, ORDER = range(11)
TRIM, STOP, FIRE = range(3)
"""What to do with a pulse that a cap does not allow: take power away, stop there, or count it all the same."""


class Spots(NamedTuple):
    """What each pixel's own pulses leave, and the mirrors; arrays are written to.

    bucket_j, on_s: [p] at the end of the pixel's last pulse; end_s: [1] end of the display's last pulse
    peak_k: [p] largest bound on the absorber so far
    mirror_rad: [2] where the mirrors stand; acceleration2, swing: [2], mirror_at_s: [1], see `mirrors.Motion`
    """

    bucket_j: FloatArray
    on_s: FloatArray
    end_s: FloatArray
    peak_k: FloatArray
    mirror_rad: FloatArray
    acceleration2: FloatArray
    swing: FloatArray
    mirror_at_s: FloatArray


class Before(NamedTuple):
    """A pixel as a pulse begins: absorber over wall, and that at least, K; bucket, J; light without a rest, s."""

    rise_k: float
    least_k: float
    bucket_j: float
    on_s: float


class Ledger(NamedTuple):
    """Everything that changes while a plan is walked through."""

    nodes: Nodes
    spots: Spots
    pulses: Pulses
    per_pixel: Chains
    display: Chains


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
        before = _before(budget, ledger, ask)
        if ask.power_w < budget.caps.least_w or ask.power_w <= 0.0:
            continue
        if policy != FIRE:
            most_w, binding = _allowed(budget, ledger, ask, before)
            if ask.power_w > most_w * (1 + ROUNDING):
                given_w[row], cause[row] = max(0.0, most_w), binding
                if policy == STOP or most_w < 0.0:
                    return row
                if given_w[row] < budget.caps.least_w:
                    given_w[row] = 0.0
        if given_w[row] > 0.0:
            _fire(budget, ledger, ask, given_w[row], before)
    return len(pixel)


@kernel
def _before(budget: Budget, ledger: Ledger, ask: Ask) -> Before:
    """The pixel as a pulse begins."""
    exchange(budget.heat, ledger.nodes, ask.start_s, budget.caps.pulse_width_s)
    settle(budget.heat, ledger.nodes, ask.pixel, ask.start_s)
    spots, pixel = ledger.spots, ask.pixel
    dark_s = max(0.0, ask.start_s - ledger.nodes.dark_since_s[pixel])
    rise_k = absorber_after_k(budget.heat, pixel, ledger.nodes.absorber_k[pixel], 0.0, dark_s)
    least_k = least_after_k(budget.heat, pixel, ledger.nodes.least_k[pixel], 0.0, dark_s)
    bucket_j = max(0.0, spots.bucket_j[pixel] - dark_s * budget.caps.pixel_mean_w)
    rested = dark_s >= budget.caps.pulse_rest_s - ROUNDING
    return Before(rise_k, least_k, bucket_j, 0.0 if rested else spots.on_s[pixel])


@kernel
def _allowed(budget: Budget, ledger: Ledger, ask: Ask, before: Before) -> tuple[float, int]:
    """Largest power the caps allow a pulse, W, and the cap that binds; below zero for a pulse no power makes right."""
    caps, width_s = budget.caps, ask.width_s
    if ask.start_s < ledger.spots.end_s[0] - ROUNDING:
        return -1.0, ORDER
    if width_s > caps.pulse_width_s * (1 + ROUNDING):
        return -1.0, WIDTH
    rise_k, least_k, bucket_j, on_s = before
    if on_s + width_s > caps.pulse_width_s + ROUNDING:
        return 0.0, WIDTH
    if _moves(ledger.spots, ask):
        motion = _motion(budget, ledger.spots, ask)
        after = acceleration2_after(budget.mirrors, motion, ask.start_s + width_s)
        if after > caps.galvo_rad2_per_s4 * (1 + ROUNDING):
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
    wall_w, touch_w = slow_nodes_allow(budget, ledger.nodes, ask, least_k)
    if wall_w < most_w:
        most_w, binding = wall_w, WALL
    if touch_w < most_w:
        most_w, binding = touch_w, TOUCH
    absorber_w = _absorber_allows(budget, ledger, ask, rise_k, min(most_w, ask.power_w))
    if absorber_w < min(most_w, ask.power_w):
        most_w, binding = absorber_w, ABSORBER
    return max(0.0, most_w), binding


@kernel
def _absorber_over_k(budget: Budget, ledger: Ledger, ask: Ask, rise_k: float, power_w: float) -> float:
    """Bound on the absorber during a pulse, above ambient."""
    own_k = max(rise_k, absorber_after_k(budget.heat, ask.pixel, rise_k, power_w, ask.width_s))
    return own_k + budget.heat.absorber_wall * wall_over_k(budget, ledger.nodes, ask, power_w)


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
def _moves(spots: Spots, ask: Ask) -> bool:
    return bool(ask.x_rad != spots.mirror_rad[0] or ask.y_rad != spots.mirror_rad[1])


@kernel
def _motion(budget: Budget, spots: Spots, ask: Ask) -> Motion:
    """The mirrors after the move to a pulse."""
    x2, y2 = spots.acceleration2[0], spots.acceleration2[1]
    before = Motion(x2, y2, spots.swing[0], spots.swing[1], spots.mirror_at_s[0])
    dx_rad, dy_rad = ask.x_rad - spots.mirror_rad[0], ask.y_rad - spots.mirror_rad[1]
    return moved(budget.mirrors, before, dx_rad, dy_rad, spots.end_s[0], ask.start_s)


@kernel
def _move(spots: Spots, ask: Ask, motion: Motion) -> None:
    spots.acceleration2[0], spots.acceleration2[1] = motion.x2, motion.y2
    spots.swing[0], spots.swing[1] = motion.x_swing, motion.y_swing
    spots.mirror_rad[0], spots.mirror_rad[1] = ask.x_rad, ask.y_rad
    spots.mirror_at_s[0] = motion.at_s


@kernel
def borne(
    budget: Budget, spots: Spots, start_s: FloatArray, width_s: FloatArray, x_rad: FloatArray, y_rad: FloatArray
) -> int:
    """How many of a plan's first pulses [n] have moves that the mirrors bear; the mirrors' part of spots is written."""
    for row in range(len(start_s)):
        ask = Ask(0, start_s[row], width_s[row], x_rad[row], y_rad[row], 0.0)
        if _moves(spots, ask):
            motion = _motion(budget, spots, ask)
            after = acceleration2_after(budget.mirrors, motion, ask.start_s + ask.width_s)
            if after > budget.caps.galvo_rad2_per_s4 * (1 + ROUNDING):
                return row
            _move(spots, ask, motion)
        spots.end_s[0] = ask.start_s + ask.width_s
    return len(start_s)


@kernel
def _fire(budget: Budget, ledger: Ledger, ask: Ask, power_w: float, before: Before) -> None:
    """Count a pulse as fired."""
    heat, nodes, spots, pixel = budget.heat, ledger.nodes, ledger.spots, ask.pixel
    rise_k, least_k, bucket_j, on_s = before
    end_s = ask.start_s + ask.width_s
    spots.peak_k[pixel] = max(spots.peak_k[pixel], _absorber_over_k(budget, ledger, ask, rise_k, power_w))
    nodes.absorber_k[pixel] = absorber_after_k(heat, pixel, rise_k, power_w, ask.width_s)
    drive_k = heat.touch_per_wall_k * wall_during_k(budget, ledger.nodes, ask, least_k, power_w)
    nodes.least_k[pixel] = least_after_k(heat, pixel, least_k, power_w, ask.width_s)
    if _moves(spots, ask):
        _move(spots, ask, _motion(budget, spots, ask))
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
    pulses = ledger.pulses
    row = pulses.fired[0]
    pulses.start_s[row], pulses.width_s[row] = ask.start_s, ask.width_s
    pulses.power_w[row], pulses.pixel[row] = power_w, pixel
    pulses.fired[0] = row + 1
    append(ledger.per_pixel, pixel, pulses, row)
    append(ledger.display, 0, pulses, row)
