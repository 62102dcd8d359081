"""Pulses on pixels with terms: the states after them, and their peaks.

Kernels over `pixel_ode.step`; `ExtendedThermalState` is their interface.
"""

from typing import NamedTuple

import numpy as np

from optodrive.core.kernels import array_kernel, kernel
from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.physics.discovered_term import KEY as DISCOVERED
from optodrive.physics.discovered_term import note_reached
from optodrive.physics.nominal_display import TIME_ROUNDING_S, pixel_at
from optodrive.physics.pixel import Pixel
from optodrive.physics.pixel_ode import ActiveTerms, interpolate_states, next_step_s, output_signal, step
from optodrive.physics.term import ABSORBER, ILLUMINATED_PIXEL, IS_TARGET, PANEL_HELD, POWER_W
from optodrive.physics.term_kernels import FOLLOWER_ROW, STATE_COUNT, TERM_ROW

DISPLACEMENT_SIGNAL = 1
"""Number of the signal in `pixel_ode.output_signal`."""
DECAYED_SHARE, DECAYED_TIME_CONSTANTS = 0.7, 8.0
"""The peak after gate off is over once the displacement is below this share of it, after this many gas lags."""
DISCOVERED_ROW = TERM_ROW[DISCOVERED]
MEMORY_ROW = FOLLOWER_ROW[DISCOVERED_ROW]
LOW, HIGH = 8, 9
"""Rows of a work space, if it has them, for the extremes of what discovered functions depend on."""
COLD_K = 1e-6
"""Largest rise of a pixel that counts as cold."""


class EventStates(NamedTuple):
    """States of every pixel and, in the last row, of laser and panel, at the last event of each.

    Kernels change them.

    columns: [p, 6] the fields of `Pixel`; at_s, off_s: [p + 1] time of the last event, and time since gate off then;
    states: [p + 1, STATE_COUNT]; illuminated: [1] pixel of the last pulse, −1 before the first
    """

    columns: FloatArray
    at_s: FloatArray
    off_s: FloatArray
    states: FloatArray
    illuminated: IntArray

    @classmethod
    def cold(cls, columns: FloatArray, at_s: float) -> "EventStates":
        """Return the cold states of pixels [p, 6] whose last event is at at_s."""
        count = len(columns) + 1
        states, illuminated = np.zeros((count, STATE_COUNT)), np.full(1, -1)
        return cls(columns, np.full(count, at_s), np.full(count, 1.0), states, illuminated)

    def copy_shifted(self, offset_s: float) -> "EventStates":
        """Return a copy whose times are offset_s later."""
        at_s = self.at_s + offset_s
        return EventStates(self.columns, at_s, self.off_s.copy(), self.states.copy(), self.illuminated.copy())


@kernel
def advance_states(
    pixel: Pixel,
    active: ActiveTerms,
    c: FloatArray,
    work: FloatArray,
    at_s: float,
    since_edge_s: float,
    duration_s: float,
) -> tuple[float, float]:
    """Advance the states work[0] by duration_s at the context's power. Return the peaks meanwhile.

    since_edge_s: time since the last gate edge. The peaks are those of displacement, m, and absorber rise, K. A work
    space of ten rows notes what discovered functions depend on.
    """
    peak_m = output_signal(pixel, active, work[0], c, DISPLACEMENT_SIGNAL)
    peak_k = work[0, ABSORBER]
    done_s, after_edge = 0.0, True
    while done_s < duration_s:
        # A cold pixel stays cold in the dark: hours of it cost nothing.
        if c[POWER_W] == 0.0 and _is_cold(work[0]):
            work[0] = 0.0
            break
        h_s = next_step_s(pixel, active, since_edge_s + done_s)
        # A rest of less than a third of a step is taken along, not left as a tiny step of its own.
        last = done_s + 1.3 * h_s >= duration_s
        if last:
            h_s = duration_s - done_s
        step(pixel, active, c, after_edge, at_s + done_s, since_edge_s + done_s, h_s, work)
        begin_m = output_signal(pixel, active, work[0], c, DISPLACEMENT_SIGNAL)
        end_m = output_signal(pixel, active, work[2], c, DISPLACEMENT_SIGNAL)
        interpolate_states(active.state_rows, work, 0.0, h_s, 0.5 * h_s)
        # A peak lies between steps: the vertex of a parabola finds it, where the larger end would miss it.
        middle_m = output_signal(pixel, active, work[7], c, DISPLACEMENT_SIGNAL)
        peak_m = max(peak_m, end_m, _vertex_m(begin_m, middle_m, end_m))
        peak_k = max(peak_k, work[2, ABSORBER])
        if work.shape[0] > HIGH:
            for row in (7, 2):
                note_reached(active.values[DISCOVERED_ROW], work[row], MEMORY_ROW, c, work[LOW], work[HIGH])
        copy_states(work[2], work[0])
        copy_states(work[3], work[1])
        after_edge = False
        done_s = duration_s if last else done_s + h_s
    return peak_m, peak_k


@kernel
def copy_states(source: FloatArray, target: FloatArray) -> None:
    """Copy the states [STATE_COUNT] of a pixel. An assignment of arrays would create one."""
    for row in range(len(source)):
        target[row] = source[row]


@kernel
def copy_rows(rows: IntArray, source: FloatArray, target: FloatArray) -> None:
    """Copy some of the states [STATE_COUNT] of a pixel."""
    for row in rows:
        target[row] = source[row]


@kernel
def _is_cold(state: FloatArray) -> bool:
    """Return whether no rise of a pixel's state [STATE_COUNT] is as large as COLD_K."""
    for rise_k in state:  # noqa: SIM110 — compiled as it is, without a generator
        if not abs(rise_k) < COLD_K:
            return False
    return True


@kernel
def _vertex_m(begin_m: float, middle_m: float, end_m: float) -> float:
    """Return the vertex of the parabola through three points if it is a maximum between them, else the middle one."""
    bend = begin_m - 2.0 * middle_m + end_m
    half = 0.5 * (end_m - begin_m)
    if bend >= 0.0 or abs(half) > -bend:
        return middle_m
    return middle_m - 0.5 * half * half / bend


@kernel
def peak_after_off_m(
    pixel: Pixel, active: ActiveTerms, c: FloatArray, work: FloatArray, since_edge_s: float, peak_after_s: float
) -> float:
    """Return the peak displacement, m, from peak_after_s after the states work[0] on, with the gate off."""
    c[POWER_W] = 0.0
    if peak_after_s > 0.0:
        advance_states(pixel, active, c, work, 0.0, since_edge_s, peak_after_s)
        since_edge_s += peak_after_s
    peak_m, done_s = output_signal(pixel, active, work[0], c, DISPLACEMENT_SIGNAL), 0.0
    interval_s = pixel.tau_g_s
    while True:
        interval_m = advance_states(pixel, active, c, work, done_s, since_edge_s + done_s, interval_s)[0]
        peak_m = max(peak_m, interval_m)
        done_s += interval_s
        has_decayed = done_s > DECAYED_TIME_CONSTANTS * pixel.tau_g_s
        displacement_m = output_signal(pixel, active, work[0], c, DISPLACEMENT_SIGNAL)
        # So that what is no number ends it, too. A cold pixel stays where a table's rounding at 0 puts it.
        if has_decayed and (not displacement_m > DECAYED_SHARE * peak_m or _is_cold(work[0])):
            break
    return peak_m


@kernel
def set_light(c: FloatArray, index: int, illuminated: int) -> None:
    """Let the context of pixel `index` have its light on the pixel `illuminated`."""
    c[ILLUMINATED_PIXEL], c[IS_TARGET] = illuminated, 1.0 if illuminated == index else 0.0


@kernel
def advance_shared(events: EventStates, active: ActiveTerms, c: FloatArray, shared: FloatArray, now_s: float) -> None:
    """Write the states of laser and panel at now_s to shared[0], the gate off since the last pulse on any pixel."""
    last = len(events.columns)
    copy_states(events.states[last], shared[0])
    c[POWER_W] = 0.0
    wait_s = max(0.0, now_s - events.at_s[last])
    advance_states(pixel_at(events.columns, 0), active, c, shared, 0.0, events.off_s[last], wait_s)


@kernel
def advance_to(
    events: EventStates, active: ActiveTerms, c: FloatArray, shared: FloatArray, work: FloatArray, i: int, now_s: float
) -> float:
    """Write the states of pixel i at now_s to work[0], the gate off since its last event. Return the peak meanwhile.

    The context says on which pixel the light was, shared[0] how warm the panel is at now_s, which changes slowly.
    """
    copy_states(events.states[i], work[0])
    copy_rows(active.panel_rows, shared[0], work[0])
    c[POWER_W], c[PANEL_HELD] = 0.0, 1.0
    wait_s = max(0.0, now_s - events.at_s[i])
    peak_m = advance_states(pixel_at(events.columns, i), active, c, work, 0.0, events.off_s[i], wait_s)[0]
    c[PANEL_HELD] = 0.0
    return peak_m


@kernel
def _store(events: EventStates, work: FloatArray, i: int, at_s: float, off_s: float) -> None:
    """Make work[0] the states of pixel i at at_s, off_s after gate off."""
    copy_states(work[0], events.states[i])
    events.at_s[i], events.off_s[i] = at_s, off_s


@kernel
def _store_reached(work: FloatArray, i: int, reached: FloatArray) -> None:
    """Add the extremes of a work space to those of pixel i, and begin anew."""
    if work.shape[0] > HIGH:
        for number in range(reached.shape[1]):
            reached[i, number, 0] = min(reached[i, number, 0], work[LOW, number])
            reached[i, number, 1] = max(reached[i, number, 1], work[HIGH, number])
        work[LOW] = np.inf
        work[HIGH] = -np.inf


@kernel
def _raise_peak(peak_m: FloatArray, last_pulse: IntArray, i: int, displacement_m: float) -> None:
    """Raise the peak of the last pulse on pixel i, if it had one, to a displacement."""
    if last_pulse[i] >= 0:
        peak_m[last_pulse[i]] = max(peak_m[last_pulse[i]], displacement_m)


@array_kernel
def _allocate(count: int, reached: FloatArray) -> FloatArray:
    """Return a work space for states [count], of ten rows if extremes are noted of any pixel."""
    work = np.zeros((HIGH + 1 if len(reached) else LOW, count))
    work[LOW:] = np.inf
    work[HIGH:] = -np.inf
    return work


@array_kernel
def apply_pulses(
    events: EventStates,
    neighbours: IntArray,
    active: ActiveTerms,
    context: FloatArray,
    pixel: IntArray,
    start_s: FloatArray,
    width_s: FloatArray,
    power_w: FloatArray,
    peak_m: FloatArray,
    peak_k: FloatArray,
    last_pulse: IntArray,
    reached: FloatArray,
    begin: int,
    end: int,
) -> int:
    """Apply the pulses begin to end and fill in their peaks [n]. Return the first that is out of order, or end.

    neighbours: [p, k] pixels that the light on a pixel also heats, −1 for none; last_pulse: [p] row of each pixel's
    last pulse so far, −1 for none; reached: as of `build_unreached`, of no pixel without discovered functions
    """
    count = events.states.shape[1]
    work, shared, dark, c = _allocate(count, reached), np.zeros((8, count)), np.zeros(count), context.copy()
    for row in range(begin, end):
        for side in range(-1, neighbours.shape[1]):
            i = pixel[row] if side < 0 else neighbours[pixel[row], side]
            # All pixels that the pulse heats are asked first: nothing may be half applied.
            if i >= 0 and start_s[row] - events.at_s[i] < -TIME_ROUNDING_S:
                return row
        before = events.illuminated[0]
        if len(active.laser_rows) or len(active.panel_rows):
            advance_shared(events, active, c, shared, start_s[row])
        if len(active.laser_rows) and before >= 0 and before != pixel[row]:  # the light leaves it
            for side in range(-1, neighbours.shape[1]):
                i = before if side < 0 else neighbours[before, side]
                if i < 0:
                    continue
                set_light(c, i, before)
                _raise_peak(peak_m, last_pulse, i, advance_to(events, active, c, shared, work, i, start_s[row]))
                # The laser's afterglow leaves with the beam.
                copy_rows(active.laser_rows, dark, work[0])
                wait_s = max(0.0, start_s[row] - events.at_s[i])
                _store(events, work, i, events.at_s[i] + wait_s, events.off_s[i] + wait_s)
                _store_reached(work, i, reached)
        for side in range(-1, neighbours.shape[1]):
            i = pixel[row] if side < 0 else neighbours[pixel[row], side]
            if i < 0:
                continue
            set_light(c, i, pixel[row])
            _raise_peak(peak_m, last_pulse, i, advance_to(events, active, c, shared, work, i, start_s[row]))
            copy_rows(active.laser_rows, shared[0], work[0])
            # Absorbers only cool in the dark: a peak is at an end of the pulse.
            before_k = work[0, ABSORBER]
            c[POWER_W] = power_w[row]
            one = pixel_at(events.columns, i)
            on_peak_m, on_peak_k = advance_states(one, active, c, work, 0.0, 0.0, width_s[row])
            if side < 0:
                last_pulse[i] = row
                peak_k[row] = max(before_k, on_peak_k)
            _raise_peak(peak_m, last_pulse, i, on_peak_m)
            _store(events, work, i, start_s[row] + width_s[row], 0.0)
            _store_reached(work, i, reached)
        # After all neighbours: until then the light was where it was before.
        events.illuminated[0] = pixel[row]
        copy_rows(active.laser_rows, events.states[pixel[row]], events.states[len(events.columns)])
        copy_rows(active.panel_rows, events.states[pixel[row]], events.states[len(events.columns)])
        events.at_s[len(events.columns)], events.off_s[len(events.columns)] = start_s[row] + width_s[row], 0.0
    return end


@array_kernel
def add_peaks_after_off(
    events: EventStates,
    active: ActiveTerms,
    context: FloatArray,
    last_pulse: IntArray,
    reached: FloatArray,
    begin: int,
    end: int,
    peak_m: FloatArray,
) -> None:
    """Raise the peaks of the last pulses of the pixels begin to end to those that follow after gate off."""
    work, c = _allocate(events.states.shape[1], reached), context.copy()
    for i in range(begin, end):
        if last_pulse[i] >= 0:
            copy_states(events.states[i], work[0])
            set_light(c, i, events.illuminated[0])
            off_peak_m = peak_after_off_m(pixel_at(events.columns, i), active, c, work, 0.0, 0.0)
            _raise_peak(peak_m, last_pulse, i, off_peak_m)
            _store_reached(work, i, reached)


@array_kernel
def simulate_displacement(
    pixel: Pixel,
    active: ActiveTerms,
    c: FloatArray,
    index: int,
    at_s: float,
    off_s: float,
    state: FloatArray,
    pulses: FloatArray,
    t_s: FloatArray,
    displacement_m: FloatArray,
) -> None:
    """Fill in the displacement of pixel `index` at t_s [m], under the pulses [n, 4] that act on it.

    at_s, off_s, state: a time at which the gate is off, time since gate off then, and the states; the context says on
    which pixel the light was
    """
    work = np.zeros((8, len(state)))
    copy_states(state, work[0])
    now_s, since_edge_s, row = at_s, off_s, 0
    # Edges alternate: dark until a pulse, then the pulse. The last one is the dark behind all.
    for edge in range(2 * len(pulses) + 1):
        pulse, gate_on, until_s = edge // 2, edge % 2 == 1, np.inf
        c[POWER_W] = 0.0
        if pulse < len(pulses):
            until_s = pulses[pulse, 0] + (pulses[pulse, 1] if gate_on else 0.0)
        if gate_on:
            c[POWER_W] = pulses[pulse, 2]
            set_light(c, index, int(pulses[pulse, 3]))
        while row < len(t_s) and t_s[row] <= until_s:
            duration_s = max(0.0, t_s[row] - now_s)
            advance_states(pixel, active, c, work, 0.0, since_edge_s, duration_s)
            now_s, since_edge_s = now_s + duration_s, since_edge_s + duration_s
            displacement_m[row] = output_signal(pixel, active, work[0], c, DISPLACEMENT_SIGNAL)
            row += 1
        if row == len(t_s):
            break
        advance_states(pixel, active, c, work, 0.0, since_edge_s, max(0.0, until_s - now_s))
        now_s, since_edge_s = max(now_s, until_s), 0.0
