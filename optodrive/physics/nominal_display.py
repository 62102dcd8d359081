"""Thermal state of a display of nominal pixels, in closed form, each advanced only at its own events."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from optodrive.core.kernels import array_kernel, kernel
from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.core.types.measurements import PixelTrace
from optodrive.physics.parameters import PixelArray
from optodrive.physics.pixel import Pixel, advance, cooling_peak, gas_peak
from optodrive.physics.pulse_for_height import DriveRange, find_shortest_pulse, max_displacement_m

TIME_ROUNDING_S = 1e-9
"""Overlap of two events that counts as rounding of their times."""


def ignore_progress() -> None:
    """Do nothing, as the default progress callback."""


class PulsePeaks(NamedTuple):
    """Peaks that each pulse [n] causes on its pixel, from its start to the pixel's next pulse, if there is one.

    displacement_m: of the membrane; absorber_k: rise of the absorber above ambient, reached at an end of the pulse.
    """

    displacement_m: FloatArray
    absorber_k: FloatArray


class DisplayState(NamedTuple):
    """State of every pixel [p] at one time: displacement of the membrane, rise of the absorber above ambient."""

    displacement_m: FloatArray
    absorber_k: FloatArray


def build_kernel_columns(
    pixels: int, pixel: IntArray, start_s: FloatArray, width_s: FloatArray, power_w: FloatArray
) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
    """Return the columns of pulses [n] as copies of one type and memory layout, which kernels require.

    pixels: number of pixels. Raises IndexError for a pixel out of range, because kernels do not check bounds, and
    ValueError for columns of unequal length.
    """
    index = np.array(pixel, dtype=np.int64)
    if len(index) and not 0 <= index.min() <= index.max() < pixels:
        raise IndexError(f"pixels {index.min()} to {index.max()} of {pixels}")
    if not len(index) == len(start_s) == len(width_s) == len(power_w):
        raise ValueError("columns of pulses differ in length")
    # Copies of one type and layout: for another one numba would compile every kernel again.
    return index, np.array(start_s, dtype=float), np.array(width_s, dtype=float), np.array(power_w, dtype=float)


class NominalThermalState:
    """Mutable thermal state of every pixel, see `ThermalState`."""

    def __init__(self, pixels: PixelArray, at_s: float = 0.0) -> None:
        self.pixels = pixels
        self._columns = np.stack([getattr(pixels, name) for name in Pixel._fields], axis=1)
        self._at_s = np.full(len(pixels), at_s)
        self._theta_k = np.zeros(len(pixels))
        self._gamma_k = np.zeros(len(pixels))

    @property
    def kernel_state(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Parameters [p, 6], time of the last event and the rises then, each [p], as kernels take them."""
        return self._columns, self._at_s, self._theta_k, self._gamma_k

    def copy(self) -> "NominalThermalState":
        """Return an independent copy."""
        return self.copy_shifted(0.0)

    def copy_shifted(self, offset_s: float) -> "NominalThermalState":
        """Return a copy whose times are offset_s later, on a time line whose zero is offset_s earlier."""
        twin = NominalThermalState.__new__(NominalThermalState)
        twin.pixels, twin._columns = self.pixels, self._columns
        twin._at_s = self._at_s + offset_s
        twin._theta_k = self._theta_k.copy()
        twin._gamma_k = self._gamma_k.copy()
        return twin

    def rises_k(self, pixel: int, at_s: float) -> tuple[float, float]:
        """Return absorber and gas rise of a pixel, K, with the gate off until at_s.

        Raises ValueError for a time before the pixel's last event.
        """
        off_s = at_s - self._at_s[pixel]
        if off_s < -TIME_ROUNDING_S:
            raise self.build_time_order_error(pixel, at_s)
        return advance(self.pixels.elements[pixel], self._theta_k[pixel], self._gamma_k[pixel], 0.0, max(0.0, off_s))

    def build_time_order_error(self, pixel: int, at_s: float) -> ValueError:
        """Build the error of an event before a pixel's last one."""
        return ValueError(f"pixel {pixel} was advanced to {self._at_s[pixel]} s, {at_s} s lies before it")

    def apply_pulse(self, pixel: int, start_s: float, width_s: float, power_w: float) -> None:
        """Apply one pulse of mean incident power power_w."""
        self.apply_pulses(np.array([pixel]), np.array([start_s]), np.array([width_s]), np.array([power_w]))

    def apply_pulses(
        self,
        pixel: IntArray,
        start_s: FloatArray,
        width_s: FloatArray,
        power_w: FloatArray,
        on_progress: Callable[[], None] = ignore_progress,
    ) -> PulsePeaks:
        """Apply pulses, all [n], those of each pixel in order of time.

        power_w is the mean incident power. Returns their peaks. on_progress is not called: a million pulses take a
        fifth of a second. Raises ValueError for a pulse that starts before its pixel's last event; the pulses before it
        remain applied.
        """
        columns = build_kernel_columns(len(self.pixels), pixel, start_s, width_s, power_w)
        peaks = PulsePeaks(np.zeros(len(pixel)), np.zeros(len(pixel)))
        done = _apply_pulses(self._columns, self._at_s, self._theta_k, self._gamma_k, *columns, *peaks)
        if done < len(pixel):
            raise self.build_time_order_error(int(pixel[done]), float(start_s[done]))
        return peaks

    def check_tested(self) -> None:
        """See `ThermalState.check_tested`. The nominal pixel has no such function."""

    def solve_pulse(
        self,
        pixel: int,
        start_s: float,
        target_m: float,
        drive: DriveRange,
        min_periods: int = 1,
        peak_after_s: float = 0.0,
    ) -> tuple[float, float] | None:
        """See `ThermalState.solve_pulse`."""
        if not 0 <= pixel < len(self._at_s):
            raise IndexError(f"pixel {pixel} of {len(self._at_s)}")
        longest = drive.max_periods
        periods, duty = solve_pulse_at(
            *self.kernel_state,
            pixel,
            float(start_s),
            float(target_m),
            drive.max_power_w,
            drive.period_s,
            min(min_periods, longest),
            longest,
            drive.is_fine,
            drive.min_duty,
            float(peak_after_s),
        )
        if periods < 0:
            raise self.build_time_order_error(pixel, start_s)
        return (periods, duty) if periods else None

    def max_displacement_m(self, drive: DriveRange) -> FloatArray:
        """Return the largest displacement that one pulse can reach on each cold pixel, m, [p]."""
        # Most displays have one kind of pixel, computed once.
        by_pixel = {pixel: max_displacement_m(pixel, drive) for pixel in set(self.pixels.elements)}
        return np.array([by_pixel[pixel] for pixel in self.pixels.elements])

    def peak_m(self, pixel: int, within_s: float = float("inf")) -> float:
        """Return the peak displacement of a pixel, m, within within_s after its last event."""
        parameters = self.pixels.elements[pixel]
        peak_k, _ = cooling_peak(parameters, self._theta_k[pixel], self._gamma_k[pixel], within_s)
        return parameters.kappa_m_per_k * peak_k

    def simulate_rises_k(self, pixel: int, pulses: FloatArray, t_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return absorber and gas rise of a pixel, K, each [m], at increasing times t_s [m]. The state does not change.

        pulses: [n, 3] start_s, width_s, power_w in order. Raises ValueError for a pulse or a time before the pixel's
        last event.
        """
        events_s = np.concatenate([[self._at_s[pixel]], pulses[:, 0] + pulses[:, 1]])
        for requested_s, after_s in ((pulses[:, 0], events_s[:-1]), (t_s[:1], events_s[:1])):
            early = np.flatnonzero(requested_s < after_s[: len(requested_s)] - TIME_ROUNDING_S)
            if len(early):
                raise ValueError(
                    f"pixel {pixel} at {requested_s[early[0]]} s: its last event is at {after_s[early[0]]} s"
                )
        absorber_k, gas_k = np.zeros(len(t_s)), np.zeros(len(t_s))
        start = self._at_s[pixel], self._theta_k[pixel], self._gamma_k[pixel]
        _sample_rises(self.pixels.elements[pixel], *start, np.array(pulses), np.array(t_s), absorber_k, gas_k)
        return absorber_k, gas_k

    def simulate_displacement_m(self, pulses: FloatArray, pixel: int, t_s: FloatArray) -> FloatArray:
        """See `ThermalState.simulate_displacement_m`."""
        gas_k = self.simulate_rises_k(pixel, pulses[pulses[:, 3] == pixel, :3], t_s)[1]
        return self.pixels.elements[pixel].kappa_m_per_k * gas_k

    def state_at(self, at_s: float) -> DisplayState:
        """Return every pixel at one time, with the gate off since its last event, or at that event if it is later."""
        state = DisplayState(np.zeros(len(self.pixels)), np.zeros(len(self.pixels)))
        _compute_snapshot(self._columns, self._at_s, self._theta_k, self._gamma_k, float(at_s), *state)
        return state

    def simulate_traces(self, pulses: FloatArray, pixels: list[int], t_s: FloatArray) -> PixelTrace:
        """See `ThermalState.simulate_traces`. They are exact."""
        absorber_k, gas_k = np.zeros((len(t_s), len(pixels))), np.zeros((len(t_s), len(pixels)))
        for column, index in enumerate(pixels):
            pixel_pulses = pulses[pulses[:, 3] == index, :3]
            absorber_k[:, column], gas_k[:, column] = self.simulate_rises_k(index, pixel_pulses, t_s)
        each = [self.pixels.elements[index] for index in pixels]
        return PixelTrace(
            t_s=t_s,
            pixel=np.array(pixels, dtype=np.int64),
            absorber_k=absorber_k,
            gas_k=gas_k,
            displacement_m=gas_k * np.array([item.kappa_m_per_k for item in each]),
            force_n=gas_k * np.array([item.phi_n_per_k for item in each]),
        )


@array_kernel
def _apply_pulses(
    columns: FloatArray,
    at_s: FloatArray,
    theta_k: FloatArray,
    gamma_k: FloatArray,
    pixel: IntArray,
    start_s: FloatArray,
    width_s: FloatArray,
    power_w: FloatArray,
    peak_m: FloatArray,
    peak_k: FloatArray,
) -> int:
    """Apply pulses [n] and fill in their peaks [n]. Return the number of pulses before the first one out of order.

    columns: [p, 6] the fields of `Pixel`; at_s, theta_k, gamma_k: [p] time of the last event and the rises then
    """
    last = np.full(len(at_s), -1)
    for row in range(len(pixel)):
        i = pixel[row]
        one = pixel_at(columns, i)
        off_s = start_s[row] - at_s[i]
        if off_s < -TIME_ROUNDING_S:
            return row
        off_s = max(0.0, off_s)
        if last[i] >= 0:
            # The membrane lags: a pulse's peak may come after its end, and counts until the pixel's next pulse.
            off_peak_k = cooling_peak(one, theta_k[i], gamma_k[i], off_s)[0]
            peak_m[last[i]] = max(peak_m[last[i]], one.kappa_m_per_k * off_peak_k)
        absorber_k, gas_k = advance(one, theta_k[i], gamma_k[i], 0.0, off_s)
        peak_m[row] = one.kappa_m_per_k * gas_peak(one, absorber_k, gas_k, power_w[row], width_s[row])[0]
        theta_k[i], gamma_k[i] = advance(one, absorber_k, gas_k, power_w[row], width_s[row])
        # Monotone within a pulse, so hottest at one of its ends.
        peak_k[row] = max(absorber_k, theta_k[i])
        at_s[i] = start_s[row] + width_s[row]
        last[i] = row
    for i in range(len(at_s)):
        if last[i] >= 0:
            one = pixel_at(columns, i)
            off_peak_k = cooling_peak(one, theta_k[i], gamma_k[i], np.inf)[0]
            peak_m[last[i]] = max(peak_m[last[i]], one.kappa_m_per_k * off_peak_k)
    return len(pixel)


@kernel
def _compute_snapshot(
    columns: FloatArray,
    at_s: FloatArray,
    theta_k: FloatArray,
    gamma_k: FloatArray,
    now_s: float,
    displacement_m: FloatArray,
    absorber_k: FloatArray,
) -> None:
    """Fill in displacement and absorber rise of every pixel [p] at now_s, with the gate off since its last event."""
    for i in range(len(at_s)):
        one = pixel_at(columns, i)
        absorber_k[i], gas_k = advance(one, theta_k[i], gamma_k[i], 0.0, max(0.0, now_s - at_s[i]))
        displacement_m[i] = one.kappa_m_per_k * gas_k


@kernel
def solve_pulse_at(
    columns: FloatArray,
    last_s: FloatArray,
    theta_k: FloatArray,
    gamma_k: FloatArray,
    i: int,
    start_s: float,
    target_m: float,
    max_power_w: float,
    period_s: float,
    min_periods: int,
    max_periods: int,
    is_fine: bool,
    min_duty: float,
    peak_after_s: float,
) -> tuple[float, float]:
    """Solve as `solve_pulse`.

    Returns 0 periods if no pulse is needed, -1 if start_s is before the pixel's last event.
    It is one kernel because a call from Python costs as much as the computation.
    """
    one, off_s = pixel_at(columns, i), start_s - last_s[i]
    if off_s < -TIME_ROUNDING_S:
        return -1.0, 0.0
    absorber_k, gas_k = advance(one, theta_k[i], gamma_k[i], 0.0, max(0.0, off_s))
    # A dead pixel has κ = 0 and gets an infinite target: no pulse reaches it, and none is asked to.
    target_k = target_m / one.kappa_m_per_k
    return find_shortest_pulse(
        one,
        absorber_k,
        gas_k,
        target_k,
        max_power_w,
        period_s,
        min_periods,
        max_periods,
        is_fine,
        min_duty,
        peak_after_s,
    )


@kernel
def pixel_at(columns: FloatArray, i: int) -> Pixel:
    """Return row i of columns [p, 6], the fields of `Pixel`."""
    one = columns[i]
    return Pixel(one[0], one[1], one[2], one[3], one[4], one[5])


@kernel
def _sample_rises(
    one: Pixel,
    end_s: float,
    theta_k: float,
    gamma_k: float,
    pulses: FloatArray,
    t_s: FloatArray,
    absorber_k: FloatArray,
    gas_k: FloatArray,
) -> None:
    """Fill in the rises of a pixel at t_s [m] through its pulses [n, 3], from its rises at its last event, end_s."""
    begin_s, power_w, begin_theta_k, begin_gamma_k = end_s, 0.0, theta_k, gamma_k
    upcoming = 0
    for row in range(len(t_s)):
        while upcoming < len(pulses) and t_s[row] >= pulses[upcoming, 0]:
            off_s = max(0.0, pulses[upcoming, 0] - end_s)
            begin_theta_k, begin_gamma_k = advance(one, theta_k, gamma_k, 0.0, off_s)
            begin_s, power_w = pulses[upcoming, 0], pulses[upcoming, 2]
            theta_k, gamma_k = advance(one, begin_theta_k, begin_gamma_k, power_w, pulses[upcoming, 1])
            end_s = begin_s + pulses[upcoming, 1]
            upcoming += 1
        if t_s[row] < end_s:
            on_s = max(0.0, t_s[row] - begin_s)
            absorber_k[row], gas_k[row] = advance(one, begin_theta_k, begin_gamma_k, power_w, on_s)
        else:
            absorber_k[row], gas_k[row] = advance(one, theta_k, gamma_k, 0.0, t_s[row] - end_s)
