"""A whole display, event by event: each pixel is advanced only when something is asked of it."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.core.types.measurements import PixelTrace
from optodrive.physics.parameters import PixelArray
from optodrive.physics.pixel import Pixel, advance, cooling_peak, gas_peak
from optodrive.physics.pulse_for_height import DriveRange, find_shortest_pulse, max_displacement_m

TIME_ROUNDING_S = 1e-9


def ignore_progress() -> None:
    """Done while something takes its time, where nobody asked for more."""


class PulsePeaks(NamedTuple):
    """The most each pulse [n] brings its pixel to, from its start to the pixel's next pulse, or for ever.

    displacement_m: membrane; absorber_k: absorber over ambient, which is its rise at one end of the pulse.
    """

    displacement_m: FloatArray
    absorber_k: FloatArray


class DisplayState(NamedTuple):
    """A display at one time. displacement_m: membrane; absorber_k: absorber over ambient; both [p]."""

    displacement_m: FloatArray
    absorber_k: FloatArray


def build_kernel_columns(
    pixels: int, pixel: IntArray, start_s: FloatArray, width_s: FloatArray, power_w: FloatArray
) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
    """Pulses [n] as a kernel takes them, which does not look where it writes: IndexError for no pixel of `pixels`.

    Copies, because a kernel is compiled for one layout and one writability of its arrays.
    """
    index = np.array(pixel, dtype=np.int64)
    if len(index) and not 0 <= index.min() <= index.max() < pixels:
        raise IndexError(f"pixels {index.min()} to {index.max()} of {pixels}")
    if not len(index) == len(start_s) == len(width_s) == len(power_w):
        raise ValueError("columns of pulses differ in length")
    return index, np.array(start_s, dtype=float), np.array(width_s, dtype=float), np.array(power_w, dtype=float)


class NominalThermalState:
    """The heat of every pixel of a display; mutable. Pixels carry their own time, all on one time line."""

    def __init__(self, pixels: PixelArray, at_s: float = 0.0) -> None:
        self.pixels = pixels
        self._columns = np.stack([getattr(pixels, name) for name in Pixel._fields], axis=1)
        self._at_s = np.full(len(pixels), at_s)
        self._theta_k = np.zeros(len(pixels))
        self._gamma_k = np.zeros(len(pixels))

    def copy(self) -> "NominalThermalState":
        """An independent copy."""
        return self.copy_shifted(0.0)

    def copy_shifted(self, offset_s: float) -> "NominalThermalState":
        """A copy on a time line whose zero lies offset_s earlier."""
        twin = NominalThermalState.__new__(NominalThermalState)
        twin.pixels, twin._columns = self.pixels, self._columns
        twin._at_s = self._at_s + offset_s
        twin._theta_k = self._theta_k.copy()
        twin._gamma_k = self._gamma_k.copy()
        return twin

    def rises_k(self, pixel: int, at_s: float) -> tuple[float, float]:
        """Absorber and gas rise, K, of a pixel left dark until at_s; ValueError for a time before its last event."""
        dark_s = at_s - self._at_s[pixel]
        if dark_s < -TIME_ROUNDING_S:
            raise self._time_order_error(pixel, at_s)
        return advance(self.pixels.elements[pixel], self._theta_k[pixel], self._gamma_k[pixel], 0.0, max(0.0, dark_s))

    def _time_order_error(self, pixel: int, at_s: float) -> ValueError:
        return ValueError(f"pixel {pixel} was advanced to {self._at_s[pixel]} s, {at_s} s lies before it")

    def apply_pulse(self, pixel: int, start_s: float, width_s: float, power_w: float) -> None:
        """Light a pixel from start_s for width_s at the mean incident power power_w."""
        self.apply_pulses(np.array([pixel]), np.array([start_s]), np.array([width_s]), np.array([power_w]))

    def apply_pulses(
        self,
        pixel: IntArray,
        start_s: FloatArray,
        width_s: FloatArray,
        power_w: FloatArray,
        on_progress: Callable[[], None] = ignore_progress,
    ) -> PulsePeaks:
        """Light pixels one after the other; all [n], pulses of a pixel in order of time, power the mean incident one.

        tick is not needed here: a million pulses take a fifth of a second.
        ValueError for a pulse that starts before its pixel's last event; those before it have been.
        """
        columns = build_kernel_columns(len(self.pixels), pixel, start_s, width_s, power_w)
        peaks = PulsePeaks(np.zeros(len(pixel)), np.zeros(len(pixel)))
        done = _apply_pulses(self._columns, self._at_s, self._theta_k, self._gamma_k, *columns, *peaks)
        if done < len(pixel):
            raise self._time_order_error(int(pixel[done]), float(start_s[done]))
        return peaks

    def solve_pulse(
        self,
        pixel: int,
        start_s: float,
        target_m: float,
        drive: DriveRange,
        min_periods: int = 1,
        peak_after_s: float = 0.0,
    ) -> tuple[int, float] | None:
        """PWM periods and duty of the shortest pulse at at_s whose peak is target_m; None where none is needed.

        It has least_periods at least, as far as the drive allows; a target beyond the longest pulse gets that one.
        from_s: the peak counts only from so long after the pulse's start on, beyond its end.
        ValueError for a time before the pixel's last event.
        """
        if not 0 <= pixel < len(self._at_s):
            raise IndexError(f"pixel {pixel} of {len(self._at_s)}")
        span = (drive.max_power_w, drive.period_s, min(min_periods, drive.max_periods), drive.max_periods)
        state = (self._columns, self._at_s, self._theta_k, self._gamma_k)
        periods, duty = _solve_pulse_at(*state, pixel, float(start_s), float(target_m), *span, float(peak_after_s))
        if periods < 0:
            raise self._time_order_error(pixel, start_s)
        return (periods, duty) if periods else None

    def max_displacement_m(self, drive: DriveRange) -> FloatArray:
        """The largest displacement that one pulse can reach from rest, [p]."""
        reach = {pixel: max_displacement_m(pixel, drive) for pixel in set(self.pixels.elements)}
        return np.array([reach[pixel] for pixel in self.pixels.elements])

    def peak_m(self, pixel: int, within_s: float = float("inf")) -> float:
        """Largest displacement, m, of a pixel from its last event on, within_s seconds at most."""
        parameters = self.pixels.elements[pixel]
        peak_k, _ = cooling_peak(parameters, self._theta_k[pixel], self._gamma_k[pixel], within_s)
        return parameters.kappa_m_per_k * peak_k

    def simulate_rises_k(self, pixel: int, pulses: FloatArray, t_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Absorber and gas rise, K, each [m], of a pixel at times t_s [m], increasing; the heat stays as it is.

        pulses: [n, 3] start_s, width_s, power_w in order; ValueError for one, or a time, before the last event.
        """
        events_s = np.concatenate([[self._at_s[pixel]], pulses[:, 0] + pulses[:, 1]])
        for asked_s, after_s in ((pulses[:, 0], events_s[:-1]), (t_s[:1], events_s[:1])):
            early = np.flatnonzero(asked_s < after_s[: len(asked_s)] - TIME_ROUNDING_S)
            if len(early):
                raise ValueError(f"pixel {pixel} at {asked_s[early[0]]} s: its last event is at {after_s[early[0]]} s")
        absorber_k, gas_k = np.zeros(len(t_s)), np.zeros(len(t_s))
        start = self._at_s[pixel], self._theta_k[pixel], self._gamma_k[pixel]
        _sample_rises(self.pixels.elements[pixel], *start, np.array(pulses), np.array(t_s), absorber_k, gas_k)
        return absorber_k, gas_k

    def simulate_displacement_m(self, pulses: FloatArray, pixel: int, t_s: FloatArray) -> FloatArray:
        """Displacement of a pixel at times t_s [m], increasing, from the heat there is, which stays as it is.

        pulses: [n, 4] start_s, width_s, power_w, pixel in order; ValueError for one, or a time, before the last event.
        """
        gas_k = self.simulate_rises_k(pixel, pulses[pulses[:, 3] == pixel, :3], t_s)[1]
        return self.pixels.elements[pixel].kappa_m_per_k * gas_k

    def state_at(self, at_s: float) -> DisplayState:
        """Every pixel at one time, in the dark since its last event; a time before that event counts as the event's."""
        seen = DisplayState(np.zeros(len(self.pixels)), np.zeros(len(self.pixels)))
        _compute_snapshot(self._columns, self._at_s, self._theta_k, self._gamma_k, float(at_s), *seen)
        return seen

    def simulate_traces(self, pulses: FloatArray, pixels: list[int], t_s: FloatArray) -> PixelTrace:
        """Exact values of some pixels at times t_s [m], increasing.

        pulses: [n, 4] start_s, width_s, power_w, pixel in order, after each pixel's last event.
        """
        absorber_k, gas_k = np.zeros((len(t_s), len(pixels))), np.zeros((len(t_s), len(pixels)))
        for column, index in enumerate(pixels):
            own = pulses[pulses[:, 3] == index, :3]
            absorber_k[:, column], gas_k[:, column] = self.simulate_rises_k(index, own, t_s)
        each = [self.pixels.elements[index] for index in pixels]
        return PixelTrace(
            t_s=t_s,
            pixel=np.array(pixels, dtype=np.int64),
            absorber_k=absorber_k,
            gas_k=gas_k,
            displacement_m=gas_k * np.array([item.kappa_m_per_k for item in each]),
            force_n=gas_k * np.array([item.phi_n_per_k for item in each]),
        )


@kernel
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
    """Heat by the pulses [n], fill in their peaks [n]; the number of pulses that did not come too early.

    columns: [p, 6] the fields of `Pixel`; at_s, theta_k, gamma_k: [p] the last event and the rises then.
    """
    last = np.full(len(at_s), -1)
    for row in range(len(pixel)):
        i = pixel[row]
        one = pixel_at(columns, i)
        dark_s = start_s[row] - at_s[i]
        if dark_s < -TIME_ROUNDING_S:
            return row
        dark_s = max(0.0, dark_s)
        if last[i] >= 0:
            glow_k = cooling_peak(one, theta_k[i], gamma_k[i], dark_s)[0]
            peak_m[last[i]] = max(peak_m[last[i]], one.kappa_m_per_k * glow_k)
        absorber_k, gas_k = advance(one, theta_k[i], gamma_k[i], 0.0, dark_s)
        peak_m[row] = one.kappa_m_per_k * gas_peak(one, absorber_k, gas_k, power_w[row], width_s[row])[0]
        theta_k[i], gamma_k[i] = advance(one, absorber_k, gas_k, power_w[row], width_s[row])
        peak_k[row] = max(absorber_k, theta_k[i])
        at_s[i] = start_s[row] + width_s[row]
        last[i] = row
    for i in range(len(at_s)):
        if last[i] >= 0:
            one = pixel_at(columns, i)
            glow_k = cooling_peak(one, theta_k[i], gamma_k[i], np.inf)[0]
            peak_m[last[i]] = max(peak_m[last[i]], one.kappa_m_per_k * glow_k)
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
    """Fill in every pixel [p] at now_s, left dark since its last event."""
    for i in range(len(at_s)):
        one = pixel_at(columns, i)
        absorber_k[i], gas_k = advance(one, theta_k[i], gamma_k[i], 0.0, max(0.0, now_s - at_s[i]))
        displacement_m[i] = one.kappa_m_per_k * gas_k


@kernel
def _solve_pulse_at(
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
    peak_after_s: float,
) -> tuple[int, float]:
    """As pulse_for_peak; no periods where no pulse is needed, fewer where at_s is too early.

    In one kernel, because each call from Python costs as much as what it does.
    """
    one, dark_s = pixel_at(columns, i), start_s - last_s[i]
    if dark_s < -TIME_ROUNDING_S:
        return -1, 0.0
    absorber_k, gas_k = advance(one, theta_k[i], gamma_k[i], 0.0, max(0.0, dark_s))
    goal_k = target_m / one.kappa_m_per_k
    return find_shortest_pulse(
        one, absorber_k, gas_k, goal_k, max_power_w, period_s, min_periods, max_periods, peak_after_s
    )


@kernel
def pixel_at(columns: FloatArray, i: int) -> Pixel:
    """A row of [p, 6], the fields of `Pixel`."""
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
    """Fill in the rises of a pixel at t_s [m], through its pulses [n, 3], from those at its last event, end_s."""
    begin_s, power_w, begin_theta_k, begin_gamma_k = end_s, 0.0, theta_k, gamma_k
    upcoming = 0
    for row in range(len(t_s)):
        while upcoming < len(pulses) and t_s[row] >= pulses[upcoming, 0]:
            dark_s = max(0.0, pulses[upcoming, 0] - end_s)
            begin_theta_k, begin_gamma_k = advance(one, theta_k, gamma_k, 0.0, dark_s)
            begin_s, power_w = pulses[upcoming, 0], pulses[upcoming, 2]
            theta_k, gamma_k = advance(one, begin_theta_k, begin_gamma_k, power_w, pulses[upcoming, 1])
            end_s = begin_s + pulses[upcoming, 1]
            upcoming += 1
        if t_s[row] < end_s:
            lit_s = max(0.0, t_s[row] - begin_s)
            absorber_k[row], gas_k[row] = advance(one, begin_theta_k, begin_gamma_k, power_w, lit_s)
        else:
            absorber_k[row], gas_k[row] = advance(one, theta_k, gamma_k, 0.0, t_s[row] - end_s)
