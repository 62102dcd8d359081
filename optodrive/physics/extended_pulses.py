"""Pulses on pixels with terms: the states after them, their peaks, and the pulse that reaches a displacement.

Kernels over `pixel_ode.step`; `ExtendedThermalState` is their interface.
"""

import numpy as np

from optodrive.core.kernels import array_kernel, kernel
from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.physics.nominal_display import TIME_ROUNDING_S, pixel_at
from optodrive.physics.pixel import Pixel
from optodrive.physics.pixel_ode import ActiveTerms, interpolate_states, next_step_s, output_signal, step
from optodrive.physics.term import ABSORBER, ILLUMINATED_PIXEL, IS_TARGET, POWER_W

DISPLACEMENT_SIGNAL = 1
"""Number of the signal in `pixel_ode.output_signal`."""
DECAYED_SHARE, DECAYED_TIME_CONSTANTS = 0.7, 8.0
"""The peak after gate off is over once the displacement is below this share of it, after this many gas lags."""
COLD_K = 1e-6
"""Largest rise of a pixel that counts as cold."""
PEAK_TOLERANCE = 1e-5
"""Relative distance of a peak from its target that is accepted."""


@kernel
def advance_states(
    pixel: Pixel,
    active: ActiveTerms,
    c: FloatArray,
    is_target: bool,
    work: FloatArray,
    at_s: float,
    since_edge_s: float,
    duration_s: float,
) -> tuple[float, float]:
    """Advance the states work[0] by duration_s at the context's power; return the peaks meanwhile.

    since_edge_s: time since the last gate edge. The peaks are those of displacement, m, and absorber rise, K.
    """
    peak_m = output_signal(pixel, active, work[0], c, DISPLACEMENT_SIGNAL)
    peak_k = work[0, ABSORBER]
    done_s, after_edge = 0.0, True
    while done_s < duration_s:
        if c[POWER_W] == 0.0 and _is_cold(work[0]):
            work[0] = 0.0
            break
        h_s = next_step_s(pixel, active, since_edge_s + done_s)
        last = done_s + 1.3 * h_s >= duration_s
        if last:
            h_s = duration_s - done_s
        step(pixel, active, c, is_target, after_edge, at_s + done_s, since_edge_s + done_s, h_s, work)
        begin_m = output_signal(pixel, active, work[0], c, DISPLACEMENT_SIGNAL)
        end_m = output_signal(pixel, active, work[2], c, DISPLACEMENT_SIGNAL)
        interpolate_states(active.state_rows, work, 0.0, h_s, 0.5 * h_s)
        middle_m = output_signal(pixel, active, work[7], c, DISPLACEMENT_SIGNAL)
        peak_m = max(peak_m, end_m, _vertex_m(begin_m, middle_m, end_m))
        peak_k = max(peak_k, work[2, ABSORBER])
        copy_states(work[2], work[0])
        copy_states(work[3], work[1])
        after_edge = False
        done_s = duration_s if last else done_s + h_s
    return peak_m, peak_k


@kernel
def copy_states(source: FloatArray, target: FloatArray) -> None:
    """Copy the states [STATE_COUNT] of a pixel; an assignment of arrays would create one."""
    for row in range(len(source)):
        target[row] = source[row]


@kernel
def _is_cold(state: FloatArray) -> bool:
    """Return whether no rise of a pixel's state [STATE_COUNT] is as large as COLD_K."""
    for rise_k in state:  # noqa: SIM110 — compiled as it is, without a generator
        if not abs(rise_k) < COLD_K:
            return False
    return True


@kernel
def _vertex_m(begin_m: float, middle_m: float, end_m: float) -> float:
    """Return the vertex of the parabola through three points if it is a maximum between them, else the middle one."""
    bend = begin_m - 2.0 * middle_m + end_m
    half = 0.5 * (end_m - begin_m)
    if bend >= 0.0 or abs(half) > -bend:
        return middle_m
    return middle_m - 0.5 * half * half / bend


@kernel
def _peak_after_off_m(
    pixel: Pixel, active: ActiveTerms, c: FloatArray, work: FloatArray, since_edge_s: float, peak_after_s: float
) -> float:
    """Return the peak displacement, m, from peak_after_s after the states work[0] on; the gate is off."""
    c[POWER_W] = 0.0
    if peak_after_s > 0.0:
        advance_states(pixel, active, c, True, work, 0.0, since_edge_s, peak_after_s)
        since_edge_s += peak_after_s
    peak_m, done_s = output_signal(pixel, active, work[0], c, DISPLACEMENT_SIGNAL), 0.0
    interval_s = pixel.tau_g_s
    while True:
        interval_m = advance_states(pixel, active, c, True, work, done_s, since_edge_s + done_s, interval_s)[0]
        peak_m = max(peak_m, interval_m)
        done_s += interval_s
        has_decayed = done_s > DECAYED_TIME_CONSTANTS * pixel.tau_g_s
        if has_decayed and output_signal(pixel, active, work[0], c, DISPLACEMENT_SIGNAL) <= DECAYED_SHARE * peak_m:
            break
    return peak_m


@array_kernel
def apply_pulses(
    columns: FloatArray,
    at_s: FloatArray,
    off_s: FloatArray,
    states: FloatArray,
    neighbours: IntArray,
    active: ActiveTerms,
    context: FloatArray,
    pixel: IntArray,
    start_s: FloatArray,
    width_s: FloatArray,
    power_w: FloatArray,
    peak_m: FloatArray,
    peak_k: FloatArray,
    last_pulse: IntArray,
    begin: int,
    end: int,
) -> int:
    """Apply the pulses begin to end and fill in their peaks [n]; return the first that is out of order, or end.

    columns: [p, 6] the fields of `Pixel`; at_s, off_s, states: [p], [p], [p, STATE_COUNT] time of the last event,
    time since gate off at that event, and the states then; neighbours: [p, k] pixels that the light on a pixel also
    heats, −1 for none; last_pulse: [p] row of each pixel's last pulse so far, −1 for none
    """
    work, c = np.zeros((8, states.shape[1])), context.copy()
    for row in range(begin, end):
        for side in range(-1, neighbours.shape[1]):
            i = pixel[row] if side < 0 else neighbours[pixel[row], side]
            if i >= 0 and start_s[row] - at_s[i] < -TIME_ROUNDING_S:
                return row
        for side in range(-1, neighbours.shape[1]):
            is_target = side < 0
            i = pixel[row] if is_target else neighbours[pixel[row], side]
            if i < 0:
                continue
            one, wait_s = pixel_at(columns, i), max(0.0, start_s[row] - at_s[i])
            copy_states(states[i], work[0])
            c[POWER_W], c[ILLUMINATED_PIXEL], c[IS_TARGET] = 0.0, pixel[row], 1.0 if is_target else 0.0
            off_peak_m, _ = advance_states(one, active, c, is_target, work, 0.0, off_s[i], wait_s)
            if last_pulse[i] >= 0:
                peak_m[last_pulse[i]] = max(peak_m[last_pulse[i]], off_peak_m)
            before_k = work[0, ABSORBER]
            c[POWER_W] = power_w[row]
            on_peak_m, on_peak_k = advance_states(one, active, c, is_target, work, 0.0, 0.0, width_s[row])
            if is_target:
                last_pulse[i] = row
                peak_k[row] = max(before_k, on_peak_k)
            if last_pulse[i] >= 0:
                peak_m[last_pulse[i]] = max(peak_m[last_pulse[i]], on_peak_m)
            copy_states(work[0], states[i])
            at_s[i], off_s[i] = start_s[row] + width_s[row], 0.0
    return end


@array_kernel
def add_peaks_after_off(
    columns: FloatArray,
    states: FloatArray,
    active: ActiveTerms,
    context: FloatArray,
    last_pulse: IntArray,
    begin: int,
    end: int,
    peak_m: FloatArray,
) -> None:
    """Raise the peaks of the last pulses of the pixels begin to end by what follows after gate off."""
    work, c = np.zeros((8, states.shape[1])), context.copy()
    for i in range(begin, end):
        if last_pulse[i] >= 0:
            copy_states(states[i], work[0])
            c[ILLUMINATED_PIXEL], c[IS_TARGET] = i, 1.0
            off_peak_m = _peak_after_off_m(pixel_at(columns, i), active, c, work, 0.0, 0.0)
            peak_m[last_pulse[i]] = max(peak_m[last_pulse[i]], off_peak_m)


@array_kernel
def simulate_displacement(
    pixel: Pixel,
    active: ActiveTerms,
    c: FloatArray,
    index: int,
    at_s: float,
    off_s: float,
    state: FloatArray,
    pulses: FloatArray,
    t_s: FloatArray,
    displacement_m: FloatArray,
) -> None:
    """Fill in the displacement of pixel `index` at t_s [m], under pulses [n, 4] on it and on its neighbours.

    at_s, off_s, state: time of the last event, time since gate off at that event, and the states then
    """
    work = np.zeros((8, len(state)))
    copy_states(state, work[0])
    now_s, since_edge_s, row = at_s, off_s, 0
    for edge in range(2 * len(pulses) + 1):
        pulse, gate_on, is_target = edge // 2, edge % 2 == 1, True
        c[POWER_W], c[ILLUMINATED_PIXEL], c[IS_TARGET] = 0.0, index, 1.0
        until_s = np.inf
        if pulse < len(pulses):
            is_target = pulses[pulse, 3] == index
            c[ILLUMINATED_PIXEL], c[IS_TARGET] = pulses[pulse, 3], 1.0 if is_target else 0.0
            until_s = pulses[pulse, 0] + (pulses[pulse, 1] if gate_on else 0.0)
            c[POWER_W] = pulses[pulse, 2] if gate_on else 0.0
        while row < len(t_s) and t_s[row] <= until_s:
            duration_s = max(0.0, t_s[row] - now_s)
            advance_states(pixel, active, c, is_target, work, 0.0, since_edge_s, duration_s)
            now_s, since_edge_s = now_s + duration_s, since_edge_s + duration_s
            displacement_m[row] = output_signal(pixel, active, work[0], c, DISPLACEMENT_SIGNAL)
            row += 1
        if row == len(t_s):
            break
        advance_states(pixel, active, c, is_target, work, 0.0, since_edge_s, max(0.0, until_s - now_s))
        now_s, since_edge_s = max(now_s, until_s), 0.0


@kernel
def _peak_after_state_m(
    pixel: Pixel,
    active: ActiveTerms,
    c: FloatArray,
    work: FloatArray,
    state: FloatArray,
    since_edge_s: float,
    peak_after_s: float,
) -> float:
    """Return `_peak_after_off_m` from `state`, which stays as it is."""
    copy_states(state, work[0])
    return _peak_after_off_m(pixel, active, c, work, since_edge_s, peak_after_s)


@kernel
def find_shortest_pulse(
    pixel: Pixel,
    active: ActiveTerms,
    c: FloatArray,
    work: FloatArray,
    on_states: FloatArray,
    off_s: float,
    target_m: float,
    max_power_w: float,
    period_s: float,
    min_periods: int,
    max_periods: int,
    peak_after_s: float,
) -> tuple[int, float]:
    """Solve as `ExtendedThermalState.solve_pulse`, from the states work[0]; 0 periods if no pulse is needed.

    on_states: [max_periods + 1, STATE_COUNT], work space for the states after each period at full power
    """
    copy_states(work[0], on_states[0])
    if _peak_after_state_m(pixel, active, c, work, on_states[0], off_s, peak_after_s) >= target_m:
        return 0, 0.0
    high, highest_m = max_periods, 0.0
    copy_states(on_states[0], work[0])
    for period in range(max_periods):
        c[POWER_W] = max_power_w
        highest_m = advance_states(pixel, active, c, True, work, 0.0, period * period_s, period_s)[0]
        copy_states(work[0], on_states[period + 1])
        if highest_m >= target_m and peak_after_s <= 0.0:
            high = max(period + 1, min_periods)
            break
    low = min_periods - 1
    while high - low > 1:
        middle = (low + high) // 2
        after_off_s = max(0.0, peak_after_s - middle * period_s)
        if _peak_after_state_m(pixel, active, c, work, on_states[middle], 0.0, after_off_s) >= target_m:
            high = middle
        else:
            low = middle
    return high, _solve_duty(pixel, active, c, work, on_states[0], target_m, max_power_w, high * period_s, peak_after_s)


@kernel
def _solve_duty(
    pixel: Pixel,
    active: ActiveTerms,
    c: FloatArray,
    work: FloatArray,
    state: FloatArray,
    target_m: float,
    max_power_w: float,
    width_s: float,
    peak_after_s: float,
) -> float:
    """Return the duty at which a pulse's peak is target_m, by the Illinois method; 1 if none is."""
    low, high = 0.0, 1.0
    low_error_m = _peak_after_state_m(pixel, active, c, work, state, 0.0, peak_after_s) - target_m
    high_error_m = _pulse_peak_m(pixel, active, c, work, state, max_power_w, width_s, peak_after_s) - target_m
    if high_error_m <= 0.0:
        return 1.0
    retained_side = 0
    for _ in range(30):
        duty = (low * high_error_m - high * low_error_m) / (high_error_m - low_error_m)
        error_m = _pulse_peak_m(pixel, active, c, work, state, duty * max_power_w, width_s, peak_after_s) - target_m
        if abs(error_m) <= PEAK_TOLERANCE * target_m:
            return duty
        if error_m > 0.0:
            high, high_error_m = duty, error_m
            low_error_m *= 0.5 if retained_side > 0 else 1.0
            retained_side = 1
        else:
            low, low_error_m = duty, error_m
            high_error_m *= 0.5 if retained_side < 0 else 1.0
            retained_side = -1
    return high


@kernel
def _pulse_peak_m(
    pixel: Pixel,
    active: ActiveTerms,
    c: FloatArray,
    work: FloatArray,
    state: FloatArray,
    power_w: float,
    width_s: float,
    peak_after_s: float,
) -> float:
    """Return the peak displacement, m, of a pulse from `state`, counted from peak_after_s after its start."""
    copy_states(state, work[0])
    c[POWER_W] = power_w
    on_peak_m = advance_states(pixel, active, c, True, work, 0.0, 0.0, width_s)[0]
    off_peak_m = _peak_after_off_m(pixel, active, c, work, 0.0, max(0.0, peak_after_s - width_s))
    return max(on_peak_m, off_peak_m) if peak_after_s <= 0.0 else off_peak_m
