"""Settling times of the mirrors: how long a move keeps the gate closed until the whole focus stays on the absorber.

Both axes move at once, and the slower one decides. Residual ringing of earlier moves takes a share of the tolerance,
see docs/decisions/0013-gate-by-trajectory.md. The times hold for every servo within the declared uncertainty
(`settling_bound.py`).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate
from math import ceil, exp, log, pi
from typing import Self

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.device.config import Config
from optodrive.device.gate_timing import build_servo_range, envelope_factor, settling_s
from optodrive.device.pixel_map import build_aim_layout
from optodrive.device.scan_field import ScanField, max_neighbour_step_rad, tolerance_ratio
from optodrive.device.servo import ServoRange
from optodrive.device.settling_bound import bound_departure_s, bound_settling_s

LONG_DWELL_SHARE = 0.01
"""Share of the tolerance for residual ringing of earlier moves after a long dwell."""
BISECTION_STEPS = 40
EARLY_SHARE = 0.05
"""Share of the tolerance for residual ringing when a step is sent early."""
EARLY_SLACK_POINTS = 3
"""Points by which a pulse on a laser DAC may be shorter than planned."""
CEIL_OFFSET = 1.0 - 1e-6
"""Offset that turns truncation into rounding up, except for rounding errors of whole numbers."""

TimesUs = tuple[int, ...]


@dataclass(frozen=True)
class SettlingTable:
    """Settling times of moves between pixels, by distance in pitches.

    pitch_rad: of the lattice, in a calibrated field the largest step between neighbours; long_dwell_us: shortest dwell
    on a pixel that counts as long; after_long_dwell, after_short_dwell: times in x and y, µs, non-decreasing and
    subadditive, so that no detour is faster; lead_in_us: upper bound for the first move of a plan, from the centre or
    from any pixel
    early_points, early_us: points of a laser DAC, and the time that they last at least, by which a step precedes the
    end of the light on a pixel after early_dwell_us there; 0 with plain steps
    """

    pitch_rad: float
    long_dwell_us: int
    after_long_dwell: tuple[TimesUs, TimesUs]
    after_short_dwell: tuple[TimesUs, TimesUs]
    lead_in_us: int
    early_points: int = 0
    early_us: int = 0
    early_dwell_us: int = 0

    @classmethod
    def from_config(cls, config: Config, field: ScanField | None = None) -> Self:
        """Compute the tables of a configuration.

        field: the calibrated field, None for the ideal one
        """
        table = cls._for_whole_pitches(config) if field is None else cls._for_any_distance(config, field)
        if config.scanner.trajectories == "steps":
            return table
        ratio = 1.0 if field is None else tolerance_ratio(field, build_aim_layout(config), config)
        return table._with_early_steps(_ServoMoves.from_config(config, ratio), config)

    def _with_early_steps(self, moves: "_ServoMoves", config: Config) -> Self:
        """Return the table with the largest lead in whole points for which the focus stays on the absorber.

        A step is never sent before the light on its pixel begins, also of the shortest pulse.
        """
        departures_s = (bound_departure_s(moves.servos, moves.remaining_rad(axis, EARLY_SHARE)) for axis in range(2))
        point_s = config.board.point_max_s
        # No longer than the shortest pulse: a step that precedes the light of its own pixel would move it.
        points = min(int(min(departures_s) / point_s), int(moves.min_pulse_s / point_s) - EARLY_SLACK_POINTS)
        # The least that the points may last, against `point_max_s` above, the most: each bound at its own end.
        early_us = int(1e6 * points / config.board.points_per_s) - 1
        if points < 1:
            return self
        rest_us = max(self.long_dwell_us, moves.rest_us(EARLY_SHARE))
        dwell_us = rest_us + early_us + ceil(1e6 * EARLY_SLACK_POINTS * point_s)
        return replace(self, early_points=points, early_us=early_us, early_dwell_us=dwell_us)

    @classmethod
    def _for_any_distance(cls, config: Config, field: ScanField) -> Self:
        """Compute tables in which the time of n pitches bounds every move of more than n − 1 and up to n pitches."""
        layout = build_aim_layout(config)
        angles_rad = field.angles_rad(layout.x_m, layout.y_m)
        nominal = _ServoMoves.from_config(config, tolerance_ratio(field, layout, config))
        moves = replace(nominal, pitch_rad=max_neighbour_step_rad(layout, *angles_rad) or nominal.pitch_rad)
        # The first move begins at the centre or on any pixel.
        spans_rad = [max(float(np.ptp(angle_rad)), float(np.abs(angle_rad).max())) for angle_rad in angles_rad]
        spans = [int(span_rad / moves.pitch_rad + CEIL_OFFSET) for span_rad in spans_rad]
        farthest = max(1, *spans)
        after_long, after_short = (
            (moves.build_table(0, farthest, share, 1), moves.build_table(1, farthest, share, 1))
            for share in (LONG_DWELL_SHARE, moves.short_dwell_share)
        )
        lead_in_us = max(after_short[0][spans[0]], after_short[1][spans[1]])
        return cls(moves.pitch_rad, moves.long_dwell_us, after_long, after_short, lead_in_us)

    @classmethod
    def _for_whole_pitches(cls, config: Config) -> Self:
        moves, display = _ServoMoves.from_config(config), config.display
        farthest = max(1, display.rows - 1, display.columns - 1)
        after_long, after_short = (
            (moves.build_table(0, farthest, share), moves.build_table(1, farthest, share))
            for share in (LONG_DWELL_SHARE, moves.short_dwell_share)
        )
        # Only a first move, from the centre of an even lattice, spans half pitches.
        # An even lattice has its centre between two pixels, and the mirrors begin there.
        halves = [
            1e6 * moves.settling_s(axis, 0.5 * odd, 0.5 * odd, moves.short_dwell_share)
            for axis, count in enumerate((display.columns, display.rows))
            for odd in range(1, count if count % 2 == 0 else 0, 2)
        ]
        lead_in_us = max(
            after_short[0][display.columns - 1], after_short[1][display.rows - 1], *(ceil(each) for each in halves)
        )
        return cls(moves.pitch_rad, moves.long_dwell_us, after_long, after_short, lead_in_us)

    def settling_us(self, dx_rad: float, dy_rad: float, dwell_us: int = 0) -> int:
        """Return the settling time of a move, rounded up to whole pitches, µs.

        dwell_us: time on the previous pixel since its gate opened
        """
        tables = self.after_long_dwell if dwell_us >= self.long_dwell_us else self.after_short_dwell
        x_us = tables[0][int(abs(dx_rad) / self.pitch_rad + CEIL_OFFSET)]
        y_us = tables[1][int(abs(dy_rad) / self.pitch_rad + CEIL_OFFSET)]
        # A mirror that still rings when the step is sent would leave its tolerance sooner than computed.
        early_us = self.early_us if dwell_us >= self.early_dwell_us else 0
        return max(0, max(x_us, y_us) - early_us)

    def min_settling_us(self, dx_rad: FloatArray, dy_rad: FloatArray) -> int:
        """Return the smallest settling time, after a long dwell, of several moves [k], µs."""
        x_us, y_us = (
            np.array(table)[(np.abs(way_rad) / self.pitch_rad + CEIL_OFFSET).astype(np.int64)]
            for table, way_rad in zip(self.after_long_dwell, (dx_rad, dy_rad), strict=True)
        )
        return max(0, int(np.maximum(x_us, y_us).min()) - self.early_us)


@dataclass(frozen=True)
class _ServoMoves:
    """Moves of any servo of a range on one lattice.

    tolerance_rad: angle tolerance in x and y, less half a code of rounding; min_pulse_s: width of the shortest pulse
    """

    servos: ServoRange
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
        min_pulse_s = int(1e6 / config.laser.width_steps_hz) * 1e-6
        return cls(build_servo_range(scanner), pitch_rad, scanner.rad_per_code, (x_rad, y_rad), min_pulse_s)

    def settling_s(self, axis: int, min_pitches: float, max_pitches: float, share: float) -> float:
        """Return a bound of the settling times of moves between two distances, lengthened by a code of rounding, s.

        share: share of the tolerance that residual ringing of earlier moves takes
        """
        return bound_settling_s(
            self.servos, min_pitches * self.pitch_rad, max_pitches * self.pitch_rad, self.remaining_rad(axis, share)
        )

    def remaining_rad(self, axis: int, share: float) -> float:
        return (1.0 - share) * self.tolerance_rad[axis] - self.code_rad

    def build_table(self, axis: int, farthest: int, share: float, below: int = 0) -> TimesUs:
        """Return the times of 0 to `farthest` pitches, µs.

        below: 1 if the time of n pitches bounds all moves of more than n − 1, else 0
        """
        times_s = (self.settling_s(axis, way - below, way, share) for way in range(1, farthest + 1))
        return _enforce_subadditivity([0, *(ceil(1e6 * each_s) for each_s in times_s)])

    def _min_pitch_settling_s(self, share: float) -> float:
        """Return a time that every planned move of a pitch takes at least: that of one slow servo, s."""
        # Slow in frequency and slew, late, and well damped: a lower bound, as moves must not seem shorter than planned
        # ones are.
        slow = self.servos.servo_at(-1.0, 1.0, -1.0, 1.0)
        return min(settling_s(slow, self.pitch_rad, self.remaining_rad(axis, share)) for axis in range(2))

    @property
    def _min_rate_per_s(self) -> float:
        """Rate at which ringing decays at least, 1/s."""
        # Low frequency and low damping: ringing that decays most slowly.
        slow = self.servos.servo_at(-1.0, -1.0, 0.0, 0.0)
        return 2.0 * pi * slow.frequency * slow.damping

    @property
    def _max_envelope_factor(self) -> float:
        """Envelope factor of any servo: it rises with the damping ratio."""
        return envelope_factor(self.servos.servo_at(0.0, 1.0, 0.0, 0.0))

    def _residual_factor(self, share: float) -> float:
        """Return the decay of ringing from one gate to the next, over the shortest pulse and the shortest move."""
        return exp(-self._min_rate_per_s * (self.min_pulse_s + self._min_pitch_settling_s(share)))

    @cached_property
    def short_dwell_share(self) -> float:
        """Return the share of the tolerance for the residual ringing of all earlier moves after the shortest pulses.

        A larger share lengthens moves and thereby reduces the residual ringing: the result is the fixed point.
        """

        def residual_share(share: float) -> float:
            factor = self._residual_factor(share)
            # A geometric series: all earlier moves ring, each one gate longer than the next.
            return self._max_envelope_factor * factor / (1.0 - factor)

        return max(
            LONG_DWELL_SHARE, _bisect_fixed_point(residual_share, 1.0 - 1.01 * self.code_rad / min(self.tolerance_rad))
        )

    def rest_us(self, share: float) -> int:
        """Return the time from the opening of a gate until all earlier moves leave this share of the tolerance, µs."""
        decay = self._max_envelope_factor / (share * (1.0 - self._residual_factor(self.short_dwell_share)))
        return ceil(1e6 * log(decay) / self._min_rate_per_s)

    @property
    def long_dwell_us(self) -> int:
        """Return the dwell after which all earlier moves leave LONG_DWELL_SHARE at the next gate opening, µs."""
        return max(0, self.rest_us(LONG_DWELL_SHARE) - int(1e6 * self._min_pitch_settling_s(LONG_DWELL_SHARE)))


def _bisect_fixed_point(function: Callable[[float], float], high_limit: float) -> float:
    """Return the fixed point of a decreasing function, or a value just above it."""
    low, high = 0.0, high_limit
    for _ in range(BISECTION_STEPS):
        middle = 0.5 * (low + high)
        if function(middle) > middle:
            low = middle
        else:
            high = middle
    # Just above the fixed point: a share that is too large errs towards longer moves.
    return high


def _enforce_subadditivity(times_us: list[int]) -> TimesUs:
    """Return non-decreasing, subadditive times that are at least the given ones.

    Subadditivity matters because a pulse between two moves may be trimmed to zero power: the mirrors then make the
    whole way in the time of both moves.
    """
    # A longer move may settle sooner, when its ramp ends against the ringing; a table that falls would invite detours.
    times_us = list(accumulate(times_us, max))
    for total in range(len(times_us) - 1, 1, -1):
        # The longer part is raised, from the largest total down.
        for part in range(1, total // 2 + 1):
            times_us[total - part] = max(times_us[total - part], times_us[total] - times_us[part])
    return tuple(accumulate(times_us, max))
