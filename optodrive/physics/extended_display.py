"""A whole display with terms, event by event: what `DisplayHeat` is to the nominal pixel, in compiled steps.

The terms are taken as a recording left them: ageing at the whole of its dose, a drifting room where it is stated.
"""

from collections.abc import Callable, Mapping

import numpy as np

from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.core.types.measurements import PixelTrace
from optodrive.device.neighbours import Neighbours
from optodrive.physics.extended_pulses import (
    add_peaks_after_off,
    advance_states,
    apply_pulses,
    find_shortest_pulse,
    simulate_displacement,
)
from optodrive.physics.nominal_display import (
    TIME_ROUNDING_S,
    DisplayState,
    PulsePeaks,
    build_kernel_columns,
    ignore_progress,
)
from optodrive.physics.parameters import PixelArray
from optodrive.physics.pixel import Pixel
from optodrive.physics.pixel_ode import ActiveTerms, PixelExperiment, simulate_signals
from optodrive.physics.pulse_for_height import DriveRange
from optodrive.physics.snapshot import SnapshotCache, compute_snapshot
from optodrive.physics.term import AMBIENT_K, CONTEXT_SIZE, DOSE, FULL_W, ILLUMINATED_PIXEL, IS_TARGET, TermValues
from optodrive.physics.term_kernels import STATE_COUNT
from optodrive.physics.terms import discover_terms

BATCH = 128
"""Pulses or pixels between two ticks: a tenth of a second on a slow machine."""


class ExtendedThermalState:
    """The heat of every pixel of a display; mutable. Pixels carry their own time, all on one time line.

    values: term → parameter → SI value; only terms with kernels have an effect here.
    """

    def __init__(
        self,
        pixels: PixelArray,
        values: Mapping[str, TermValues],
        ambient_k: float,
        full_w: float,
        neighbours: Neighbours,
        at_s: float = 0.0,
    ) -> None:
        self.pixels = pixels
        self._values, self._active = values, ActiveTerms.from_values(values)
        is_coupled = any(discover_terms()[key].couples_neighbours for key in values)
        indices = neighbours.indices if is_coupled else np.zeros((len(pixels), 0), dtype=np.int64)
        self._neighbours = np.ascontiguousarray(indices)
        self._columns = np.stack([getattr(pixels, name) for name in Pixel._fields], axis=1)
        self._context = np.zeros(CONTEXT_SIZE)
        self._context[FULL_W], self._context[AMBIENT_K], self._context[DOSE] = full_w, ambient_k, 1.0
        self._at_s = np.full(len(pixels), at_s)
        self._off_s = np.full(len(pixels), 1.0)
        self._states = np.zeros((len(pixels), STATE_COUNT))
        self._snapshot_cache: SnapshotCache | None = None

    def copy(self) -> "ExtendedThermalState":
        """An independent copy."""
        return self.copy_shifted(0.0)

    def copy_shifted(self, offset_s: float) -> "ExtendedThermalState":
        """A copy on a time line whose zero lies offset_s earlier."""
        twin = ExtendedThermalState.__new__(ExtendedThermalState)
        vars(twin).update(vars(self))
        twin._at_s = self._at_s + offset_s
        twin._off_s, twin._states = self._off_s.copy(), self._states.copy()
        twin._snapshot_cache = None
        return twin

    def apply_pulses(
        self,
        pixel: IntArray,
        start_s: FloatArray,
        width_s: FloatArray,
        power_w: FloatArray,
        on_progress: Callable[[], None] = ignore_progress,
    ) -> PulsePeaks:
        """Light pixels one after the other; all [n], pulses in order of time, power the mean incident one.

        tick is called again and again meanwhile. ValueError for a pulse that starts before its pixel's last event, or
        that of one beside it where they exchange heat; those before it have been.
        """
        columns = build_kernel_columns(len(self.pixels), pixel, start_s, width_s, power_w)
        peaks = PulsePeaks(np.zeros(len(pixel)), np.zeros(len(pixel)))
        display = (self._columns, self._at_s, self._off_s, self._states, self._neighbours)
        last = np.full(len(self.pixels), -1)
        for begin in range(0, len(pixel), BATCH):
            end = min(begin + BATCH, len(pixel))
            done = apply_pulses(*display, self._active, self._context, *columns, *peaks, last, begin, end)
            if done < end:
                raise self._time_order_error(int(pixel[done]), float(start_s[done]))
            on_progress()
        for begin in range(0, len(self.pixels), BATCH):
            end = min(begin + BATCH, len(self.pixels))
            add_peaks_after_off(
                self._columns, self._states, self._active, self._context, last, begin, end, peaks.displacement_m
            )
            on_progress()
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
        if start_s < self._at_s[pixel] - TIME_ROUNDING_S:
            raise self._time_order_error(pixel, start_s)
        context, one = self._context.copy(), self.pixels.elements[pixel]
        context[ILLUMINATED_PIXEL], context[IS_TARGET] = pixel, 1.0
        room, lit = np.zeros((8, STATE_COUNT)), np.zeros((drive.max_periods + 1, STATE_COUNT))
        room[0] = self._states[pixel]
        dark_s, wait_s = float(self._off_s[pixel]), max(0.0, float(start_s - self._at_s[pixel]))
        advance_states(one, self._active, context, True, room, 0.0, dark_s, wait_s)
        span = (drive.max_power_w, drive.period_s, min(min_periods, drive.max_periods), drive.max_periods)
        periods, duty = find_shortest_pulse(
            one, self._active, context, room, lit, dark_s + wait_s, target_m, *span, peak_after_s
        )
        return (periods, duty) if periods else None

    def max_displacement_m(self, drive: DriveRange) -> FloatArray:
        """The largest displacement that one pulse can reach from rest, [p]."""
        affected = {discover_terms()[key].affected_pixel(values) for key, values in self._values.items()}
        kinds = [(pixel, index if index in affected else None) for index, pixel in enumerate(self.pixels.elements)]
        width_s = drive.max_periods * drive.period_s
        reach: dict[tuple[Pixel, int | None], float] = {}
        for index, kind in enumerate(kinds):
            if kind not in reach:
                fresh = self.copy_shifted(0.0)
                fresh._states[:], fresh._at_s[:] = 0.0, 0.0
                one = (np.array([index]), np.zeros(1), np.array([width_s]), np.array([drive.max_power_w]))
                reach[kind] = float(fresh.apply_pulses(*one).displacement_m[0])
        return np.array([reach[kind] for kind in kinds])

    def simulate_displacement_m(self, pulses: FloatArray, pixel: int, t_s: FloatArray) -> FloatArray:
        """Displacement of a pixel at times t_s [m], increasing, from the heat there is, which stays as it is.

        pulses: [n, 4] start_s, width_s, power_w, pixel in order; ValueError for one, or a time, before the last event.
        """
        felt = np.array(pulses[np.isin(pulses[:, 3], [pixel, *self._neighbours[pixel].tolist()])])
        first_s = min(float(t_s[0]), float(felt[0, 0]) if len(felt) else np.inf)
        if first_s < self._at_s[pixel] - TIME_ROUNDING_S:
            raise self._time_order_error(pixel, first_s)
        last = (float(self._at_s[pixel]), float(self._off_s[pixel]), self._states[pixel].copy())
        height_m = np.zeros(len(t_s))
        one = self.pixels.elements[pixel]
        simulate_displacement(one, self._active, self._context.copy(), pixel, *last, felt, np.array(t_s), height_m)
        return height_m

    def state_at(self, at_s: float) -> DisplayState:
        """Every pixel at one time, in the dark since its last event; a time before that event counts as the event's.

        Asked again and again for later times it goes on from the last answer: a display is stepped through but once.
        """
        if self._snapshot_cache is None:
            self._snapshot_cache = SnapshotCache.from_states(self._states)
        seen = DisplayState(np.zeros(len(self.pixels)), np.zeros(len(self.pixels)))
        display = (self._columns, self._at_s, self._off_s, self._states)
        compute_snapshot(*display, self._active, self._context, self._snapshot_cache, float(at_s), *seen)
        return seen

    def simulate_traces(self, pulses: FloatArray, pixels: list[int], t_s: FloatArray) -> PixelTrace:
        """What instruments show of some pixels from rest at times t_s [m], increasing.

        pulses: [n, 4] start_s, width_s, power_w, pixel in order; ValueError where the display is not at rest.
        """
        if self._states.any():
            raise ValueError("a display with terms is traced from rest only")
        # What lifts the membrane does not act back on the gas: without it the membrane shows the gas's own rise.
        bare = {key: own for key, own in self._values.items() if not discover_terms()[key].moves_membrane}
        ambient_k, full_w = float(self._context[AMBIENT_K]), float(self._context[FULL_W])
        columns = []
        for index in pixels:
            own = pulses[np.isin(pulses[:, 3], [index, *self._neighbours[index].tolist()])]
            scene = PixelExperiment(own, index, ambient_k, (t_s, t_s, t_s), dose_before=1.0, full_w=full_w)
            one = self.pixels.elements[index]
            absorber_k, displacement_m, force_n = simulate_signals(scene, one, self._active)
            # Of a dead membrane nothing could be read.
            gas_k = simulate_signals(scene, one._replace(kappa_m_per_k=1.0), ActiveTerms.from_values(bare))[1]
            columns.append((absorber_k, gas_k, displacement_m, force_n))
        signals = (np.stack(signal, axis=1) for signal in zip(*columns, strict=True))
        return PixelTrace(t_s, np.array(pixels, dtype=np.int64), *signals)

    def _time_order_error(self, pixel: int, at_s: float) -> ValueError:
        return ValueError(f"pixel {pixel} was advanced to {self._at_s[pixel]} s, {at_s} s lies before it")
