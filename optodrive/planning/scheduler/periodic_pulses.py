"""What a pulse must be for cycles of a wanted height and swing: the steady state, found with the display's own heat.

A cycle is planned for its peak. Where cycles are so short that the membrane still rises from one pulse when the next
one comes, that peak is the last pulse's doing: planned for it, every other pulse would be left out for good. There
only what comes after the steady cycle's own peak counts. Pulses whose width is free are planned for the height midway
from that peak to the next pulse: for the peak itself, wide and narrow ones would take turns.

Widths are whole PWM periods, and where pulses leave little dark between them one more of those changes the swing by
much. What lies between two widths is had by a pulse that begins with a weaker period, its head.
"""

from dataclasses import dataclass, replace
from math import ceil

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.stimuli import HeightTrain
from optodrive.core.units import m_to_um
from optodrive.physics.pulse_for_height import DriveRange
from optodrive.physics.thermal_state import Heat

SETTLED = 10.0
"""Cycles repeat after so many relaxation times of the pixel."""
SAMPLES = 400
"""Of the steady cycle."""
EARLY = 0.8
"""A pulse from rest whose peak comes before this share of the period can be planned for its peak."""
ROUNDS, CLOSE = 6, 1e-4
"""The power of steady pulses is corrected at most so often, until the peak is this close, relative."""
SWING_CLOSE = 0.01
"""A whole number of PWM periods will do where it brings the swing this close, relative."""
NEARLY = 0.99
"""A pulse that comes so near to its height is not made wider for it."""
HALVINGS = 8
"""Of the head's share, from none to all."""
SOON_S = 1e-9


@dataclass(frozen=True)
class Cycle:
    """How each pulse of a train is planned: pulse_for_peak(…, goal_m, …, least_periods, from_s), after its head.

    head_w: power of a PWM period before that pulse, 0 for none
    """

    goal_m: float
    least_periods: int = 1
    from_s: float = 0.0
    head_w: float = 0.0


@dataclass(frozen=True)
class Steady:
    """A cycle that repeats: PWM periods and duty of its pulse and of a period before it; peak and least height, m.

    after_m: height so long after the pulse's start, after_s, that it tells this pulse's energy from the last one's
    """

    periods: int
    duty: float
    head: float
    peak_m: float
    least_m: float
    after_m: float
    after_s: float

    @property
    def peak_to_peak_m(self) -> float:
        """Fall of the membrane between two peaks, m."""
        return self.peak_m - self.least_m


def cycle_of(train: HeightTrain, at_rest: Heat, drive: DriveRange, where: str) -> Cycle:
    """How the train's pulses are planned; drive.max_periods: the longest pulse its cycle has room for.

    Raises InputError (target_out_of_reach, bad_train) where no steady cycle has the train's height or swing.
    """
    periods, head = _fewest(train, at_rest, drive, where), 0.0
    least_periods = 1
    if train.peak_to_peak_m is not None:
        periods, head = _shape_for_swing(train, at_rest, drive, periods, where)
        least_periods = periods
    first = at_rest.pulse_for_peak(train.pixel, 0.0, train.target_m, drive, least_periods)
    found = at_target(train, at_rest, drive, periods, head)
    head_w = found.head * drive.max_power_w
    if first is None or _peak_after_s(train, at_rest, drive, *first) <= EARLY * train.period_s:
        return Cycle(train.target_m, least_periods, head_w=head_w)
    return Cycle(found.after_m, least_periods, found.after_s, head_w)


def next_pulse(
    train: HeightTrain, cycle: Cycle, heat: Heat, at_s: float, drive: DriveRange
) -> tuple[int, float] | None:
    """PWM periods and duty of the train's pulse at at_s, after its head, from the heat there; None: none is needed.

    A swing has its width: were a pulse wider for want of little, the next would be narrower, and so they would go on.
    """
    shape = (drive, cycle.least_periods, cycle.from_s)
    pulse = heat.pulse_for_peak(train.pixel, at_s, cycle.goal_m, *shape)
    if train.peak_to_peak_m is None or pulse is None or pulse[0] <= cycle.least_periods:
        return pulse
    nearly = heat.pulse_for_peak(train.pixel, at_s, NEARLY * cycle.goal_m, *shape)
    return pulse if nearly is not None and nearly[0] > cycle.least_periods else (cycle.least_periods, 1.0)


def steady(
    train: HeightTrain, at_rest: Heat, drive: DriveRange, periods: int, duty: float, head: float = 0.0
) -> Steady:
    """What the same pulse in every cycle comes to, after a period of duty `head` where there is one."""
    own = at_rest.pixels.each[train.pixel]
    count = 2 + ceil(SETTLED * (own.tau_s + own.tau_g_s) / train.period_s)
    head_s = drive.period_s if head else 0.0
    shapes = [(head_s, periods * drive.period_s, duty)] + ([(0.0, head_s, head)] if head else [])
    pulses = np.zeros((count, len(shapes), 4))
    for k, (after_s, width_s, share) in enumerate(reversed(shapes)):
        pulses[:, k, 0] = train.period_s * np.arange(count) + after_s
        pulses[:, k, 1], pulses[:, k, 2] = width_s, share * drive.max_power_w
    pulses[:, :, 3] = train.pixel
    before, last = pulses[:-1].reshape(-1, 4), pulses[-1]
    warm = at_rest.copy()
    warm.pulses(np.full(len(before), train.pixel), before[:, 0], before[:, 1], before[:, 2])
    t_s = last[0, 0] + train.period_s * np.linspace(0.0, 1.0, SAMPLES + 1)
    height_m = warm.heights_m(last, train.pixel, t_s)
    peak = int(height_m.argmax())
    after = peak if train.peak_to_peak_m is not None else (peak + SAMPLES) // 2
    after_s = max(SOON_S, float(t_s[after] - t_s[0]) - head_s)
    return Steady(periods, duty, head, float(height_m.max()), float(height_m.min()), float(height_m[after]), after_s)


def at_target(train: HeightTrain, at_rest: Heat, drive: DriveRange, periods: int, share: float = 0.0) -> Steady:
    """The steady cycle of pulses so wide whose peak is the target, or that of full power where none is.

    share: duty of the period before the pulse, over the pulse's own
    """
    found = steady(train, at_rest, drive, periods, 1.0, share)
    for _ in range(ROUNDS):
        if abs(found.peak_m / train.target_m - 1.0) < CLOSE:
            break
        # Heights are all but proportional to power.
        duty = min(1.0, found.duty * train.target_m / found.peak_m)
        if duty == found.duty:
            break
        found = steady(train, at_rest, drive, periods, duty, share * duty)
    return found


def _fewest(train: HeightTrain, at_rest: Heat, drive: DriveRange, where: str) -> int:
    """PWM periods of the shortest pulse whose steady cycle at full power reaches the target."""
    low, high = 0, drive.max_periods
    most_m = steady(train, at_rest, drive, high, 1.0).peak_m
    if most_m < train.target_m:
        raise InputError(
            f"{where}.target_um",
            round(m_to_um(train.target_m), 3),
            f"at most {m_to_um(most_m):.0f} µm, what pulses of {high * drive.period_s * 1e3:.4g} ms at "
            f"{drive.max_power_w:g} W every {train.period_s * 1e3:.4g} ms come to",
            code="target_out_of_reach",
        )
    while high - low > 1:
        middle = (low + high) // 2
        if steady(train, at_rest, drive, middle, 1.0).peak_m >= train.target_m:
            high = middle
        else:
            low = middle
    return high


def _shape_for_swing(
    train: HeightTrain, at_rest: Heat, drive: DriveRange, fewest: int, where: str
) -> tuple[int, float]:
    """PWM periods of the pulse whose steady cycle swings by what is asked, and its head's share: wider swings less."""
    asked_m = train.peak_to_peak_m or 0.0
    swing_m = {n: at_target(train, at_rest, drive, n).peak_to_peak_m for n in (fewest, drive.max_periods)}
    low, high = fewest, drive.max_periods
    for bound_m, beyond, word, kind in (
        (swing_m[low], asked_m > swing_m[low] * (1.0 + CLOSE), "at most", "shortest"),
        (swing_m[high], asked_m < swing_m[high] * (1.0 - CLOSE), "at least", "longest"),
    ):
        if beyond:
            raise InputError(
                f"{where}.peak_to_peak_um",
                round(m_to_um(asked_m), 3),
                f"{word} {m_to_um(bound_m):.4g} µm, what the {kind} pulses to {m_to_um(train.target_m):.4g} µm "
                f"every {train.period_s * 1e3:.4g} ms come to",
                code="bad_train",
            )
    while high - low > 1:
        middle = (low + high) // 2
        swing_m[middle] = at_target(train, at_rest, drive, middle).peak_to_peak_m
        if swing_m[middle] >= asked_m:
            low = middle
        else:
            high = middle
    nearest = min((low, high), key=lambda n: abs(swing_m[n] - asked_m))
    if abs(swing_m[nearest] - asked_m) <= SWING_CLOSE * asked_m:
        return nearest, 0.0
    none, whole = 0.0, 1.0
    for _ in range(HALVINGS):
        share = 0.5 * (none + whole)
        if at_target(train, at_rest, drive, low, share).peak_to_peak_m >= asked_m:
            none = share
        else:
            whole = share
    return low, 0.5 * (none + whole)


def _peak_after_s(train: HeightTrain, at_rest: Heat, drive: DriveRange, periods: int, duty: float) -> float:
    """When the first pulse's peak comes after its start, s."""
    width_s = periods * drive.period_s
    t_s: FloatArray = np.linspace(0.0, 2.0 * train.period_s + width_s, 2 * SAMPLES + 1)
    pulse = np.array([[0.0, width_s, duty * drive.max_power_w, train.pixel]])
    return float(t_s[np.argmax(at_rest.heights_m(pulse, train.pixel, t_s))])


def with_room(drive: DriveRange, room_us: int) -> DriveRange:
    """The drive with pulses no longer than room_us, and one PWM period at least."""
    return replace(drive, max_periods=max(1, min(drive.max_periods, int(room_us * 1e-6 / drive.period_s + 1e-9))))
