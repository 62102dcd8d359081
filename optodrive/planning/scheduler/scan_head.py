"""Optics and laser as the scheduler sees them, and the times of the mirrors' moves between pixels."""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.device.config import PixelLayout
from optodrive.device.scan_field import ScanField
from optodrive.device.settling import SettlingTable
from optodrive.physics.pulse_for_height import DriveRange
from optodrive.planning.scheduler.visiting_path import compute_visiting_order


@dataclass(frozen=True)
class ScanHead:
    """Optics, mirrors and laser drive.

    pulse_gap_s: gate-off time on a pixel after which its next pulse counts as a separate one.
    """

    layout: PixelLayout
    field: ScanField
    settling: SettlingTable
    drive: DriveRange
    pulse_gap_s: float

    @cached_property
    def moves(self) -> "MoveTimes":
        """Mirror angles of the pixels and times of moves, computed once. lead_in_us is that of an unknown pixel."""
        x_rad, y_rad = self.field.angles_rad(self.layout.x_m, self.layout.y_m)
        return MoveTimes.from_table(self.settling, np.array(x_rad), np.array(y_rad), self.settling.lead_in_us)

    @cached_property
    def angle_lists(self) -> tuple[list[float], list[float]]:
        """The mirror angles as lists, because single elements of a list are read faster than those of an array."""
        return self.moves.x_rad.tolist(), self.moves.y_rad.tolist()


class MoveTimes(NamedTuple):
    """Mirror angles of the pixels [p], and the times of moves between them, for kernels, as in `SettlingTable`."""

    x_rad: FloatArray
    y_rad: FloatArray
    pitch_rad: float
    long_dwell_us: int
    long_x_us: IntArray
    long_y_us: IntArray
    short_x_us: IntArray
    short_y_us: IntArray
    lead_in_us: int
    early_us: int
    early_dwell_us: int

    @classmethod
    def from_table(cls, table: SettlingTable, x_rad: FloatArray, y_rad: FloatArray, lead_in_us: int) -> "MoveTimes":
        """Return the times of a table for pixels at these angles [p].

        lead_in_us: of a move from an unknown pixel
        """
        long_x_us, long_y_us = (np.array(times_us, dtype=np.int64) for times_us in table.after_long_dwell)
        short_x_us, short_y_us = (np.array(times_us, dtype=np.int64) for times_us in table.after_short_dwell)
        return cls(
            x_rad,
            y_rad,
            table.pitch_rad,
            table.long_dwell_us,
            long_x_us,
            long_y_us,
            short_x_us,
            short_y_us,
            lead_in_us,
            table.early_us,
            table.early_dwell_us,
        )


class BeamPath:
    """Mirror angles of every pixel, and the settling time of each move between two pixels.

    x_rad, y_rad: [p] mechanical mirror angles
    lead_in_us: settling time of a move from an unknown pixel
    moves: the same for kernels
    """

    def __init__(self, scan_head: ScanHead, lead_in_us: int) -> None:
        self.lead_in_us = lead_in_us
        self.moves = scan_head.moves._replace(lead_in_us=lead_in_us)
        self.x_rad, self.y_rad = self.moves.x_rad, self.moves.y_rad
        self._x_rad, self._y_rad = scan_head.angle_lists
        self._layout = scan_head.layout
        self._settling = scan_head.settling

    def compute_settling_us(self, origin: int | None, pixel: int, dwell_us: int = 0) -> int:
        """Return the gate-off time of a move to `pixel` after `dwell_us` on `origin`.

        origin: None for an unknown pixel
        """
        if origin is None:
            return self.lead_in_us
        return self._settling.settling_us(
            self._x_rad[pixel] - self._x_rad[origin], self._y_rad[pixel] - self._y_rad[origin], dwell_us
        )

    def orient(self, path: IntArray, origin: int | None) -> list[int]:
        """Return a path over pixels [k] from its end that is nearer to `origin`, if that is known."""
        visits: list[int] = path.tolist()
        if origin is None or not visits:
            return visits
        first_us, last_us = (self.compute_settling_us(origin, pixel) for pixel in (visits[0], visits[-1]))
        return visits[::-1] if last_us < first_us else visits

    def compute_order(self, active: IntArray, origin: int | None) -> list[int]:
        """Return a short visiting order of the pixels `active` [k], starting from `origin` if it is known."""
        layout = self._layout
        order = compute_visiting_order(active, layout.row, layout.column, self.x_rad, self.y_rad, origin, True)
        visits: list[int] = order.tolist()
        return visits
