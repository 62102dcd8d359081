"""Optics and laser as the scheduler sees them, and the times of the mirrors' moves between pixels."""

from dataclasses import dataclass

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


class BeamPath:
    """Mirror angles of every pixel, and the settling time of each move between two pixels.

    x_rad, y_rad: [p] mechanical mirror angles
    lead_in_us: settling time of a move from an unknown pixel
    """

    def __init__(self, scan_head: ScanHead, lead_in_us: int) -> None:
        x_rad, y_rad = scan_head.field.angles_rad(scan_head.layout.x_m, scan_head.layout.y_m)
        self.x_rad: FloatArray = np.array(x_rad)
        self.y_rad: FloatArray = np.array(y_rad)
        self.lead_in_us = lead_in_us
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
