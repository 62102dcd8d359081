"""How long the mirrors need: both axes move at once, the farther one decides."""

from dataclasses import dataclass
from math import ceil


@dataclass(frozen=True)
class MoveModel:
    """A move of distance d takes settle_s + d / slew_rad_per_s; no move takes no time."""

    settle_s: float
    slew_rad_per_s: float

    def time_us(self, dx_rad: float, dy_rad: float) -> int:
        """Dark time to keep for a move, µs, rounded up, with one for the rounding of codes on the wire."""
        distance_rad = max(abs(dx_rad), abs(dy_rad))
        if distance_rad == 0.0:
            return 0
        return ceil(1e6 * (self.settle_s + distance_rad / self.slew_rad_per_s)) + 1
