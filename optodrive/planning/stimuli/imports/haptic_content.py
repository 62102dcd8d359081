"""Vibrations and taps of a haptic file, and the frames that show them: one pulse per cycle, with the envelope's height.

A membrane only rises and falls back by itself. A cycle becomes a frame in which each chosen pixel rises once, to
strength × height. A tap is such a frame at its own time, from which the cycles of the vibration around it go on.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from math import inf

import numpy as np

from optodrive.core.errors import InputError, Unquoted, build_nothing_raised_error
from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.stimuli import FrameSequence, TactileFrame
from optodrive.device.config import Config
from optodrive.planning.stimuli.pixel_lattice import Lattice
from optodrive.planning.stimuli.sequence_file import FRAMES_MAX

SAMPLE_S = 2.5e-4
"""Interval at which strengths and rates are sampled, s."""
RATE_MIN_HZ, RATE_MAX_HZ = 1.0, 200.0
"""Rates of a vibration that a membrane shows, Hz."""
STRENGTH_MIN = 0.01
"""Strength below which a cycle has no pulse."""
LENGTH_MAX_S, SAMPLES_MAX = 600.0, 8_000_000
"""Longest content, s, and largest number of samples of all its vibrations."""
TAP_GAP_S = 1.0 / RATE_MAX_HZ
"""Shortest time between two taps, s; of nearer ones the strongest counts."""
FRAME_MAX_S = 0.1
"""Longest time of a frame, s, within which its pixels are due."""
PIXELS_MAX = 1000
FILE_BYTES_MAX = 8_000_000

Curve = Callable[[FloatArray], FloatArray]
"""Values at times since the start of the content, s."""
Pulses = list[tuple[float, float]]
"""Time, s, and strength of each pulse."""


@dataclass(frozen=True, eq=False)
class Vibration:
    """A vibration, sampled every SAMPLE_S from its start: strength, 1 at full height, and rate, Hz."""

    start_s: float
    strength: FloatArray
    rate_hz: FloatArray


@dataclass(eq=False)
class HapticContent:
    """Vibrations and taps of a file, and its parts that a membrane cannot show.

    taps: time, s, and strength; gain: factor of the sum of all that comes at a time; not_shown: what a membrane cannot
    show, and how often
    """

    vibrations: list[Vibration] = field(default_factory=list)
    taps: Pulses = field(default_factory=list)
    gain: float = 1.0
    not_shown: Counter[str] = field(default_factory=Counter)

    def add_vibration(self, where: str, start_s: float, end_s: float, strength: Curve, rate_hz: Curve) -> None:
        """Sample a vibration. Raise InputError (too_many) beyond the longest content."""
        if end_s > LENGTH_MAX_S:
            raise InputError(where, Unquoted(f"{end_s:g} s"), f"at most {LENGTH_MAX_S:g} s", code="too_many")
        count = round((end_s - start_s) / SAMPLE_S)
        at_s = np.asarray(start_s + SAMPLE_S * np.arange(count), dtype=np.float64)
        if sum(len(each.strength) for each in self.vibrations) + count > SAMPLES_MAX:
            expected = f"at most {SAMPLE_S * SAMPLES_MAX:g} s of all vibrations together"
            raise InputError(where, Unquoted("more"), expected, code="too_many")
        rate = rate_hz(at_s)
        if (rate > RATE_MAX_HZ).any():
            self.not_shown[f"rates above {RATE_MAX_HZ:g} Hz, which become {RATE_MAX_HZ:g} Hz"] += 1
        if (rate < RATE_MIN_HZ).any():
            self.not_shown[f"rates below {RATE_MIN_HZ:g} Hz, which become {RATE_MIN_HZ:g} Hz"] += 1
        self.vibrations.append(Vibration(start_s, strength(at_s), np.clip(rate, RATE_MIN_HZ, RATE_MAX_HZ)))

    def refuse_not_shown(self, where: str) -> None:
        """Raise InputError (not_shown) with the name of everything that a membrane cannot show, if there is any."""
        if self.not_shown:
            named = "; ".join(f"{count} × {name}" for name, count in self.not_shown.items())
            expected = f"what a membrane shows, or lossy=true to show the rest; it cannot show {named}"
            raise InputError(where, Unquoted(f"{self.not_shown.total()} parts beyond it"), expected, code="not_shown")

    def list_pulses(self, where: str) -> Pulses:
        """Return one pulse per cycle and tap, in order. Raise InputError (too_many)."""
        strength, rate_hz = self._mix()
        pulses: Pulses = []
        for pulse in _walk(strength, rate_hz, [(at_s, min(1.0, each)) for at_s, each in sorted(self.taps)]):
            pulses.append((pulse[0], min(1.0, self.gain * pulse[1])))
            if len(pulses) > FRAMES_MAX:
                expected = f"at most {FRAMES_MAX} cycles and taps"
                raise InputError(where, Unquoted(f"more, within {pulses[-1][0]:.1f} s"), expected, code="too_many")
        return [each for each in pulses if each[1] >= STRENGTH_MIN]

    def _mix(self) -> tuple[FloatArray, FloatArray]:
        """Return the sum of all strengths, at most 1, and the rate of the strongest vibration, 0 between them."""
        firsts = [round(each.start_s / SAMPLE_S) for each in self.vibrations]
        count = max(
            (first + len(each.strength) for first, each in zip(firsts, self.vibrations, strict=True)), default=0
        )
        total, strongest, rate_hz = np.zeros(count), np.full(count, -1.0), np.zeros(count)
        for first, each in zip(firsts, self.vibrations, strict=True):
            part = slice(first, first + len(each.strength))
            total[part] += each.strength
            is_stronger = each.strength > strongest[part]
            strongest[part] = np.where(is_stronger, each.strength, strongest[part])
            rate_hz[part] = np.where(is_stronger, each.rate_hz, rate_hz[part])
        return np.minimum(total, 1.0), rate_hz


def _walk(strength: FloatArray, rate_hz: FloatArray, taps: Pulses) -> Iterator[tuple[float, float]]:
    """Yield the time and strength of each cycle and tap.

    A cycle has the strength of its middle. A tap that comes before that middle takes the place of the cycle.
    """
    active = np.flatnonzero(rate_hz)
    at_s, next_tap = 0.0, 0
    while True:
        position = int(np.searchsorted(active, int(at_s / SAMPLE_S + 1e-6)))
        cycle_s, period_s = inf, inf
        if position < len(active):
            cycle_s = max(at_s, float(active[position]) * SAMPLE_S)
            period_s = 1.0 / float(rate_hz[active[position]])
        tap_s = taps[next_tap][0] if next_tap < len(taps) else inf
        if cycle_s == tap_s == inf:
            return
        if tap_s <= cycle_s + 0.5 * period_s:
            tapped = 0.0
            while next_tap < len(taps) and taps[next_tap][0] < tap_s + TAP_GAP_S:
                tapped, next_tap = max(tapped, taps[next_tap][1]), next_tap + 1
            index = int(tap_s / SAMPLE_S + 1e-6)
            is_within = index < len(rate_hz) and rate_hz[index] > 0.0
            yield tap_s, max(tapped, float(strength[index]) if is_within else 0.0)
            at_s = tap_s + (1.0 / float(rate_hz[index]) if is_within else TAP_GAP_S)
        else:
            middle = round((cycle_s + 0.5 * period_s) / SAMPLE_S)
            yield cycle_s, float(strength[middle]) if middle < len(strength) else 0.0
            at_s = min(cycle_s + period_s, tap_s)


def build_pulse_frames(
    config: Config, where: str, pulses: Pulses, pixels: str | None, height_m: float, name: str
) -> FrameSequence:
    """Build a frame per pulse, in which each of the pixels rises to strength × height.

    Raises InputError (bad_parameter, unknown_pixel, raises_nothing).
    """
    chosen = parse_pixels(config, f"{where}: pixels", pixels)
    if not pulses:
        reason = f"its strength is below {STRENGTH_MIN:g} everywhere"
        raise build_nothing_raised_error(f"{where}: file", reason, "one with a tap, a vibration or a sound")
    starts_s = [round(at_s, 6) for at_s, _ in pulses]
    ends_s = [*(min(begin_s + FRAME_MAX_S, end_s) for begin_s, end_s in pairwise(starts_s)), starts_s[-1] + FRAME_MAX_S]
    mask = np.zeros(len(Lattice.from_config(config).layout))
    mask[list(chosen)] = height_m
    return FrameSequence(
        tuple(
            TactileFrame(f"{name}-{k}", start_s, round(end_s - start_s, 6), strength * mask)
            for k, (start_s, end_s, (_, strength)) in enumerate(zip(starts_s, ends_s, pulses, strict=True))
        )
    )


def parse_pixels(config: Config, where: str, text: str | None) -> Iterable[int]:
    """Return the pixels of a text such as 200,201 or 200-205, by default the middle one.

    Raises InputError (bad_parameter, unknown_pixel).
    """
    lattice = Lattice.from_config(config)
    if text is None:
        return [lattice.middle_pixel()]
    last, pixels = len(lattice.layout) - 1, set[int]()
    for part in text.split(","):
        low, dash, high = (each.strip() for each in part.partition("-"))
        ends = [low, high] if dash else [low, low]
        if not all(each.isascii() and each.isdigit() and len(each) < 10 for each in ends):
            raise InputError(where, part, "pixels such as 200,201 or 200-205", code="bad_parameter")
        first, end = int(ends[0]), int(ends[1])
        if not 0 <= first <= end <= last:
            raise InputError(where, part, f"pixels, 0…{last}, in increasing order", code="unknown_pixel")
        pixels.update(range(first, end + 1))
    if len(pixels) > PIXELS_MAX:
        raise InputError(where, len(pixels), f"at most {PIXELS_MAX} pixels", code="too_many")
    return sorted(pixels)
