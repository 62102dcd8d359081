"""Thermal state of a display, the common interface of nominal pixels and of pixels with terms."""

from collections.abc import Callable
from typing import Protocol, Self

from optodrive.core.quantity import ZERO_CELSIUS_K
from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.core.types.measurements import PixelTrace
from optodrive.device.config import Config
from optodrive.device.panel import Neighbours
from optodrive.physics.nominal_display import DisplayState, NominalThermalState, PulsePeaks, ignore_progress
from optodrive.physics.parameters import ParameterSet, PixelArray, build_display_pixels
from optodrive.physics.pulse_for_height import DriveRange


class ThermalState(Protocol):
    """Mutable thermal state of every pixel. Each pixel has its own time of last event, on one common time line."""

    pixels: PixelArray

    def copy(self) -> Self:
        """Return an independent copy."""

    def copy_shifted(self, offset_s: float) -> Self:
        """Return a copy whose times are offset_s later, on a time line whose zero is offset_s earlier."""

    def apply_pulses(
        self,
        pixel: IntArray,
        start_s: FloatArray,
        width_s: FloatArray,
        power_w: FloatArray,
        on_progress: Callable[[], None] = ignore_progress,
    ) -> PulsePeaks:
        """Apply pulses [n] in order of time and return the peaks that they cause. on_progress is called meanwhile."""

    def check_tested(self) -> None:
        """Raise InputError if a pulse that this very copy applied led out of the range of the data of a function.

        That is of a function that a discovery found: what it is beyond its data nobody knows.
        """

    def solve_pulse(
        self,
        pixel: int,
        start_s: float,
        target_m: float,
        drive: DriveRange,
        min_periods: int = 1,
        peak_after_s: float = 0.0,
    ) -> tuple[float, float] | None:
        """Return PWM periods and duty of the shortest pulse at start_s whose peak displacement is target_m.

        The periods are whole ones, unless the drive is fine and the duty is 1.

        Returns None if the residual heat already reaches the target, and the longest pulse if none reaches it. The
        pulse has at least min_periods, within the drive's range. peak_after_s: the peak counts only from this time
        after the pulse's start, and not before its end. Raises ValueError for a time before the pixel's last event.
        """

    def max_displacement_m(self, drive: DriveRange) -> FloatArray:
        """Return the largest displacement that one pulse can reach on each cold pixel, [p]."""

    def simulate_displacement_m(self, pulses: FloatArray, pixel: int, t_s: FloatArray) -> FloatArray:
        """Return the displacement of a pixel, m, at increasing times t_s [m]. The state does not change.

        pulses: [n, 4] start_s, width_s, power_w, pixel in order. Raises ValueError for a pulse or a time before the
        pixel's last event.
        """

    def state_at(self, at_s: float) -> DisplayState:
        """Return every pixel at one time, with the gate off since its last event, or at that event if it is later."""

    def simulate_traces(self, pulses: FloatArray, pixels: list[int], t_s: FloatArray) -> PixelTrace:
        """Return the traces of some pixels at increasing times t_s [m].

        pulses: [n, 4] start_s, width_s, power_w, pixel in order, after each pixel's last event.
        """


def build_cold_state(config: Config, parameters: ParameterSet, pixels: PixelArray | None = None) -> ThermalState:
    """Return the cold state of a configured display with the parameter set's planner terms.

    pixels: replaces the pixels of the configuration and the parameter set.
    """
    if pixels is None:
        pixels = build_display_pixels(config, parameters)
    values = {key: parameters.term_values(key) for key in parameters.planner_terms}
    if not values:
        # Without planner terms the closed form: microseconds per pulse in place of a millisecond.
        return NominalThermalState(pixels)
    # Imported late: loading the kernels of the pixel with terms takes time that nominal displays do not need.
    from optodrive.physics.extended_display import ExtendedThermalState

    ambient_k = config.ambient_c + ZERO_CELSIUS_K
    return ExtendedThermalState(
        pixels, values, ambient_k, config.laser.max_power_w, Neighbours.from_display(config.display)
    )
