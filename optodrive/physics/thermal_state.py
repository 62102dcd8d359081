"""The heat of a display, as planner, daemon and simulation see it: of nominal pixels, or of pixels with terms."""

from collections.abc import Callable
from typing import Protocol, Self

from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.core.types.measurements import PixelTrace
from optodrive.core.units import ZERO_CELSIUS_K
from optodrive.device.config import Config
from optodrive.device.neighbours import Neighbours
from optodrive.physics.nominal_display import DisplayState, NominalThermalState, PulsePeaks, ignore_progress
from optodrive.physics.parameters import ParameterSet, PixelArray, build_display_pixels
from optodrive.physics.pulse_for_height import DriveRange


class ThermalState(Protocol):
    """Mutable; pixels carry their own time, all on one time line. See `DisplayHeat`."""

    pixels: PixelArray

    def copy(self) -> Self:
        """An independent copy."""

    def copy_shifted(self, offset_s: float) -> Self:
        """A copy on a time line whose zero lies offset_s earlier."""

    def apply_pulses(
        self,
        pixel: IntArray,
        start_s: FloatArray,
        width_s: FloatArray,
        power_w: FloatArray,
        on_progress: Callable[[], None] = ignore_progress,
    ) -> PulsePeaks:
        """Light pixels one after the other, all [n]; what each pulse brings its pixel to. tick: called meanwhile."""

    def solve_pulse(
        self,
        pixel: int,
        start_s: float,
        target_m: float,
        drive: DriveRange,
        min_periods: int = 1,
        peak_after_s: float = 0.0,
    ) -> tuple[int, float] | None:
        """PWM periods, at least so many, and duty of the shortest pulse whose peak is target_m; None: none is needed.

        from_s: the peak counts only from so long after the pulse's start on, beyond its end.
        """

    def max_displacement_m(self, drive: DriveRange) -> FloatArray:
        """The largest displacement that one pulse can reach from rest, [p]."""

    def simulate_displacement_m(self, pulses: FloatArray, pixel: int, t_s: FloatArray) -> FloatArray:
        """Displacement of a pixel at times t_s [m] under pulses [n, 4], from the heat there is, which stays."""

    def state_at(self, at_s: float) -> DisplayState:
        """Every pixel at one time, in the dark since its last event; a time before that event counts as the event's."""

    def simulate_traces(self, pulses: FloatArray, pixels: list[int], t_s: FloatArray) -> PixelTrace:
        """What some pixels do at times t_s [m] under pulses [n, 4]: start_s, width_s, power_w, pixel."""


def build_cold_state(config: Config, parameters: ParameterSet, pixels: PixelArray | None = None) -> ThermalState:
    """A configured display that nobody has lit, with the terms that the parameter set plans with.

    pixels: in place of those that the configuration and the set say.
    """
    if pixels is None:
        pixels = build_display_pixels(config, parameters)
    values = {key: parameters.term_values(key) for key in parameters.planner_terms}
    if not values:
        return NominalThermalState(pixels)
    # The stepped pixel is compiled code of its own, which nobody needs without terms.
    from optodrive.physics.extended_display import ExtendedThermalState

    ambient_k = config.ambient_c + ZERO_CELSIUS_K
    return ExtendedThermalState(
        pixels, values, ambient_k, config.laser.max_power_w, Neighbours.from_display(config.display)
    )
