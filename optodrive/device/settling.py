"""How long a move of the mirrors keeps the gate closed: until the whole focus lies on the absorber, and stays there.

Both axes start at once and the later one decides. What is left of the moves before is counted by shares of the
tolerance, see docs/decisions/0013-gate-by-trajectory.md.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import accumulate
from math import ceil, exp, log, sqrt
from typing import Self

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.device.config import Config
from optodrive.device.gate_timing import build_servo, envelope_factor, pole_per_s, settling_s
from optodrive.device.pixel_map import build_aim_layout
from optodrive.device.scan_field import ScanField, max_neighbour_step_rad, tolerance_ratio
from optodrive.device.servo import Servo

LONG_DWELL_SHARE = 0.01
"""Share of the tolerance that is kept for what is left of the moves before, once they have had time to die out."""
BISECTION_STEPS = 40
INTERVAL_SHARE = 0.03
"""Share of the tolerance given away, at the most, so that a few moves can stand for all those between them."""
CEIL_OFFSET = 1.0 - 1e-6
"""Added to a number of pitches it gives the next whole one upwards, but for what is only rounding."""

TimesUs = tuple[int, ...]


@dataclass(frozen=True)
class SettlingTable:
    """Times of moves between pixels, by pitches: no move takes no time.

    pitch_rad: the lattice's; in a calibrated field the largest step between neighbours
    calm, hasty: times of x and of y, µs, rising, and never more than those of two moves that lead to the same place
    calm_us: after stays on a pixel at least as long as this a move is calm
    lead_us: for the farthest move, from the middle too, whatever was before
    """

    pitch_rad: float
    long_dwell_us: int
    after_long_dwell: tuple[TimesUs, TimesUs]
    after_short_dwell: tuple[TimesUs, TimesUs]
    lead_in_us: int

    @classmethod
    def from_config(cls, config: Config, field: ScanField | None = None) -> Self:
        """Tables for a configuration's lattice, servo, absorber and focus; field: a calibrated one, else ideal."""
        return cls._for_whole_pitches(config) if field is None else cls._for_any_distance(config, field)

    @classmethod
    def _for_any_distance(cls, config: Config, field: ScanField) -> Self:
        """Places of a calibrated field lie at any distance: a pitch's time is enough for all that is not longer."""
        layout = build_aim_layout(config)
        angles_rad = field.angles_rad(layout.x_m, layout.y_m)
        nominal = _ServoMoves.from_config(config, tolerance_ratio(field, layout, config))
        moves = replace(nominal, pitch_rad=max_neighbour_step_rad(layout, *angles_rad) or nominal.pitch_rad)
        share = moves.short_dwell_share()
        # The first move begins in the middle, or on any pixel.
        spans_rad = [max(float(np.ptp(angle_rad)), float(np.abs(angle_rad).max())) for angle_rad in angles_rad]
        far = [int(span_rad / moves.pitch_rad + CEIL_OFFSET) for span_rad in spans_rad]
        calm, hasty = (
            (moves.build_interval_table(0, max(1, *far), left), moves.build_interval_table(1, max(1, *far), left))
            for left in (LONG_DWELL_SHARE, share)
        )
        return cls(moves.pitch_rad, moves.long_dwell_us(share), calm, hasty, max(hasty[0][far[0]], hasty[1][far[1]]))

    @classmethod
    def _for_whole_pitches(cls, config: Config) -> Self:
        moves, display = _ServoMoves.from_config(config), config.display
        share = moves.short_dwell_share()
        farthest = max(1, display.rows - 1, display.columns - 1)
        calm, hasty = (
            (moves.build_table(0, farthest, left), moves.build_table(1, farthest, left))
            for left in (LONG_DWELL_SHARE, share)
        )
        # Only a first move, from the middle of an even lattice, goes half pitches.
        halves = [
            1e6 * moves.settling_s(axis, 0.5 * odd, share)
            for axis, count in enumerate((display.columns, display.rows))
            for odd in range(1, count if count % 2 == 0 else 0, 2)
        ]
        lead_us = max(hasty[0][display.columns - 1], hasty[1][display.rows - 1], *(ceil(each) for each in halves))
        return cls(moves.pitch_rad, moves.long_dwell_us(share), calm, hasty, lead_us)

    def settling_us(self, dx_rad: float, dy_rad: float, dwell_us: int = 0) -> int:
        """Dark time for a move, rounded up to whole pitches, µs; after a stay of lit_us since the gate opened."""
        tables = self.after_long_dwell if dwell_us >= self.long_dwell_us else self.after_short_dwell
        x_us = tables[0][int(abs(dx_rad) / self.pitch_rad + CEIL_OFFSET)]
        y_us = tables[1][int(abs(dy_rad) / self.pitch_rad + CEIL_OFFSET)]
        return x_us if x_us > y_us else y_us

    def min_settling_us(self, dx_rad: FloatArray, dy_rad: FloatArray) -> int:
        """The least dark time that any of several moves can take, µs; both [k]."""
        x_us, y_us = (
            np.array(table)[(np.abs(way_rad) / self.pitch_rad + CEIL_OFFSET).astype(np.int64)]
            for table, way_rad in zip(self.after_long_dwell, (dx_rad, dy_rad), strict=True)
        )
        return int(np.maximum(x_us, y_us).min())


@dataclass(frozen=True)
class _ServoMoves:
    """The servo's moves on one lattice. room_rad: tolerance of x and y, less half a code by which the aim is off."""

    servo: Servo
    pitch_rad: float
    code_rad: float
    tolerance_rad: tuple[float, float]
    min_pulse_s: float

    @classmethod
    def from_config(cls, config: Config, tolerance_ratio: float = 1.0) -> Self:
        scanner = config.scanner
        x_rad, y_rad = (
            tolerance_ratio * tolerance_rad - 0.5 * scanner.rad_per_code for tolerance_rad in config.tolerance_rad
        )
        pitch_rad = config.display.pitch_m / (2.0 * scanner.focal_length_m)
        shortest_s = int(1e6 / config.laser.pwm_hz) * 1e-6
        return cls(build_servo(scanner), pitch_rad, scanner.rad_per_code, (x_rad, y_rad), shortest_s)

    def settling_s(self, axis: int, pitches: float, share: float) -> float:
        """Time of a move with a share of the tolerance kept for what is left of others. A code more may be moved."""
        tolerance_rad = (1.0 - share) * self.tolerance_rad[axis] - self.code_rad
        return settling_s(self.servo, pitches * self.pitch_rad, tolerance_rad)

    def interval_settling_s(self, axis: int, pitches: int, share: float) -> float:
        """Enough for every move of more than a pitch less than so many, up to so many.

        What swings on after a move, as a complex amplitude, changes by no more than 1/√(1 − ζ²) of what the move does,
        less after a long ramp. So a move whose swing keeps within a tolerance narrower by that has all moves up to a
        step shorter keep within the whole of it, and none of them has a longer ramp.
        """
        before_rad = (pitches - 1) * self.pitch_rad
        slope = exp(pole_per_s(self.servo).real * before_rad / self.servo.slew) / sqrt(1.0 - self.servo.damping**2)
        tolerance_rad = (1.0 - share) * self.tolerance_rad[axis] - self.code_rad
        steps = ceil(self.pitch_rad * slope / (INTERVAL_SHARE * tolerance_rad))
        narrower_rad = tolerance_rad - slope * self.pitch_rad / steps
        ends_rad = (before_rad + self.pitch_rad * (1 + np.arange(steps)) / steps).tolist()
        return max(settling_s(self.servo, end_rad, narrower_rad) for end_rad in ends_rad)

    def build_interval_table(self, axis: int, farthest: int, share: float) -> TimesUs:
        return _enforce_subadditivity(
            [0, *(ceil(1e6 * self.interval_settling_s(axis, way, share)) for way in range(1, farthest + 1))]
        )

    def build_table(self, axis: int, farthest: int, share: float) -> TimesUs:
        return _enforce_subadditivity(
            [0, *(ceil(1e6 * self.settling_s(axis, pitches, share)) for pitches in range(1, farthest + 1))]
        )

    def _pitch_settling_s(self, share: float) -> float:
        return min(self.settling_s(axis, 1, share) for axis in range(2))

    def _residual_factor(self, share: float) -> float:
        """How far a swing dies out from one gate to the next: over the shortest pulse and the shortest move."""
        return exp(pole_per_s(self.servo).real * (self.min_pulse_s + self._pitch_settling_s(share)))

    def short_dwell_share(self) -> float:
        """Share of the tolerance that all former moves together may still have when pulses are as short as can be.

        A larger share makes moves longer and thereby leaves less: the share is where both meet.
        """

        def left(share: float) -> float:
            kept = self._residual_factor(share)
            return envelope_factor(self.servo) * kept / (1.0 - kept)

        return max(LONG_DWELL_SHARE, _bisect_fixed_point(left, 1.0 - 1.01 * self.code_rad / min(self.tolerance_rad)))

    def long_dwell_us(self, short_dwell_share: float) -> int:
        """The stay after which all former moves together have no more than CALM_SHARE left when the next gate opens."""
        rate_per_s = -pole_per_s(self.servo).real
        needed = envelope_factor(self.servo) / (LONG_DWELL_SHARE * (1.0 - self._residual_factor(short_dwell_share)))
        return max(0, ceil(1e6 * (log(needed) / rate_per_s - self._pitch_settling_s(LONG_DWELL_SHARE))))


def _bisect_fixed_point(falling: Callable[[float], float], high_limit: float) -> float:
    """Where a falling function of a share meets the share, or just above."""
    low, high = 0.0, high_limit
    for _ in range(BISECTION_STEPS):
        middle = 0.5 * (low + high)
        if falling(middle) > middle:
            low = middle
        else:
            high = middle
    return high


def _enforce_subadditivity(times_us: list[int]) -> TimesUs:
    """Rising times at or above those given with none above the sum of two that lead as far.

    A pulse between them may be trimmed to nothing: then the mirrors go all the way in the time of both moves.
    """
    times_us = list(accumulate(times_us, max))
    for far in range(len(times_us) - 1, 1, -1):
        for rest in range(1, far // 2 + 1):
            times_us[far - rest] = max(times_us[far - rest], times_us[far] - times_us[rest])
    return tuple(accumulate(times_us, max))
