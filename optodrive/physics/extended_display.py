"""Thermal state of a display whose pixels have terms: `NominalThermalState` with a compiled integrator.

Terms act as a recording leaves them: ageing at its full dose, a drifting room at its stated temperature. A snapshot is
the state at successive times, continued from the previous one.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.kernels import array_kernel
from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.core.types.measurements import PixelTrace
from optodrive.device.panel import Neighbours
from optodrive.physics.discovered_term import KEY as DISCOVERED
from optodrive.physics.discovered_term import build_unreached, check_reached
from optodrive.physics.extended_pulse_for_height import find_shortest_pulse
from optodrive.physics.extended_pulses import (
    DISPLACEMENT_SIGNAL,
    EventStates,
    add_peaks_after_off,
    advance_shared,
    advance_states,
    advance_to,
    apply_pulses,
    copy_rows,
    copy_states,
    set_light,
    simulate_displacement,
)
from optodrive.physics.nominal_display import (
    TIME_ROUNDING_S,
    DisplayState,
    PulsePeaks,
    build_kernel_columns,
    ignore_progress,
    pixel_at,
)
from optodrive.physics.parameters import PixelArray
from optodrive.physics.pixel import Pixel
from optodrive.physics.pixel_ode import ActiveTerms, PixelExperiment, output_signal, simulate_signals
from optodrive.physics.pulse_for_height import DriveRange
from optodrive.physics.stability import check_time_constants
from optodrive.physics.term import (
    ABSORBER,
    AMBIENT_K,
    CONTEXT_SIZE,
    DOSE,
    ELSEWHERE,
    FULL_W,
    PANEL_HELD,
    POWER_W,
    SESSION_TIME,
    BySignal,
    TermValues,
)
from optodrive.physics.term_kernels import STATE_COUNT
from optodrive.physics.terms import all_terms


class SnapshotCache(NamedTuple):
    """States [p + 1, STATE_COUNT] of pixels and of laser and panel at at_s, computed from their events at event_s."""

    at_s: FloatArray
    event_s: FloatArray
    states: FloatArray

    @classmethod
    def from_events(cls, events: EventStates) -> "SnapshotCache":
        """Return an empty cache for the pixels of some events."""
        count = len(events.states)
        return cls(np.full(count, np.nan), np.full(count, np.nan), np.zeros((count, events.states.shape[1])))


@array_kernel
def compute_snapshot(
    events: EventStates,
    active: ActiveTerms,
    context: FloatArray,
    cache: SnapshotCache,
    now_s: float,
    displacement_m: FloatArray,
    absorber_k: FloatArray,
) -> None:
    """Fill in displacement and absorber rise of every pixel [p] at now_s, with the gate off since its last event.

    The cache is updated.
    """
    work, c, at_s = np.zeros((8, events.states.shape[1])), context.copy(), events.at_s
    c[POWER_W] = 0.0
    last = len(events.columns)
    for i in range(last, -1, -1):  # laser and panel come first: every pixel needs the panel
        # After a new event, or for an earlier time, the cached states are no start: begin at the event.
        if cache.event_s[i] != at_s[i] or now_s < cache.at_s[i]:
            cache.event_s[i] = cache.at_s[i] = at_s[i]
            copy_states(events.states[i], cache.states[i])
        one, wait_s = pixel_at(events.columns, i if i < last else 0), max(0.0, now_s - cache.at_s[i])
        set_light(c, i, events.illuminated[0])
        copy_states(cache.states[i], work[0])
        if i < last:
            copy_rows(active.panel_rows, cache.states[last], work[0])
        # Pixels take the panel as it is at the end: it changes over minutes, a pixel within a tenth of a second.
        c[PANEL_HELD] = 1.0 if i < last else 0.0
        advance_states(one, active, c, work, 0.0, events.off_s[i] + cache.at_s[i] - at_s[i], wait_s)
        copy_states(work[0], cache.states[i])
        cache.at_s[i] += wait_s
        if i < last:
            displacement_m[i] = output_signal(one, active, work[0], c, DISPLACEMENT_SIGNAL)
            absorber_k[i] = work[0, ABSORBER]


BATCH = 128
"""Pulses or pixels between two calls of on_progress: a tenth of a second on a slow machine."""


class ExtendedThermalState:
    """Mutable thermal state of every pixel, see `ThermalState`.

    values: term → parameter → SI value; terms without kernels have no effect. full_w: full power of the laser. Raises
    DivergedError, which names the term, if one is too fast for the integrator.
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
        check_time_constants(values)
        is_coupled = any(all_terms()[key].couples_neighbours for key in values)
        indices = neighbours.indices if is_coupled else np.zeros((len(pixels), 0), dtype=np.int64)
        self._neighbours = np.ascontiguousarray(indices)
        self._context = np.zeros(CONTEXT_SIZE)
        self._context[FULL_W], self._context[AMBIENT_K] = full_w, ambient_k
        self._context[DOSE] = self._context[SESSION_TIME] = 1.0  # as at the end of the recording
        columns = np.stack([getattr(pixels, name) for name in Pixel._fields], axis=1)
        self._events = EventStates.cold(columns, at_s)
        self._reached = build_unreached(len(pixels) if DISCOVERED in values else 0)
        self._snapshot_cache: SnapshotCache | None = None

    def copy(self) -> "ExtendedThermalState":
        """Return an independent copy."""
        return self.copy_shifted(0.0)

    def copy_shifted(self, offset_s: float) -> "ExtendedThermalState":
        """Return a copy whose times are offset_s later, on a time line whose zero is offset_s earlier."""
        twin = ExtendedThermalState.__new__(ExtendedThermalState)
        vars(twin).update(vars(self))
        twin._events = self._events.copy_shifted(offset_s)
        twin._reached = build_unreached(len(self._reached))
        # A cache is of the events that it was computed from.
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
        """Apply pulses in order of time, all [n], power_w the mean incident power. Return their peaks.

        on_progress is called once per batch. Raises ValueError for a pulse that starts before the last event of its
        pixel or of a thermally coupled neighbour; the pulses before it remain applied.
        """
        columns = build_kernel_columns(len(self.pixels), pixel, start_s, width_s, power_w)
        peaks = PulsePeaks(np.zeros(len(pixel)), np.zeros(len(pixel)))
        display = (self._events, self._neighbours, self._active, self._context)
        last = np.full(len(self.pixels), -1)
        for begin in range(0, len(pixel), BATCH):
            end = min(begin + BATCH, len(pixel))
            done = apply_pulses(*display, *columns, *peaks, last, self._reached, begin, end)
            if done < end:
                raise self._time_order_error(int(pixel[done]), float(start_s[done]))
            on_progress()
        for begin in range(0, len(self.pixels), BATCH):
            end = min(begin + BATCH, len(self.pixels))
            after = (last, self._reached, begin, end, peaks.displacement_m)
            add_peaks_after_off(self._events, self._active, self._context, *after)
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
    ) -> tuple[float, float] | None:
        """See `ThermalState.solve_pulse`."""
        context, work, off_s = self._advance_copy(pixel, start_s)
        on_states = np.zeros((drive.max_periods + 1, STATE_COUNT))
        span = (
            drive.max_power_w,
            drive.period_s,
            min(min_periods, drive.max_periods),
            drive.max_periods,
            drive.is_fine,
            drive.min_duty,
        )
        one = self.pixels.elements[pixel]
        periods, duty = find_shortest_pulse(
            one, self._active, context, pixel, work, on_states, off_s, target_m, *span, peak_after_s
        )
        return (periods, duty) if periods else None

    def check_tested(self) -> None:
        """See `ThermalState.check_tested`."""
        if len(self._reached):
            check_reached(self._values[DISCOVERED], self._reached)

    def max_displacement_m(self, drive: DriveRange) -> FloatArray:
        """Return the largest displacement that one pulse can reach on each cold pixel, m, [p].

        No pulse that leaves the range of the data of a discovered function counts.
        """
        affected = {all_terms()[key].affected_pixel(values) for key, values in self._values.items()}
        # Equal pixels are computed once: of 1,511 only those that a term singles out differ.
        kinds = [(pixel, index if index in affected else None) for index, pixel in enumerate(self.pixels.elements)]
        by_kind: dict[tuple[Pixel, int | None], float] = {}
        for index, kind in enumerate(kinds):
            if kind not in by_kind:
                by_kind[kind] = self._compute_max_m(index, drive)
        return np.array([by_kind[kind] for kind in kinds])

    def _compute_max_m(self, pixel: int, drive: DriveRange) -> float:
        """Return the displacement, m, of the longest pulse on a cold pixel that stays within the range of the data.

        If none does, as at too large a power, that of the longest of all, whose plan is refused by what is wrong.
        """
        reached_m, short, long = 0.0, 0, drive.max_periods + 1  # known to stay within, and not to
        longest_m, periods = 0.0, drive.max_periods
        while long - short > 1:
            cold = self.copy_shifted(0.0)
            cold._events = EventStates.cold(self._events.columns, 0.0)
            one = (np.array([pixel]), np.zeros(1), np.array([periods * drive.period_s]), np.array([drive.max_power_w]))
            peak_m = float(cold.apply_pulses(*one).displacement_m[0])
            longest_m = max(longest_m, peak_m)
            try:
                cold.check_tested()
                reached_m, short = peak_m, periods
            except InputError:
                long = periods
            periods = (short + long) // 2
        return reached_m or longest_m

    def simulate_displacement_m(self, pulses: FloatArray, pixel: int, t_s: FloatArray) -> FloatArray:
        """See `ThermalState.simulate_displacement_m`."""
        acting = self._select_acting(pulses, pixel)
        first_s = min(float(t_s[0]), float(acting[0, 0]) if len(acting) else np.inf)
        context, work, off_s = self._advance_copy(pixel, first_s)
        displacement_m = np.zeros(len(t_s))
        one = self.pixels.elements[pixel]
        simulate_displacement(
            one, self._active, context, pixel, first_s, off_s, work[0], acting, np.array(t_s), displacement_m
        )
        return displacement_m

    def state_at(self, at_s: float) -> DisplayState:
        """Return every pixel at one time, with the gate off since its last event, or at that event if it is later.

        Calls at successive times continue from the previous result, so each interval is integrated only once.
        """
        if self._snapshot_cache is None:
            self._snapshot_cache = SnapshotCache.from_events(self._events)
        state = DisplayState(np.zeros(len(self.pixels)), np.zeros(len(self.pixels)))
        compute_snapshot(self._events, self._active, self._context, self._snapshot_cache, float(at_s), *state)
        return state

    def simulate_traces(self, pulses: FloatArray, pixels: list[int], t_s: FloatArray) -> PixelTrace:
        """See `ThermalState.simulate_traces`. Raises ValueError if the display is not cold."""
        # An experiment begins cold, and a state has no place in it.
        if self._events.states.any():
            raise ValueError("a display with terms is traced from the cold state only")
        # Membrane terms do not act back on the gas: without them, the displacement is proportional to the gas's rise.
        gas_terms = {key: values for key, values in self._values.items() if not all_terms()[key].moves_membrane}
        ambient_k, full_w = float(self._context[AMBIENT_K]), float(self._context[FULL_W])
        delays = [all_terms()[key].signal_delays(values) for key, values in self._values.items()]
        names = BySignal._fields[:3]
        late_s = tuple(sum(getattr(item, name) for item in delays) for name in names)
        rates = [all_terms()[key].signal_rates(values) for key, values in self._values.items()]
        true_s = [t_s / (1.0 + sum(getattr(item, name) for item in rates)) for name in names]
        columns = []
        for index in pixels:
            acting = self._select_acting(pulses, index)
            experiment = PixelExperiment(
                acting,
                index,
                ambient_k,
                (true_s[0], true_s[1], true_s[2]),
                dose_before=1.0,
                session_time=1.0,
                full_w=full_w,
            )
            one = self.pixels.elements[index]
            recorded = list(simulate_signals(experiment, one, self._active, late_s))
            for key, values in self._values.items():
                record = all_terms()[key].record
                pairs, run = zip(names, recorded, strict=True), experiment.recorded_run
                recorded = [record(values, name, t_s, each, run) for name, each in pairs]
            # κ = 1, because a dead pixel's κ is 0.
            gas_k = simulate_signals(experiment, one._replace(kappa_m_per_k=1.0), ActiveTerms.from_values(gas_terms))[1]
            columns.append((recorded[0], gas_k, *recorded[1:]))
        signals = (np.stack(signal, axis=1) for signal in zip(*columns, strict=True))
        return PixelTrace(t_s, np.array(pixels, dtype=np.int64), *signals)

    def _advance_copy(self, pixel: int, at_s: float) -> tuple[FloatArray, FloatArray, float]:
        """Return a context, work space whose first row has a pixel's states at at_s, and the time since gate off then.

        With states of laser or panel, that is the time since the last pulse on any pixel.

        Raises ValueError for a time before the pixel's last event.
        """
        if at_s < self._events.at_s[pixel] - TIME_ROUNDING_S:
            raise self._time_order_error(pixel, at_s)
        # Copies: the display's own states stay at their events.
        context, work, shared = self._context.copy(), np.zeros((8, STATE_COUNT)), np.zeros((8, STATE_COUNT))
        illuminated = int(self._events.illuminated[0])
        set_light(
            context, pixel, illuminated if illuminated in (pixel, *self._neighbours[pixel].tolist()) else ELSEWHERE
        )
        advance_shared(self._events, self._active, context, shared, at_s)
        advance_to(self._events, self._active, context, shared, work, pixel, at_s)
        copy_rows(self._active.laser_rows, shared[0], work[0])
        last = len(self.pixels) if self._active.has_shared_states else pixel
        return context, work, float(self._events.off_s[last] + max(0.0, at_s - self._events.at_s[last]))

    def _select_acting(self, pulses: FloatArray, pixel: int) -> FloatArray:
        """Return the pulses [n, 4] that heat a pixel or a neighbour, and those ELSEWHERE if they act on all pixels."""
        is_near = np.isin(pulses[:, 3], [pixel, *self._neighbours[pixel].tolist()])
        if not self._active.has_shared_states:
            return np.array(pulses[is_near])
        return np.column_stack([pulses[:, :3], np.where(is_near, pulses[:, 3], ELSEWHERE)])

    def _time_order_error(self, pixel: int, at_s: float) -> ValueError:
        return ValueError(f"pixel {pixel} was advanced to {self._events.at_s[pixel]} s, {at_s} s lies before it")
