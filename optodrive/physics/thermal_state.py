"""The heat of a display, as planner, daemon and simulation see it: of nominal pixels, or of pixels with terms."""

from collections.abc import Callable
from typing import Protocol, Self

from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.core.types.measurements import PixelTrace
from optodrive.core.units import ZERO_CELSIUS_K
from optodrive.device.config import Config
from optodrive.device.neighbours import Neighbours
from optodrive.physics.nominal_display import DisplayHeat, Heights, Peaks, nothing
from optodrive.physics.parameters import ParameterSet, PixelArray, display_pixels
from optodrive.physics.pulse_for_height import DriveRange


class Heat(Protocol):
    """Mutable; pixels carry their own time, all on one time line. See `DisplayHeat`."""

    pixels: PixelArray

    def copy(self) -> Self:
        """An independent copy."""

    def shifted(self, offset_s: float) -> Self:
        """A copy on a time line whose zero lies offset_s earlier."""

    def pulses(
        self,
        pixel: IntArray,
        start_s: FloatArray,
        width_s: FloatArray,
        power_w: FloatArray,
        tick: Callable[[], None] = nothing,
    ) -> Peaks:
        """Light pixels one after the other, all [n]; what each pulse brings its pixel to. tick: called meanwhile."""

    def pulse_for_peak(
        self, pixel: int, at_s: float, target_m: float, drive: DriveRange, least_periods: int = 1, from_s: float = 0.0
    ) -> tuple[int, float] | None:
        """PWM periods, at least so many, and duty of the shortest pulse whose peak is target_m; None: none is needed.

        from_s: the peak counts only from so long after the pulse's start on, beyond its end.
        """

    def reaches_m(self, drive: DriveRange) -> FloatArray:
        """The largest displacement that one pulse can reach from rest, [p]."""

    def heights_m(self, pulses: FloatArray, pixel: int, t_s: FloatArray) -> FloatArray:
        """Displacement of a pixel at times t_s [m] under pulses [n, 4], from the heat there is, which stays."""

    def at(self, at_s: float) -> Heights:
        """Every pixel at one time, in the dark since its last event; a time before that event counts as the event's."""

    def traces(self, pulses: FloatArray, pixels: list[int], t_s: FloatArray) -> PixelTrace:
        """What some pixels do at times t_s [m] under pulses [n, 4]: start_s, width_s, power_w, pixel."""


def heat_at_rest(config: Config, parameters: ParameterSet, pixels: PixelArray | None = None) -> Heat:
    """A configured display that nobody has lit, with the terms that the parameter set plans with.

    pixels: in place of those that the configuration and the set say.
    """
    if pixels is None:
        pixels = display_pixels(config, parameters)
    values = {key: parameters.term_values(key) for key in parameters.planner_terms}
    if not values:
        return DisplayHeat(pixels)
    # The stepped pixel is compiled code of its own, which nobody needs without terms.
    from optodrive.physics.extended_display import ExtendedHeat

    ambient_k = config.ambient_c + ZERO_CELSIUS_K
    return ExtendedHeat(pixels, values, ambient_k, config.laser.max_power_w, Neighbours.of(config.display))
