"""The pulse that brings a pixel with terms to a displacement: `pulse_for_height` with a compiled integrator."""

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.physics.extended_pulses import advance_states, copy_states, peak_after_off_m, set_light
from optodrive.physics.pixel import Pixel
from optodrive.physics.pixel_ode import ActiveTerms
from optodrive.physics.pulse_for_height import choose_permitted, round_us
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
    is_fine: bool,
    min_duty: float,
    peak_after_s: float,
) -> tuple[float, float]:
    """Solve as `ExtendedThermalState.solve_pulse`, from the states work[0]. Return 0 periods if no pulse is needed.

    Until the pulse the light is where the context says, then on this pixel, `index`.
    on_states: [max_periods + 1, STATE_COUNT], work space for the states after each period at full power
    """
    copy_states(work[0], on_states[0])
    if _peak_after_state_m(pixel, active, c, work, on_states[0], off_s, peak_after_s) >= target_m:
        return 0.0, 0.0
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
    if is_fine and (high > min_periods or min_duty >= 1.0):
        widths_s = (low * period_s, high * period_s)
        share = _solve_share(pixel, active, c, work, on_states[0], target_m, max_power_w, *widths_s, peak_after_s)
        return 1e-6 * round_us(widths_s[0] + share * period_s) / period_s, 1.0
    width_s = high * period_s
    duty = _solve_share(pixel, active, c, work, on_states[0], target_m, max_power_w, width_s, width_s, peak_after_s)
    return choose_permitted(high, duty, min_periods, min_duty)


@kernel
def _solve_share(
    pixel: Pixel,
    active: ActiveTerms,
    c: FloatArray,
    work: FloatArray,
    state: FloatArray,
    target_m: float,
    max_power_w: float,
    min_width_s: float,
    width_s: float,
    peak_after_s: float,
) -> float:
    """Return the duty at which a pulse's peak is target_m, by the Illinois method, or 1 if none is.

    0 if what the laser still emits after its last pulse reaches the target as soon as the light is on the pixel.
    For a min_width_s below width_s, return the share of the way between these at which full power does it.
    """
    low, high = 0.0, 1.0
    is_by_width = min_width_s < width_s
    if is_by_width:
        low_error_m = _pulse_peak_m(pixel, active, c, work, state, max_power_w, min_width_s, peak_after_s) - target_m
    else:
        low_error_m = _peak_after_state_m(pixel, active, c, work, state, 0.0, peak_after_s) - target_m
    high_error_m = _pulse_peak_m(pixel, active, c, work, state, max_power_w, width_s, peak_after_s) - target_m
    if high_error_m <= 0.0:
        return 1.0
    if low_error_m >= 0.0:
        return 0.0
    retained_side = 0
    for _ in range(30):
        share = (low * high_error_m - high * low_error_m) / (high_error_m - low_error_m)
        power_w = max_power_w if is_by_width else share * max_power_w
        until_s = min_width_s + share * (width_s - min_width_s)
        error_m = _pulse_peak_m(pixel, active, c, work, state, power_w, until_s, peak_after_s) - target_m
        if abs(error_m) <= PEAK_TOLERANCE * target_m:
            return share
        if error_m > 0.0:
            high, high_error_m = share, error_m
            # Illinois: the end that stays twice counts half, or false position would creep from one side.
            low_error_m *= 0.5 if retained_side > 0 else 1.0
            retained_side = 1
        else:
            low, low_error_m = share, error_m
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
