"""Optics and laser as the scheduler sees them, and the times of the mirrors' moves between pixels."""

from dataclasses import dataclass
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


class MoveTimes(NamedTuple):
    """Mirror angles of the pixels [p], and the times of moves between them, for kernels; as `SettlingTable`."""

    x_rad: FloatArray
    y_rad: FloatArray
    pitch_rad: float
    long_dwell_us: int
    long_x_us: IntArray
    long_y_us: IntArray
    short_x_us: IntArray
    short_y_us: IntArray
    lead_in_us: int

    @classmethod
    def from_table(cls, table: SettlingTable, x_rad: FloatArray, y_rad: FloatArray, lead_in_us: int) -> "MoveTimes":
        """Return the times of a table for pixels at these angles [p]; lead_in_us: of a move from an unknown pixel."""
        long_x_us, long_y_us = (np.array(times_us, dtype=np.int64) for times_us in table.after_long_dwell)
        short_x_us, short_y_us = (np.array(times_us, dtype=np.int64) for times_us in table.after_short_dwell)
        dwell_us = table.long_dwell_us
        return cls(x_rad, y_rad, table.pitch_rad, dwell_us, long_x_us, long_y_us, short_x_us, short_y_us, lead_in_us)


class BeamPath:
    """Mirror angles of every pixel, and the settling time of each move between two pixels.

    x_rad, y_rad: [p] mechanical mirror angles
    lead_in_us: settling time of a move from an unknown pixel
    moves: the same for kernels
    """

    def __init__(self, scan_head: ScanHead, lead_in_us: int) -> None:
        x_rad, y_rad = scan_head.field.angles_rad(scan_head.layout.x_m, scan_head.layout.y_m)
        self.x_rad: FloatArray = np.array(x_rad)
        self.y_rad: FloatArray = np.array(y_rad)
        self.lead_in_us = lead_in_us
        self.moves = MoveTimes.from_table(scan_head.settling, self.x_rad, self.y_rad, lead_in_us)
        # Lists, because single elements of a list are read faster than those of an array.
        self._x_rad: list[float] = self.x_rad.tolist()
        self._y_rad: list[float] = self.y_rad.tolist()
        self._layout = scan_head.layout
        self._settling = scan_head.settling

    def compute_settling_us(self, origin: int | None, pixel: int, dwell_us: int = 0) -> int:
        """Return the gate-off time of a move to `pixel` after `dwell_us` on `origin`; None: from an unknown pixel."""
        if origin is None:
            return self.lead_in_us
        return self._settling.settling_us(
            self._x_rad[pixel] - self._x_rad[origin], self._y_rad[pixel] - self._y_rad[origin], dwell_us
        )

    def compute_order(self, active: IntArray, origin: int | None) -> list[int]:
        """Return a short visiting order of the pixels `active` [k], starting from `origin` if it is known."""
        layout = self._layout
        order = compute_visiting_order(active, layout.row, layout.column, self.x_rad, self.y_rad, origin)
        return [int(pixel) for pixel in order]
