"""Stepped pixels: what a pulse brings, what the dark after it does, and which pulse reaches a height.

Kernels over `forward.step`; `ExtendedHeat` is their face.
"""

import numpy as np

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.physics.nominal_display import TIME_ROUNDING_S, one_pixel
from optodrive.physics.pixel import Pixel
from optodrive.physics.pixel_ode import Active, outputs, sample, step, step_s
from optodrive.physics.term import ABSORBER, MINE, PIXEL, POWER_W

DISPLACEMENT = 1
"""Number of the signal in `forward.outputs`."""
SETTLED_SHARE, SETTLED = 0.7, 8.0
"""In the dark a membrane below this share of its largest displacement so many gas time constants later is past it."""
AT_REST_K = 1e-6
CLOSE = 1e-5
"""A peak this close to its target, relative, is there."""


@kernel
def carry(
    pixel: Pixel, active: Active, c: FloatArray, own: bool, room: FloatArray, at_s: float, since_s: float, for_s: float
) -> tuple[float, float]:
    """Advance the states room[0] by for_s under the context's power; the most the membrane and the absorber do.

    since_s: time since the light last changed; displacement in m, absorber in K.
    """
    peak_m = outputs(pixel, active, room[0], c, DISPLACEMENT)
    peak_k = room[0, ABSORBER]
    done_s, fresh = 0.0, True
    while done_s < for_s:
        if c[POWER_W] == 0.0 and np.abs(room[0]).max() < AT_REST_K:
            room[0] = 0.0
            break
        h_s = step_s(pixel, active, since_s + done_s)
        last = done_s + 1.3 * h_s >= for_s
        if last:
            h_s = for_s - done_s
        step(pixel, active, c, own, fresh, at_s + done_s, since_s + done_s, h_s, room)
        begin_m = outputs(pixel, active, room[0], c, DISPLACEMENT)
        end_m = outputs(pixel, active, room[2], c, DISPLACEMENT)
        sample(active.rows, room, 0.0, h_s, 0.5 * h_s)
        middle_m = outputs(pixel, active, room[7], c, DISPLACEMENT)
        peak_m = max(peak_m, end_m, _vertex_m(begin_m, middle_m, end_m))
        peak_k = max(peak_k, room[2, ABSORBER])
        room[0] = room[2]
        room[1] = room[3]
        fresh = False
        done_s = for_s if last else done_s + h_s
    return peak_m, peak_k


@kernel
def _vertex_m(begin_m: float, middle_m: float, end_m: float) -> float:
    """Top of the parabola through three points, where it lies between them; else the middle one."""
    bend = begin_m - 2.0 * middle_m + end_m
    half = 0.5 * (end_m - begin_m)
    if bend >= 0.0 or abs(half) > -bend:
        return middle_m
    return middle_m - 0.5 * half * half / bend


@kernel
def _afterglow_m(pixel: Pixel, active: Active, c: FloatArray, room: FloatArray, since_s: float, from_s: float) -> float:
    """The most the membrane does in the dark, from_s after the states room[0] or later; the states move."""
    c[POWER_W] = 0.0
    if from_s > 0.0:
        carry(pixel, active, c, True, room, 0.0, since_s, from_s)
        since_s += from_s
    peak_m, done_s = outputs(pixel, active, room[0], c, DISPLACEMENT), 0.0
    piece_s = pixel.tau_g_s
    while True:
        here_m = carry(pixel, active, c, True, room, done_s, since_s + done_s, piece_s)[0]
        peak_m = max(peak_m, here_m)
        done_s += piece_s
        settled = done_s > SETTLED * pixel.tau_g_s
        if settled and outputs(pixel, active, room[0], c, DISPLACEMENT) <= SETTLED_SHARE * peak_m:
            break
    return peak_m


@kernel
def walk(
    columns: FloatArray,
    at_s: FloatArray,
    dark_s: FloatArray,
    states: FloatArray,
    beside: IntArray,
    active: Active,
    context: FloatArray,
    pixel: IntArray,
    start_s: FloatArray,
    width_s: FloatArray,
    power_w: FloatArray,
    peak_m: FloatArray,
    peak_k: FloatArray,
    last: IntArray,
    begin: int,
    end: int,
) -> int:
    """Heat by the pulses begin to end, fill in their peaks [n]; the first that came too early, or end.

    columns: [p, 6] the fields of `Pixel`; at_s, dark_s, states: [p], [p], [p, STATES] the last event, how long it had
    been dark before it, and the states then; beside: [p, k] pixels that feel this one's light, −1 for none;
    last: [p] each pixel's last pulse so far, −1 for none.
    """
    room, c = np.zeros((8, states.shape[1])), context.copy()
    for row in range(begin, end):
        for side in range(-1, beside.shape[1]):
            i = pixel[row] if side < 0 else beside[pixel[row], side]
            if i >= 0 and start_s[row] - at_s[i] < -TIME_ROUNDING_S:
                return row
        for side in range(-1, beside.shape[1]):
            own = side < 0
            i = pixel[row] if own else beside[pixel[row], side]
            if i < 0:
                continue
            one, wait_s = one_pixel(columns, i), max(0.0, start_s[row] - at_s[i])
            room[0] = states[i]
            c[POWER_W], c[PIXEL], c[MINE] = 0.0, pixel[row], 1.0 if own else 0.0
            glow_m, _ = carry(one, active, c, own, room, 0.0, dark_s[i], wait_s)
            if last[i] >= 0:
                peak_m[last[i]] = max(peak_m[last[i]], glow_m)
            before_k = room[0, ABSORBER]
            c[POWER_W] = power_w[row]
            lit_m, lit_k = carry(one, active, c, own, room, 0.0, 0.0, width_s[row])
            if own:
                last[i] = row
                peak_k[row] = max(before_k, lit_k)
            if last[i] >= 0:
                peak_m[last[i]] = max(peak_m[last[i]], lit_m)
            states[i] = room[0]
            at_s[i], dark_s[i] = start_s[row] + width_s[row], 0.0
    return end


@kernel
def glow(
    columns: FloatArray,
    states: FloatArray,
    active: Active,
    context: FloatArray,
    last: IntArray,
    begin: int,
    end: int,
    peak_m: FloatArray,
) -> None:
    """What the last pulses of the pixels begin to end still bring in the dark after them."""
    room, c = np.zeros((8, states.shape[1])), context.copy()
    for i in range(begin, end):
        if last[i] >= 0:
            room[0] = states[i]
            c[PIXEL], c[MINE] = i, 1.0
            glow_m = _afterglow_m(one_pixel(columns, i), active, c, room, 0.0, 0.0)
            peak_m[last[i]] = max(peak_m[last[i]], glow_m)


@kernel
def heights(
    pixel: Pixel,
    active: Active,
    c: FloatArray,
    index: int,
    at_s: float,
    dark_s: float,
    state: FloatArray,
    pulses: FloatArray,
    t_s: FloatArray,
    height_m: FloatArray,
) -> None:
    """Fill in the displacement of pixel `index` at t_s [m], under pulses [n, 4] on it and beside it.

    at_s, dark_s, state: its last event, how long it had been dark before it, and the states then; state is written.
    """
    room = np.zeros((8, len(state)))
    room[0] = state
    now_s, since_s, row = at_s, dark_s, 0
    for edge in range(2 * len(pulses) + 1):
        pulse, lit, own = edge // 2, edge % 2 == 1, True
        c[POWER_W], c[PIXEL], c[MINE] = 0.0, index, 1.0
        until_s = np.inf
        if pulse < len(pulses):
            own = pulses[pulse, 3] == index
            c[PIXEL], c[MINE] = pulses[pulse, 3], 1.0 if own else 0.0
            until_s = pulses[pulse, 0] + (pulses[pulse, 1] if lit else 0.0)
            c[POWER_W] = pulses[pulse, 2] if lit else 0.0
        while row < len(t_s) and t_s[row] <= until_s:
            for_s = max(0.0, t_s[row] - now_s)
            carry(pixel, active, c, own, room, 0.0, since_s, for_s)
            now_s, since_s = now_s + for_s, since_s + for_s
            height_m[row] = outputs(pixel, active, room[0], c, DISPLACEMENT)
            row += 1
        if row == len(t_s):
            break
        carry(pixel, active, c, own, room, 0.0, since_s, max(0.0, until_s - now_s))
        now_s, since_s = max(now_s, until_s), 0.0


@kernel
def _peak_after_m(
    pixel: Pixel, active: Active, c: FloatArray, room: FloatArray, state: FloatArray, since_s: float, from_s: float
) -> float:
    room[0] = state
    return _afterglow_m(pixel, active, c, room, since_s, from_s)


@kernel
def shortest(
    pixel: Pixel,
    active: Active,
    c: FloatArray,
    room: FloatArray,
    lit: FloatArray,
    dark_s: float,
    goal_m: float,
    max_power_w: float,
    period_s: float,
    least_periods: int,
    max_periods: int,
    from_s: float,
) -> tuple[int, float]:
    """As pulse_for_peak, from the states room[0]; no periods where no pulse is needed.

    lit: [max_periods + 1, STATES] room for the states after each period at full power: one path holds all widths.
    """
    lit[0] = room[0]
    if _peak_after_m(pixel, active, c, room, lit[0], dark_s, from_s) >= goal_m:
        return 0, 0.0
    high, highest_m = max_periods, 0.0
    room[0] = lit[0]
    for period in range(max_periods):
        c[POWER_W] = max_power_w
        highest_m = carry(pixel, active, c, True, room, 0.0, period * period_s, period_s)[0]
        lit[period + 1] = room[0]
        if highest_m >= goal_m and from_s <= 0.0:
            high = max(period + 1, least_periods)
            break
    low = least_periods - 1
    while high - low > 1:
        middle = (low + high) // 2
        dark_from_s = max(0.0, from_s - middle * period_s)
        if _peak_after_m(pixel, active, c, room, lit[middle], 0.0, dark_from_s) >= goal_m:
            high = middle
        else:
            low = middle
    return high, _duty(pixel, active, c, room, lit[0], goal_m, max_power_w, high * period_s, from_s)


@kernel
def _duty(
    pixel: Pixel,
    active: Active,
    c: FloatArray,
    room: FloatArray,
    state: FloatArray,
    goal_m: float,
    max_power_w: float,
    width_s: float,
    from_s: float,
) -> float:
    """The duty at which a pulse's peak is goal_m, by the Illinois form of false position; 1 where none is."""
    low, high = 0.0, 1.0
    short_m = _peak_after_m(pixel, active, c, room, state, 0.0, from_s) - goal_m
    over_m = _pulse_peak_m(pixel, active, c, room, state, max_power_w, width_s, from_s) - goal_m
    if over_m <= 0.0:
        return 1.0
    kept = 0
    for _ in range(30):
        duty = (low * over_m - high * short_m) / (over_m - short_m)
        miss_m = _pulse_peak_m(pixel, active, c, room, state, duty * max_power_w, width_s, from_s) - goal_m
        if abs(miss_m) <= CLOSE * goal_m:
            return duty
        if miss_m > 0.0:
            high, over_m = duty, miss_m
            short_m *= 0.5 if kept > 0 else 1.0
            kept = 1
        else:
            low, short_m = duty, miss_m
            over_m *= 0.5 if kept < 0 else 1.0
            kept = -1
    return high


@kernel
def _pulse_peak_m(
    pixel: Pixel,
    active: Active,
    c: FloatArray,
    room: FloatArray,
    state: FloatArray,
    power_w: float,
    width_s: float,
    from_s: float,
) -> float:
    room[0] = state
    c[POWER_W] = power_w
    lit_m = carry(pixel, active, c, True, room, 0.0, 0.0, width_s)[0]
    dark_m = _afterglow_m(pixel, active, c, room, 0.0, max(0.0, from_s - width_s))
    return max(lit_m, dark_m) if from_s <= 0.0 else dark_m
