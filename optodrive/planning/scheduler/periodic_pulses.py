"""Pulse recipes of trains by height, from the periodic steady state that the display's own thermal model computes.

A pulse is normally planned for the peak of its cycle. In short cycles the membrane still rises from one pulse when the
next one starts, so the peak belongs to the previous pulse; planned for it, every other pulse would be omitted for good.
Such pulses are planned for a later displacement of the steady cycle: pulses of fixed width from its peak on, pulses of
free width at the start of the next pulse, because planning for an earlier one makes wide and narrow pulses alternate.
Cycles that are not steady, the first ones above all, then have other peaks. A pulse whose peak would differ by more
than `PEAK_DEVIATION` is planned for a peak that differs by so much, if the next cycles do not pay for it.

Widths are whole PWM periods. If the gate-off time between pulses is short, one more period changes the peak-to-peak
value considerably. A lead period, one weaker PWM period before the pulse, provides values between two widths.
"""

from dataclasses import dataclass, replace
from math import ceil

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.quantity import format_quantity, m_to_um
from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.stimuli import HeightTrain
from optodrive.physics.pulse_for_height import DriveRange
from optodrive.physics.thermal_state import ThermalState

SETTLING_TAUS = 10.0
"""Number of the pixel's relaxation times after which cycles repeat."""
SAMPLES = 400
"""Samples per steady cycle."""
EARLY_PEAK_FRACTION = 0.8
"""A pulse on a cold pixel that peaks before this fraction of the period can be planned for its peak."""
PEAK_DEVIATION = 0.01
"""Relative deviation of a cycle's peak from its target up to which a pulse is planned for the steady cycle alone."""
FORESEEN_CYCLES = 3
"""Cycles after a pulse whose peaks decide between two pulses."""
CORRECTIONS = (1.0, 0.5)
"""Fractions of the way from the steady cycle's pulse to the one with the largest permitted deviation."""
MIN_IMPROVEMENT = 0.9
"""A pulse replaces that of the steady cycle if it reduces the largest deviation to this fraction."""
MAX_POWER_CORRECTIONS, PEAK_TOLERANCE = 6, 1e-4
"""Number of corrections of a steady pulse's power, and the relative error of the peak at which they stop."""
PEAK_TO_PEAK_TOLERANCE = 0.01
"""Relative error of the peak-to-peak value up to which no lead period is needed."""
WIDENING_THRESHOLD = 0.99
"""A pulse that reaches this fraction of its target at its present width is not widened."""
BISECTIONS = 8
"""Bisections of the lead period's relative duty."""
MIN_REFERENCE_S = 1e-9
"""Smallest time after a pulse's start at which its displacement is taken."""
Shape = tuple[float, float]
"""Width in PWM periods and duty of a pulse."""


@dataclass(frozen=True)
class PulseRecipe:
    """Arguments of `ThermalState.solve_pulse` for every pulse of a train.

    target_m, min_periods: displacement to plan for, and smallest width in PWM periods
    from_s: time after the pulse's start from which on the displacement counts
    lead_period_w: power of the lead period, 0 for none
    """

    target_m: float
    min_periods: int = 1
    from_s: float = 0.0
    lead_period_w: float = 0.0


@dataclass(frozen=True)
class PeriodicSteadyState:
    """A cycle that repeats.

    periods, duty, lead_duty: width in PWM periods and duty of the pulse, and duty of its lead period
    peak_m, trough_m: largest and smallest displacement
    reference_m, reference_s: displacement at a time after the pulse's start at which it depends on this pulse's energy
    """

    periods: float
    duty: float
    lead_duty: float
    peak_m: float
    trough_m: float
    reference_m: float
    reference_s: float

    @property
    def peak_to_peak_m(self) -> float:
        """Fall of the membrane between two peaks, m."""
        return self.peak_m - self.trough_m


def build_pulse_recipe(train: HeightTrain, cold_heat: ThermalState, drive: DriveRange, where: str) -> PulseRecipe:
    """Compute the recipe of a train's pulses.

    drive.max_periods is the longest pulse that fits into a cycle.

    Raises InputError (target_unreachable, bad_train) if no steady cycle has the train's height or peak-to-peak value.
    """
    periods, lead_ratio = _find_min_periods(train, cold_heat, drive, where), 0.0
    min_periods = 1
    if train.peak_to_peak_m is not None:
        periods, lead_ratio = _find_peak_to_peak_shape(train, cold_heat, drive, periods, where)
        min_periods = periods
    first = cold_heat.solve_pulse(train.pixel, 0.0, train.target_m, drive, min_periods)
    steady_state = solve_steady_state(train, cold_heat, drive, periods, lead_ratio)
    if steady_state.duty < drive.min_duty:
        weakest = compute_steady_state(train, cold_heat, drive, periods, drive.min_duty)
        expected = f"at least {m_to_um(weakest.peak_m):.4g} µm, the height of the weakest pulses that the laser emits"
        raise InputError(f"{where}.target_um", round(m_to_um(train.target_m), 3), expected, code="bad_train")
    lead_period_w = steady_state.lead_duty * drive.max_power_w
    # A peak within the cycle: the usual way, planned for the peak itself.
    if first is None or _find_first_peak_s(train, cold_heat, drive, *first) <= EARLY_PEAK_FRACTION * train.period_s:
        return PulseRecipe(train.target_m, min_periods, lead_period_w=lead_period_w)
    return PulseRecipe(steady_state.reference_m, min_periods, steady_state.reference_s, lead_period_w)


def compute_next_pulse(
    train: HeightTrain, recipe: PulseRecipe, heat: ThermalState, start_s: float, drive: DriveRange
) -> Shape | None:
    """Compute width (PWM periods) and duty of the train's next pulse at `start_s` from the residual heat.

    Returns None if the target is already reached. The width stays fixed for a given peak-to-peak value; adapting it per
    pulse would cause a period-2 limit cycle.
    """
    shapes = _solve_alternatives(train, recipe, heat, start_s, drive)
    if len(shapes) == 1:
        return shapes[0]
    deviations = [_foresee_deviation(train, recipe, heat, start_s, drive, each, FORESEEN_CYCLES) for each in shapes]
    best = int(np.argmin(deviations))
    # The steady cycle's pulse unless another is clearly better: small changes at each pulse would make a cycle of their
    # own.
    return shapes[best] if deviations[best] < MIN_IMPROVEMENT * deviations[0] else shapes[0]


def _solve_alternatives(
    train: HeightTrain, recipe: PulseRecipe, heat: ThermalState, start_s: float, drive: DriveRange
) -> list[Shape | None]:
    """Solve for the steady cycle's pulse and, if its peak deviates too far, for pulses whose peaks deviate less."""
    pulse = _solve_pulse(train, recipe, heat, start_s, drive)
    if recipe.from_s == 0.0:
        return [pulse]
    steady_width = bounded_width = _compute_full_power_width(pulse)
    for sign in (-1.0, 1.0):
        bound = PulseRecipe(train.target_m * (1.0 + sign * PEAK_DEVIATION), recipe.min_periods)
        width = _compute_full_power_width(_solve_pulse(train, bound, heat, start_s, drive))
        bounded_width = max(bounded_width, width) if sign < 0.0 else min(bounded_width, width)
    shapes = [pulse]
    for fraction in CORRECTIONS if bounded_width != steady_width else ():
        width = steady_width + fraction * (bounded_width - steady_width)
        shapes.append(drive.build_pulse(width, recipe.min_periods))
    return shapes


def _solve_pulse(
    train: HeightTrain, recipe: PulseRecipe, heat: ThermalState, start_s: float, drive: DriveRange
) -> Shape | None:
    """Solve for the pulse of a recipe, without regard to the peaks of other cycles."""
    shape = (drive, recipe.min_periods, recipe.from_s)
    pulse = heat.solve_pulse(train.pixel, start_s, recipe.target_m, *shape)
    if train.peak_to_peak_m is None or pulse is None or pulse[0] <= recipe.min_periods:
        return pulse
    lower_pulse = heat.solve_pulse(train.pixel, start_s, WIDENING_THRESHOLD * recipe.target_m, *shape)
    # Up to 1 % short at full power is not widened: the next pulse would be narrower, and the train alternate.
    return pulse if lower_pulse is not None and lower_pulse[0] > recipe.min_periods else (recipe.min_periods, 1.0)


def _compute_full_power_width(pulse: Shape | None) -> float:
    """Return the width at full power that has a pulse's energy, PWM periods."""
    return 0.0 if pulse is None else pulse[0] * pulse[1]


def _foresee_deviation(
    train: HeightTrain,
    recipe: PulseRecipe,
    heat: ThermalState,
    start_s: float,
    drive: DriveRange,
    pulse: Shape | None,
    cycles: int,
) -> float:
    """Return the largest relative deviation of the peak of a cycle that begins with `pulse`, and of further `cycles`.

    The next pulse is the best of its alternatives, and those after it are the steady cycle's.
    """
    heat, next_s = heat.copy(), start_s + train.period_s
    periods, duty = pulse or (1, 0.0)
    pulses = [(start_s, periods * drive.period_s, duty * drive.max_power_w)]
    if recipe.lead_period_w:
        pulses.append((next_s - drive.period_s, drive.period_s, recipe.lead_period_w))
    start, width, power = np.array([*pulses, (next_s, 0.0, 0.0)]).T
    peaks_m = heat.apply_pulses(np.full(len(start), train.pixel), start, width, power).displacement_m
    deviation = abs(float(peaks_m[:-1].max()) / train.target_m - 1.0)
    if not cycles:
        return deviation
    given = (train, recipe, heat, next_s, drive)
    shapes = _solve_alternatives(*given)[: None if cycles == FORESEEN_CYCLES else 1]
    return max(deviation, min(_foresee_deviation(*given, each, cycles - 1) for each in shapes))


def compute_steady_state(
    train: HeightTrain, cold_heat: ThermalState, drive: DriveRange, periods: float, duty: float, lead_duty: float = 0.0
) -> PeriodicSteadyState:
    """Simulate the steady state of identical pulses in every cycle.

    lead_duty: duty of the lead period, 0 for none
    """
    pixel = cold_heat.pixels.elements[train.pixel]
    # Simulated and not solved in closed form: with terms there is none, and both models take the same way.
    count = 2 + ceil(SETTLING_TAUS * (pixel.tau_s + pixel.tau_g_s) / train.period_s)
    lead_s = drive.period_s if lead_duty else 0.0
    shapes = [(lead_s, periods * drive.period_s, duty)] + ([(0.0, lead_s, lead_duty)] if lead_duty else [])
    pulses = np.zeros((count, len(shapes), 4))
    for k, (offset_s, width_s, pulse_duty) in enumerate(reversed(shapes)):
        pulses[:, k, 0] = train.period_s * np.arange(count) + offset_s
        pulses[:, k, 1], pulses[:, k, 2] = width_s, pulse_duty * drive.max_power_w
    pulses[:, :, 3] = train.pixel
    earlier, last = pulses[:-1].reshape(-1, 4), pulses[-1]
    heat = cold_heat.copy()
    heat.apply_pulses(np.full(len(earlier), train.pixel), earlier[:, 0], earlier[:, 1], earlier[:, 2])
    t_s = last[0, 0] + train.period_s * np.linspace(0.0, 2.0, 2 * SAMPLES + 1)  # after the cycle, no further pulse
    height_m = heat.simulate_displacement_m(last, train.pixel, t_s)
    cycle_m = height_m[: SAMPLES + 1]
    # Fixed width: from the peak on. Free width: at the next pulse, because planned for an earlier height, wide and
    # narrow pulses alternate.
    reference = int(cycle_m.argmax()) if train.peak_to_peak_m is not None else SAMPLES
    reference_s = max(MIN_REFERENCE_S, float(t_s[reference] - t_s[0]) - lead_s)
    reference_m = float(height_m[reference:].max())
    return PeriodicSteadyState(
        periods, duty, lead_duty, float(cycle_m.max()), float(cycle_m.min()), reference_m, reference_s
    )


def solve_steady_state(
    train: HeightTrain, cold_heat: ThermalState, drive: DriveRange, periods: int, lead_ratio: float = 0.0
) -> PeriodicSteadyState:
    """Solve for the duty of pulses of the given width whose steady peak is the target, or return full power.

    The pulses of a laser that is on or off are shorter instead. lead_ratio: duty of the lead period over the duty of
    the pulse.
    """
    share, steady_state = 1.0, compute_steady_state(train, cold_heat, drive, periods, 1.0, lead_ratio)
    for _ in range(MAX_POWER_CORRECTIONS):
        if abs(steady_state.peak_m / train.target_m - 1.0) < PEAK_TOLERANCE:
            break
        # Displacement is nearly proportional to energy, so a few steps suffice.
        before, share = share, min(1.0, share * train.target_m / steady_state.peak_m)
        if share == before:
            break
        shape: Shape = (periods * share, 1.0) if drive.is_on_off else (periods, share)
        steady_state = compute_steady_state(train, cold_heat, drive, *shape, lead_ratio * share)
    return steady_state


def _find_min_periods(train: HeightTrain, cold_heat: ThermalState, drive: DriveRange, where: str) -> int:
    """Return the width of the shortest pulse whose steady cycle at full power reaches the target, PWM periods."""
    low, high = 0, drive.max_periods
    max_m = compute_steady_state(train, cold_heat, drive, high, 1.0).peak_m
    if max_m < train.target_m:
        raise InputError(
            f"{where}.target_um",
            round(m_to_um(train.target_m), 3),
            f"at most {m_to_um(max_m):.0f} µm, the height of pulses of "
            f"{format_quantity(high * drive.period_s, 's', 4)} at {format_quantity(drive.max_power_w, 'W')} "
            f"every {format_quantity(train.period_s, 's', 4)}",
            code="target_unreachable",
        )
    while high - low > 1:
        middle = (low + high) // 2
        if compute_steady_state(train, cold_heat, drive, middle, 1.0).peak_m >= train.target_m:
            high = middle
        else:
            low = middle
    return high


def _find_peak_to_peak_shape(
    train: HeightTrain, cold_heat: ThermalState, drive: DriveRange, min_periods: int, where: str
) -> tuple[int, float]:
    """Find the width, PWM periods, and the lead ratio of the steady cycle with the requested peak-to-peak value.

    The peak-to-peak value decreases with the width.
    """
    target_m = train.peak_to_peak_m or 0.0
    peak_to_peak_m = {
        n: solve_steady_state(train, cold_heat, drive, n).peak_to_peak_m for n in (min_periods, drive.max_periods)
    }
    low, high = min_periods, drive.max_periods
    for bound_m, is_out_of_range, word, kind in (
        (peak_to_peak_m[low], target_m > peak_to_peak_m[low] * (1.0 + PEAK_TOLERANCE), "at most", "shortest"),
        (peak_to_peak_m[high], target_m < peak_to_peak_m[high] * (1.0 - PEAK_TOLERANCE), "at least", "longest"),
    ):
        if is_out_of_range:
            raise InputError(
                f"{where}.peak_to_peak_um",
                round(m_to_um(target_m), 3),
                f"{word} {m_to_um(bound_m):.4g} µm, the value of the {kind} pulses to {m_to_um(train.target_m):.4g} µm "
                f"every {format_quantity(train.period_s, 's', 4)}",
                code="bad_train",
            )
    while high - low > 1:
        middle = (low + high) // 2
        peak_to_peak_m[middle] = solve_steady_state(train, cold_heat, drive, middle).peak_to_peak_m
        if peak_to_peak_m[middle] >= target_m:
            low = middle
        else:
            high = middle
    nearest = min((low, high), key=lambda n: abs(peak_to_peak_m[n] - target_m))
    # A lead period costs a pulse per cycle, and is left out where a whole period is near enough.
    if abs(peak_to_peak_m[nearest] - target_m) <= PEAK_TO_PEAK_TOLERANCE * target_m:
        return nearest, 0.0
    low_ratio, high_ratio = 0.0, 1.0
    for _ in range(BISECTIONS):
        ratio = 0.5 * (low_ratio + high_ratio)
        if solve_steady_state(train, cold_heat, drive, low, ratio).peak_to_peak_m >= target_m:
            low_ratio = ratio
        else:
            high_ratio = ratio
    ratio = 0.5 * (low_ratio + high_ratio)
    lead_duty = solve_steady_state(train, cold_heat, drive, low, ratio).lead_duty
    return (nearest, 0.0) if lead_duty < drive.min_duty else (low, ratio)


def _find_first_peak_s(
    train: HeightTrain, cold_heat: ThermalState, drive: DriveRange, periods: float, duty: float
) -> float:
    """Return the time from the start of a pulse on a cold pixel to its peak, s."""
    width_s = periods * drive.period_s
    t_s: FloatArray = np.linspace(0.0, 2.0 * train.period_s + width_s, 2 * SAMPLES + 1)
    pulse = np.array([[0.0, width_s, duty * drive.max_power_w, train.pixel]])
    return float(t_s[np.argmax(cold_heat.simulate_displacement_m(pulse, train.pixel, t_s))])


def limit_pulse_width(drive: DriveRange, max_width_us: int) -> DriveRange:
    """Limit the drive's pulses to `max_width_us`, but to no less than a PWM period.

    They are whole periods, unless the laser is on or off.
    """
    max_periods = max(1, min(drive.max_periods, int(max_width_us * 1e-6 / drive.period_s + 1e-9)))
    return replace(drive, max_periods=max_periods, is_fine=drive.is_on_off)
