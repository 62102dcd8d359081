"""A whole display with terms, event by event: what `DisplayHeat` is to the nominal pixel, in compiled steps.

The terms are taken as a recording left them: ageing at the whole of its dose, a drifting room where it is stated.
"""

from collections.abc import Callable, Mapping

import numpy as np

from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.core.types.measurements import PixelTrace
from optodrive.device.neighbours import Neighbours
from optodrive.physics.extended_pulses import carry, glow, heights, shortest, walk
from optodrive.physics.nominal_display import TIME_ROUNDING_S, Heights, Peaks, kernel_columns, nothing
from optodrive.physics.parameters import PixelArray
from optodrive.physics.pixel import Pixel
from optodrive.physics.pixel_ode import Active, Scene, observe
from optodrive.physics.pulse_for_height import DriveRange
from optodrive.physics.snapshot import View, glance
from optodrive.physics.term import AMBIENT_K, CONTEXT, DOSE, FULL_W, MINE, PIXEL, Values
from optodrive.physics.term_kernels import STATES
from optodrive.physics.terms import known_terms

MISALIGNED, CROSSTALK = "beam_misalignment", "neighbour_crosstalk"
PIECE = 128
"""Pulses or pixels between two ticks: a tenth of a second on a slow machine."""


class ExtendedHeat:
    """The heat of every pixel of a display; mutable. Pixels carry their own time, all on one time line.

    values: term → parameter → SI value; only terms with kernels have an effect here.
    """

    def __init__(
        self,
        pixels: PixelArray,
        values: Mapping[str, Values],
        ambient_k: float,
        full_w: float,
        neighbours: Neighbours,
        at_s: float = 0.0,
    ) -> None:
        self.pixels = pixels
        self._values, self._active = values, Active.of(values)
        self._beside = neighbours.beside if CROSSTALK in values else np.zeros((len(pixels), 0), dtype=np.int64)
        self._beside = np.ascontiguousarray(self._beside)
        self._columns = np.stack([getattr(pixels, name) for name in Pixel._fields], axis=1)
        self._context = np.zeros(CONTEXT)
        self._context[FULL_W], self._context[AMBIENT_K], self._context[DOSE] = full_w, ambient_k, 1.0
        self._at_s = np.full(len(pixels), at_s)
        self._dark_s = np.full(len(pixels), 1.0)
        self._states = np.zeros((len(pixels), STATES))
        self._view: View | None = None

    def copy(self) -> "ExtendedHeat":
        """An independent copy."""
        return self.shifted(0.0)

    def shifted(self, offset_s: float) -> "ExtendedHeat":
        """A copy on a time line whose zero lies offset_s earlier."""
        twin = ExtendedHeat.__new__(ExtendedHeat)
        vars(twin).update(vars(self))
        twin._at_s = self._at_s + offset_s
        twin._dark_s, twin._states = self._dark_s.copy(), self._states.copy()
        twin._view = None
        return twin

    def pulses(
        self,
        pixel: IntArray,
        start_s: FloatArray,
        width_s: FloatArray,
        power_w: FloatArray,
        tick: Callable[[], None] = nothing,
    ) -> Peaks:
        """Light pixels one after the other; all [n], pulses in order of time, power the mean incident one.

        tick is called again and again meanwhile. ValueError for a pulse that starts before its pixel's last event, or
        that of one beside it where they exchange heat; those before it have been.
        """
        columns = kernel_columns(len(self.pixels), pixel, start_s, width_s, power_w)
        peaks = Peaks(np.zeros(len(pixel)), np.zeros(len(pixel)))
        display = (self._columns, self._at_s, self._dark_s, self._states, self._beside)
        last = np.full(len(self.pixels), -1)
        for begin in range(0, len(pixel), PIECE):
            end = min(begin + PIECE, len(pixel))
            done = walk(*display, self._active, self._context, *columns, *peaks, last, begin, end)
            if done < end:
                raise self._too_early(int(pixel[done]), float(start_s[done]))
            tick()
        for begin in range(0, len(self.pixels), PIECE):
            end = min(begin + PIECE, len(self.pixels))
            glow(self._columns, self._states, self._active, self._context, last, begin, end, peaks.displacement_m)
            tick()
        return peaks

    def pulse_for_peak(
        self, pixel: int, at_s: float, target_m: float, drive: DriveRange, least_periods: int = 1, from_s: float = 0.0
    ) -> tuple[int, float] | None:
        """PWM periods and duty of the shortest pulse at at_s whose peak is target_m; None where none is needed.

        It has least_periods at least, as far as the drive allows; a target beyond the longest pulse gets that one.
        from_s: the peak counts only from so long after the pulse's start on, beyond its end.
        ValueError for a time before the pixel's last event.
        """
        if at_s < self._at_s[pixel] - TIME_ROUNDING_S:
            raise self._too_early(pixel, at_s)
        context, one = self._context.copy(), self.pixels.each[pixel]
        context[PIXEL], context[MINE] = pixel, 1.0
        room, lit = np.zeros((8, STATES)), np.zeros((drive.max_periods + 1, STATES))
        room[0] = self._states[pixel]
        dark_s, wait_s = float(self._dark_s[pixel]), max(0.0, float(at_s - self._at_s[pixel]))
        carry(one, self._active, context, True, room, 0.0, dark_s, wait_s)
        span = (drive.max_power_w, drive.period_s, min(least_periods, drive.max_periods), drive.max_periods)
        periods, duty = shortest(one, self._active, context, room, lit, dark_s + wait_s, target_m, *span, from_s)
        return (periods, duty) if periods else None

    def reaches_m(self, drive: DriveRange) -> FloatArray:
        """The largest displacement that one pulse can reach from rest, [p]."""
        alone = -1.0 if MISALIGNED not in self._values else self._values[MISALIGNED]["pixel"]
        kinds = [(pixel, index == alone) for index, pixel in enumerate(self.pixels.each)]
        width_s = drive.max_periods * drive.period_s
        reach: dict[tuple[Pixel, bool], float] = {}
        for index, kind in enumerate(kinds):
            if kind not in reach:
                fresh = self.shifted(0.0)
                fresh._states[:], fresh._at_s[:] = 0.0, 0.0
                one = (np.array([index]), np.zeros(1), np.array([width_s]), np.array([drive.max_power_w]))
                reach[kind] = float(fresh.pulses(*one).displacement_m[0])
        return np.array([reach[kind] for kind in kinds])

    def heights_m(self, pulses: FloatArray, pixel: int, t_s: FloatArray) -> FloatArray:
        """Displacement of a pixel at times t_s [m], increasing, from the heat there is, which stays as it is.

        pulses: [n, 4] start_s, width_s, power_w, pixel in order; ValueError for one, or a time, before the last event.
        """
        felt = np.array(pulses[np.isin(pulses[:, 3], [pixel, *self._beside[pixel].tolist()])])
        first_s = min(float(t_s[0]), float(felt[0, 0]) if len(felt) else np.inf)
        if first_s < self._at_s[pixel] - TIME_ROUNDING_S:
            raise self._too_early(pixel, first_s)
        last = (float(self._at_s[pixel]), float(self._dark_s[pixel]), self._states[pixel].copy())
        height_m = np.zeros(len(t_s))
        one = self.pixels.each[pixel]
        heights(one, self._active, self._context.copy(), pixel, *last, felt, np.array(t_s), height_m)
        return height_m

    def at(self, at_s: float) -> Heights:
        """Every pixel at one time, in the dark since its last event; a time before that event counts as the event's.

        Asked again and again for later times it goes on from the last answer: a display is stepped through but once.
        """
        if self._view is None:
            self._view = View.of(self._states)
        seen = Heights(np.zeros(len(self.pixels)), np.zeros(len(self.pixels)))
        display = (self._columns, self._at_s, self._dark_s, self._states)
        glance(*display, self._active, self._context, self._view, float(at_s), *seen)
        return seen

    def traces(self, pulses: FloatArray, pixels: list[int], t_s: FloatArray) -> PixelTrace:
        """What instruments show of some pixels from rest at times t_s [m], increasing.

        pulses: [n, 4] start_s, width_s, power_w, pixel in order; ValueError where the display is not at rest.
        """
        if self._states.any():
            raise ValueError("a display with terms is traced from rest only")
        # What lifts the membrane does not act back on the gas: without it the membrane shows the gas's own rise.
        bare = {key: own for key, own in self._values.items() if known_terms()[key].kernels.lifts is None}
        ambient_k, full_w = float(self._context[AMBIENT_K]), float(self._context[FULL_W])
        columns = []
        for index in pixels:
            own = pulses[np.isin(pulses[:, 3], [index, *self._beside[index].tolist()])]
            scene = Scene(own, index, ambient_k, (t_s, t_s, t_s), dose_before=1.0, full_w=full_w)
            one = self.pixels.each[index]
            absorber_k, displacement_m, force_n = observe(scene, one, self._active)
            # Of a dead membrane nothing could be read.
            gas_k = observe(scene, one._replace(kappa_m_per_k=1.0), Active.of(bare))[1]
            columns.append((absorber_k, gas_k, displacement_m, force_n))
        signals = (np.stack(signal, axis=1) for signal in zip(*columns, strict=True))
        return PixelTrace(t_s, np.array(pixels, dtype=np.int64), *signals)

    def _too_early(self, pixel: int, at_s: float) -> ValueError:
        return ValueError(f"pixel {pixel} was advanced to {self._at_s[pixel]} s, {at_s} s lies before it")
