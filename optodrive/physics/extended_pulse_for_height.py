"""The pulse that brings a pixel with terms to a displacement: `pulse_for_height` with a compiled integrator."""

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.physics.extended_pulses import advance_states, copy_states, peak_after_off_m, set_light
from optodrive.physics.pixel import Pixel
from optodrive.physics.pixel_ode import ActiveTerms
from optodrive.physics.term import POWER_W

PEAK_TOLERANCE = 1e-5
"""Relative distance of a peak from its target that is accepted."""


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
    """Return `peak_after_off_m` from `state`, which stays as it is."""
    copy_states(state, work[0])
    return peak_after_off_m(pixel, active, c, work, since_edge_s, peak_after_s)


@kernel
def find_shortest_pulse(
    pixel: Pixel,
    active: ActiveTerms,
    c: FloatArray,
    index: int,
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
    """Solve as `ExtendedThermalState.solve_pulse`, from the states work[0]. Return 0 periods if no pulse is needed.

    Until the pulse the light is where the context says, then on this pixel, `index`.
    on_states: [max_periods + 1, STATE_COUNT], work space for the states after each period at full power
    """
    copy_states(work[0], on_states[0])
    if _peak_after_state_m(pixel, active, c, work, on_states[0], off_s, peak_after_s) >= target_m:
        return 0, 0.0
    set_light(c, index, index)
    high, highest_m = max_periods, 0.0
    copy_states(on_states[0], work[0])
    for period in range(max_periods):
        c[POWER_W] = max_power_w
        highest_m = advance_states(pixel, active, c, work, 0.0, period * period_s, period_s)[0]
        copy_states(work[0], on_states[period + 1])
        # Reached while the light is on: longer pulses only rise further, so the search ends here.
        if highest_m >= target_m and peak_after_s <= 0.0:
            high = max(period + 1, min_periods)
            break
    # One period less is known to be too short, or not permitted.
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
    """Return the duty at which a pulse's peak is target_m, by the Illinois method, or 1 if none is.

    0 if what the laser still emits after its last pulse reaches the target as soon as the light is on the pixel.
    """
    low, high = 0.0, 1.0
    low_error_m = _peak_after_state_m(pixel, active, c, work, state, 0.0, peak_after_s) - target_m
    high_error_m = _pulse_peak_m(pixel, active, c, work, state, max_power_w, width_s, peak_after_s) - target_m
    if high_error_m <= 0.0:
        return 1.0
    if low_error_m >= 0.0:
        return 0.0
    retained_side = 0
    for _ in range(30):
        duty = (low * high_error_m - high * low_error_m) / (high_error_m - low_error_m)
        error_m = _pulse_peak_m(pixel, active, c, work, state, duty * max_power_w, width_s, peak_after_s) - target_m
        if abs(error_m) <= PEAK_TOLERANCE * target_m:
            return duty
        if error_m > 0.0:
            high, high_error_m = duty, error_m
            # Illinois: the end that stays twice counts half, or false position would creep from one side.
            low_error_m *= 0.5 if retained_side > 0 else 1.0
            retained_side = 1
        else:
            low, low_error_m = duty, error_m
            high_error_m *= 0.5 if retained_side < 0 else 1.0
            retained_side = -1
    # The end above the target: a pulse rather reaches too much than too little.
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
    on_peak_m = advance_states(pixel, active, c, work, 0.0, 0.0, width_s)[0]
    off_peak_m = peak_after_off_m(pixel, active, c, work, 0.0, max(0.0, peak_after_s - width_s))
    return max(on_peak_m, off_peak_m) if peak_after_s <= 0.0 else off_peak_m
