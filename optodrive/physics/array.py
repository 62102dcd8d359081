"""A whole display, event by event: each pixel is advanced only when something is asked of it."""

from collections.abc import Iterable

import numpy as np

from optodrive.flow import FloatArray, IntArray, PixelTrace
from optodrive.physics.parameters import PixelArray
from optodrive.physics.pixel import advance, cooling_peak, gas_peak

TIME_ROUNDING_S = 1e-9


class DisplayHeat:
    """The heat of every pixel of a display; mutable. Pixels carry their own time, all on one time line."""

    def __init__(self, pixels: PixelArray, at_s: float = 0.0) -> None:
        self.pixels = pixels
        self._at_s = [at_s] * len(pixels)
        self._theta_k = [0.0] * len(pixels)
        self._gamma_k = [0.0] * len(pixels)

    def copy(self) -> "DisplayHeat":
        """An independent copy."""
        return self.shifted(0.0)

    def shifted(self, offset_s: float) -> "DisplayHeat":
        """A copy on a time line whose zero lies offset_s earlier."""
        twin = DisplayHeat.__new__(DisplayHeat)
        twin.pixels = self.pixels
        twin._at_s = [at_s + offset_s for at_s in self._at_s]
        twin._theta_k = self._theta_k.copy()
        twin._gamma_k = self._gamma_k.copy()
        return twin

    def rises(self, pixel: int, at_s: float) -> tuple[float, float]:
        """Absorber and gas rise, K, of a pixel left dark until at_s; ValueError for a time before its last event."""
        dark_s = at_s - self._at_s[pixel]
        if dark_s < -TIME_ROUNDING_S:
            raise ValueError(f"pixel {pixel} was advanced to {self._at_s[pixel]} s, {at_s} s lies before it")
        theta_k, gamma_k = self._theta_k[pixel], self._gamma_k[pixel]
        if theta_k == 0.0 and gamma_k == 0.0:
            return 0.0, 0.0
        return advance(self.pixels.each[pixel], theta_k, gamma_k, 0.0, max(0.0, dark_s))

    def pulse(self, pixel: int, start_s: float, width_s: float, power_w: float) -> None:
        """Light a pixel from start_s for width_s at the mean incident power power_w."""
        theta_k, gamma_k = self.rises(pixel, start_s)
        self._theta_k[pixel], self._gamma_k[pixel] = advance(
            self.pixels.each[pixel], theta_k, gamma_k, power_w, width_s
        )
        self._at_s[pixel] = start_s + width_s

    def peak_m(self, pixel: int, within_s: float = float("inf")) -> float:
        """Largest displacement, m, of a pixel from its last event on, within_s seconds at most."""
        parameters = self.pixels.each[pixel]
        peak_k, _ = cooling_peak(parameters, self._theta_k[pixel], self._gamma_k[pixel], within_s)
        return parameters.kappa_m_per_k * peak_k


def pulse_peaks(
    heat: DisplayHeat, pixel: IntArray, start_s: FloatArray, width_s: FloatArray, power_w: FloatArray
) -> FloatArray:
    """[n] largest displacement, m, from each pulse's start to the next on its pixel, or for ever; heat is advanced.

    All arrays [n], pulses of a pixel in order of time.
    """
    peaks_m = np.zeros(len(pixel))
    last: dict[int, tuple[int, float]] = {}
    rows = zip(pixel.tolist(), start_s.tolist(), width_s.tolist(), power_w.tolist(), strict=True)
    for row, (index, begin_s, lit_s, power) in enumerate(rows):
        if index in last:
            _settle(heat, peaks_m, index, *last[index], begin_s)
        parameters = heat.pixels.each[index]
        peaks_m[row] = parameters.kappa_m_per_k * gas_peak(parameters, *heat.rises(index, begin_s), power, lit_s)[0]
        heat.pulse(index, begin_s, lit_s, power)
        last[index] = row, begin_s + lit_s
    for index, (row, end_s) in last.items():
        _settle(heat, peaks_m, index, row, end_s, float("inf"))
    return peaks_m


def _settle(heat: DisplayHeat, peaks_m: FloatArray, pixel: int, row: int, end_s: float, until_s: float) -> None:
    peaks_m[row] = max(peaks_m[row], heat.peak_m(pixel, until_s - end_s))


def pixel_trace(
    heat: DisplayHeat, pulses: Iterable[tuple[int, float, float, float]], pixels: list[int], t_s: FloatArray
) -> PixelTrace:
    """Exact values of some pixels at times t_s [m], increasing; pulses: (pixel, start_s, width_s, power_w) in order."""
    absorber_k, gas_k = np.zeros((len(t_s), len(pixels))), np.zeros((len(t_s), len(pixels)))
    own: dict[int, list[tuple[float, float, float]]] = {index: [] for index in pixels}
    for index, start_s, width_s, power_w in pulses:
        if index in own:
            own[index].append((start_s, width_s, power_w))
    for column, index in enumerate(pixels):
        state = heat.copy()
        parameters = heat.pixels.each[index]
        events = iter([*own[index], (float("inf"), 0.0, 0.0)])
        upcoming = next(events)
        lit_from_s, lit_s, power_w = 0.0, 0.0, 0.0
        begin = (0.0, 0.0)
        for row, at_s in enumerate(t_s.tolist()):
            while at_s >= upcoming[0]:
                lit_from_s, lit_s, power_w = upcoming
                begin = state.rises(index, lit_from_s)
                state.pulse(index, lit_from_s, lit_s, power_w)
                upcoming = next(events)
            if at_s < lit_from_s + lit_s:
                absorber_k[row, column], gas_k[row, column] = advance(parameters, *begin, power_w, at_s - lit_from_s)
            else:
                absorber_k[row, column], gas_k[row, column] = state.rises(index, at_s)
    each = [heat.pixels.each[index] for index in pixels]
    return PixelTrace(
        t_s=t_s,
        pixel=np.array(pixels, dtype=np.int64),
        absorber_k=absorber_k,
        gas_k=gas_k,
        displacement_m=gas_k * np.array([item.kappa_m_per_k for item in each]),
        force_n=gas_k * np.array([item.phi_n_per_k for item in each]),
    )
