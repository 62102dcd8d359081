"""Ordinary differential equations of one pixel with terms, compiled: from pulses to recorded signals.

Classical Runge–Kutta between gate edges, with steps that grow from each edge; samples by cubic Hermite interpolation.
Errors stay below 1e-5 of a rise for a gas that is faster than the absorber.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from math import exp
from typing import NamedTuple

import numpy as np

from optodrive.core.kernels import array_kernel, kernel
from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.physics.divergence import MAX_STATE, build_signal_error, build_state_error
from optodrive.physics.pixel import Pixel
from optodrive.physics.term import (
    ABSORBER,
    AMBIENT_K,
    BRIDGE_FLOW_W,
    CONTEXT_SIZE,
    DOSE,
    ELSEWHERE,
    FAR_END_K,
    FULL_W,
    GAS,
    ILLUMINATED_PIXEL,
    IS_TARGET,
    MEMBRANE_DRIVE_K,
    NEIGHBOUR,
    POWER_W,
    SENSOR,
    SESSION_TIME,
    SINCE_EDGE_S,
    TIME_S,
    WALL,
    RecordedRun,
    TermValues,
)
from optodrive.physics.term_kernels import CHAINS, FOLLOWER_ROW, MAX_PARAMETERS, STATE_COUNT, TERM_ROW, TERMS
from optodrive.physics.terms import all_terms

FIRST_STEP, FIRST_STEP_FAST_S = 0.15, 1e-5
"""First step after a gate edge, in time constants of gas or absorber, the faster one; or in s for a faster term."""
STEP_GROWTH = 0.2
"""Growth of the step per time since the gate edge."""
MAX_STEP_EARLY, MAX_STEP_LATE, LATE_AFTER = 0.35, 1.2, 12.0
"""Largest step before and after LATE_AFTER since a gate edge, all in the same time constants."""
MAX_STEP_S = 6e-3
"""Stability limit: 2.78 times the shortest time constant of a term, 2.5 ms, less a margin."""

(
    optical_power,
    decaying_power,
    heat_capacity,
    bridge_resistance,
    heat_loss,
    wall_rise,
    rates,
    membrane_drive,
    force_drive,
    displacement,
    force,
    sensor_reading,
    sensor_lag,
) = CHAINS


@dataclass(frozen=True, eq=False)
class PixelExperiment:
    """One run as one pixel experiences it.

    pulses: [n, 4] start_s, width_s, power_w, pixel, in order, on one beam, a pixel of ELSEWHERE being neither this one
    nor a neighbour; t_s: increasing sample times of temperature, displacement and force; dose_before: dose of earlier
    runs on this pixel, relative to the largest dose of any pixel in the recording; dose_per_j: relative dose per
    incident energy; session_time, session_time_per_s: start of the run and rate of the session's time, which runs from
    −1 to 1; full_w: full power of the laser
    """

    pulses: FloatArray
    pixel: int
    ambient_k: float
    t_s: tuple[FloatArray, FloatArray, FloatArray]
    dose_before: float = 0.0
    dose_per_j: float = 0.0
    session_time: float = 0.0
    session_time_per_s: float = 0.0
    full_w: float = 2.45

    def __post_init__(self) -> None:
        # Kernels are compiled for one memory layout.
        object.__setattr__(self, "pulses", np.array(self.pulses, dtype=np.float64).reshape(-1, 4))
        object.__setattr__(self, "t_s", tuple(np.array(times, dtype=np.float64) for times in self.t_s))

    @property
    def recorded_run(self) -> RecordedRun:
        """The run as an instrument sees it."""
        return RecordedRun(self.session_time, float(self.pulses[:, 2].max(initial=0.0)) / self.full_w)


class ActiveTerms(NamedTuple):
    """A set of terms as kernels take it.

    on: [terms], 1 for an active term; values: [terms, MAX_PARAMETERS] their parameters; state_rows: rows of the state
    vector that move; laser_rows, panel_rows: those of them that all pixels share; is_fast: whether a term is faster
    than the gas
    """

    on: IntArray
    values: FloatArray
    state_rows: IntArray
    laser_rows: IntArray
    panel_rows: IntArray
    is_fast: bool

    @classmethod
    def from_values(cls, values: Mapping[str, TermValues]) -> "ActiveTerms":
        """Return the set for term → parameter → SI value. Terms without kernels have no effect."""
        on, v = np.zeros(len(TERMS), dtype=np.int64), np.zeros((len(TERMS), MAX_PARAMETERS))
        rows, laser_rows, panel_rows = [ABSORBER, GAS, NEIGHBOUR], list[int](), list[int]()
        for key, term_values in values.items():
            row, term = TERM_ROW[key], all_terms()[key]
            on[row] = 1
            v[row, : term.row_length] = term.pack(term_values)
            followers = range(FOLLOWER_ROW[row], FOLLOWER_ROW[row] + len(term.followers))
            rows += [*term.states, *followers]
            laser_rows += followers if term.has_laser_state else ()
            panel_rows += followers if term.has_panel_state else ()
        is_fast = any(all_terms()[key].is_fast for key in values)
        shared = (np.array(laser_rows, dtype=np.int64), np.array(panel_rows, dtype=np.int64))
        return cls(on, v, np.array(rows), *shared, is_fast)

    @property
    def has_shared_states(self) -> bool:
        """Whether light on any pixel acts on all."""
        return bool(len(self.laser_rows) or len(self.panel_rows))


def simulate_signals(
    experiment: PixelExperiment,
    pixel: Pixel,
    active: ActiveTerms,
    clock_delay_s: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return measured temperature rise, K, displacement, m, and force, N, at the experiment's sample times.

    clock_delay_s: delay of the clock of each signal, s. Raises DivergedError if the states leave their range or a
    signal is no number.
    """
    out = (np.zeros(len(experiment.t_s[0])), np.zeros(len(experiment.t_s[1])), np.zeros(len(experiment.t_s[2])))
    context = np.zeros(CONTEXT_SIZE)
    context[FULL_W], context[AMBIENT_K], context[ILLUMINATED_PIXEL] = (
        experiment.full_w,
        experiment.ambient_k,
        experiment.pixel,
    )
    span = (experiment.dose_before, experiment.dose_per_j, experiment.session_time, experiment.session_time_per_s)
    work = np.zeros((8, STATE_COUNT))
    stays = _simulate(
        experiment.pulses, experiment.pixel, experiment.t_s, clock_delay_s, span, pixel, active, context, work, out
    )
    if not stays:
        raise build_state_error(np.flatnonzero(active.on).tolist(), active.state_rows.tolist(), work[0])
    if not all(np.isfinite(signal).all() for signal in out):
        raise build_signal_error(np.flatnonzero(active.on).tolist(), out)
    return out


@kernel
def evaluate_rates(pixel: Pixel, active: ActiveTerms, y: FloatArray, c: FloatArray, dy: FloatArray) -> None:
    """Write dy/dt [STATE_COUNT] for the context's command, light on this pixel, beside it or elsewhere."""
    on, v, is_target = active.on, active.values, c[IS_TARGET] > 0.0
    # Two chains: a term that scales light must not create any in the dark, and afterglow has no command to scale.
    light_w = optical_power(on, v, y, c, c[POWER_W]) if c[POWER_W] > 0.0 else decaying_power(on, v, y, c, 0.0)
    wall_k = wall_rise(on, v, y, c, y[WALL])
    # Before the hooks below: terms read the far end and the flow of this very evaluation.
    c[FAR_END_K] = wall_k
    c[BRIDGE_FLOW_W] = (y[ABSORBER] - wall_k) / bridge_resistance(on, v, y, c, pixel.r_k_per_w)
    into_w = (pixel.epsilon * light_w if is_target else 0.0) - c[BRIDGE_FLOW_W] - heat_loss(on, v, y, c, 0.0)
    dy[ABSORBER] = into_w / heat_capacity(on, v, y, c, pixel.c_j_per_k)
    dy[GAS] = (0.5 * (y[ABSORBER] + wall_k) - y[GAS]) / pixel.tau_g_s
    # Light elsewhere acts on the laser alone.
    is_beside = not is_target and c[ILLUMINATED_PIXEL] != ELSEWHERE
    neighbour_w = (pixel.epsilon * light_w if is_beside else 0.0) - y[NEIGHBOUR] / pixel.r_k_per_w
    dy[NEIGHBOUR] = neighbour_w / pixel.c_j_per_k
    # Last: terms add to the rates that the pixel has by itself.
    rates(on, v, y, c, dy)


@kernel
def _lagged_reading_k(before_k: float, from_k: float, slope: float, to_k: float, tau_s: float, h_s: float) -> float:
    """Return the exact first-order lag, after h_s, of a parabola from from_k, with a slope there, to to_k."""
    bend = (to_k - from_k - slope * h_s) / h_s**2
    at_start = from_k - slope * tau_s + 2.0 * bend * tau_s**2
    at_end = at_start + (slope - 2.0 * bend * tau_s) * h_s + bend * h_s**2
    return float(at_end + (before_k - at_start) * exp(-h_s / tau_s))


@kernel
def step(
    pixel: Pixel,
    active: ActiveTerms,
    c: FloatArray,
    after_edge: bool,
    at_s: float,
    since_edge_s: float,
    h_s: float,
    work: FloatArray,
) -> None:
    """Take one Runge–Kutta step of h_s.

    work: [8, STATE_COUNT], rows 0 and 1 hold y and dy/dt at the start, 2 and 3 those at the end; after_edge: dy/dt at
    the start is not known yet, because the light has changed
    """
    y, y1 = work[0], work[2]
    k1, k2, k3, k4, stage = work[1], work[4], work[5], work[6], work[7]
    c[TIME_S], c[SINCE_EDGE_S] = at_s, since_edge_s
    # Else the last step's end is this one's start, and its rates are known: one evaluation of five is saved.
    if after_edge:
        evaluate_rates(pixel, active, y, c, k1)
    rows = active.state_rows
    c[TIME_S], c[SINCE_EDGE_S] = at_s + 0.5 * h_s, since_edge_s + 0.5 * h_s
    for row in rows:
        stage[row] = y[row] + 0.5 * h_s * k1[row]
    evaluate_rates(pixel, active, stage, c, k2)
    for row in rows:
        stage[row] = y[row] + 0.5 * h_s * k2[row]
    evaluate_rates(pixel, active, stage, c, k3)
    c[TIME_S], c[SINCE_EDGE_S] = at_s + h_s, since_edge_s + h_s
    for row in rows:
        stage[row] = y[row] + h_s * k3[row]
    evaluate_rates(pixel, active, stage, c, k4)
    for row in rows:
        y1[row] = y[row] + h_s / 6.0 * (k1[row] + 2.0 * k2[row] + 2.0 * k3[row] + k4[row])
    # For the Hermite interpolation of samples, and as k1 of the next step.
    evaluate_rates(pixel, active, y1, c, work[3])
    tau_s = sensor_lag(active.on, active.values, y, c, 0.0)
    if tau_s > 0.0:
        # In closed form and not as a state: a thermometer's lag may be shorter than the steps.
        y1[SENSOR] = _lagged_reading_k(y[SENSOR], y[ABSORBER], k1[ABSORBER], y1[ABSORBER], tau_s, h_s)
        k1[SENSOR], work[3, SENSOR] = (y[ABSORBER] - y[SENSOR]) / tau_s, (y1[ABSORBER] - y1[SENSOR]) / tau_s
    else:
        y1[SENSOR], k1[SENSOR], work[3, SENSOR] = y1[ABSORBER], k1[ABSORBER], work[3, ABSORBER]


@kernel
def next_step_s(pixel: Pixel, active: ActiveTerms, since_edge_s: float) -> float:
    """Return the length of the step that begins since_edge_s after a gate edge, s."""
    fastest_s = min(pixel.tau_g_s, pixel.r_k_per_w * pixel.c_j_per_k)
    max_step = MAX_STEP_LATE if since_edge_s > LATE_AFTER * fastest_s else MAX_STEP_EARLY
    return min(
        MAX_STEP_S,
        # Steps grow from an edge on, where everything changes fastest.
        STEP_GROWTH * since_edge_s + (FIRST_STEP_FAST_S if active.is_fast else FIRST_STEP * fastest_s),
        max_step * fastest_s,
    )


@kernel
def interpolate_states(rows: IntArray, work: FloatArray, at_s: float, h_s: float, sample_s: float) -> None:
    """Write the states at sample_s, within the step from at_s, to row 7 of work."""
    u = (sample_s - at_s) / h_s
    rest = 1.0 - u
    for row in rows:
        y0, f0, y1, f1 = work[0, row], work[1, row], work[2, row], work[3, row]
        ends = (1.0 + 2.0 * u) * rest * rest * y0 + u * u * (3.0 - 2.0 * u) * y1
        work[7, row] = ends + h_s * u * rest * (rest * f0 - u * f1)
    y0, f0, y1, f1 = work[0, SENSOR], work[1, SENSOR], work[2, SENSOR], work[3, SENSOR]
    ends = (1.0 + 2.0 * u) * rest * rest * y0 + u * u * (3.0 - 2.0 * u) * y1
    work[7, SENSOR] = ends + h_s * u * rest * (rest * f0 - u * f1)


@kernel
def output_signal(pixel: Pixel, active: ActiveTerms, y: FloatArray, c: FloatArray, signal: int) -> float:
    """Return one signal: 0 the measured temperature rise, K, 1 displacement, m, 2 force, N."""
    if signal == 0:
        return float(sensor_reading(active.on, active.values, y, c, y[SENSOR]))
    if signal == 1:
        c[MEMBRANE_DRIVE_K] = membrane_drive(active.on, active.values, y, c, y[GAS])
        return float(displacement(active.on, active.values, y, c, pixel.kappa_m_per_k * c[MEMBRANE_DRIVE_K]))
    force_n = pixel.phi_n_per_k * force_drive(active.on, active.values, y, c, y[GAS])
    return float(force(active.on, active.values, y, c, force_n))


@kernel
def _fill_samples(
    pixel: Pixel,
    active: ActiveTerms,
    c: FloatArray,
    work: FloatArray,
    at_s: float,
    h_s: float,
    t_s: FloatArray,
    clock_delay_s: float,
    span: tuple[float, float, float, float],
    signal: int,
    index: int,
    out: FloatArray,
) -> int:
    """Write the samples within the step from at_s to `out`, from `index` on. Return the index of the next sample."""
    while index < len(t_s) and t_s[index] - clock_delay_s <= at_s + h_s:
        sample_s = max(at_s, t_s[index] - clock_delay_s)
        interpolate_states(active.state_rows, work, at_s, h_s, sample_s)
        c[TIME_S], c[SESSION_TIME] = t_s[index], span[2] + span[3] * t_s[index]
        out[index] = output_signal(pixel, active, work[7], c, signal)
        index += 1
    return index


@array_kernel
def _simulate(
    pulses: FloatArray,
    index: int,
    t_s: tuple[FloatArray, FloatArray, FloatArray],
    clock_delay_s: tuple[float, float, float],
    span: tuple[float, float, float, float],
    pixel: Pixel,
    active: ActiveTerms,
    c: FloatArray,
    work: FloatArray,
    out: tuple[FloatArray, FloatArray, FloatArray],
) -> bool:
    """Integrate pixel `index` from its cold state through the pulses and write its signals to `out` at t_s.

    Return False, with the states in work[0], as soon as one leaves its range.
    """
    until_s = 0.0
    for signal in range(3):
        if len(t_s[signal]):
            until_s = max(until_s, t_s[signal][-1] - clock_delay_s[signal])
    samples = np.zeros(3, dtype=np.int64)
    now_s, edge_s, row, dose = 0.0, 0.0, 0, span[0]
    gate_on, after_edge = False, True
    # At least one step: samples may all be at 0.
    while now_s < until_s or now_s == 0.0:
        if row < len(pulses) and not gate_on and pulses[row, 0] <= now_s:
            gate_on, edge_s, after_edge = True, now_s, True
            c[POWER_W], c[ILLUMINATED_PIXEL] = pulses[row, 2], pulses[row, 3]
            c[IS_TARGET] = 1.0 if pulses[row, 3] == index else 0.0
        end_s = until_s + 1e-3
        if gate_on:
            end_s = pulses[row, 0] + pulses[row, 1]
        elif row < len(pulses):
            end_s = pulses[row, 0]
        since_edge_s = now_s - edge_s
        h_s = next_step_s(pixel, active, since_edge_s)
        # Steps end at edges: a kink within one costs the method its order.
        reaches_edge = now_s + 1.3 * h_s >= end_s
        if reaches_edge:
            h_s = end_s - now_s
        if h_s > 0.0:
            c[DOSE], c[SESSION_TIME] = dose, span[2] + span[3] * now_s
            step(pixel, active, c, after_edge, now_s, since_edge_s, h_s, work)
            samples[0] = _fill_samples(
                pixel, active, c, work, now_s, h_s, t_s[0], clock_delay_s[0], span, 0, samples[0], out[0]
            )
            samples[1] = _fill_samples(
                pixel, active, c, work, now_s, h_s, t_s[1], clock_delay_s[1], span, 1, samples[1], out[1]
            )
            samples[2] = _fill_samples(
                pixel, active, c, work, now_s, h_s, t_s[2], clock_delay_s[2], span, 2, samples[2], out[2]
            )
            # Of the command: ageing by light that other terms change would feed on itself.
            dose += c[IS_TARGET] * c[POWER_W] * h_s * span[1]
            after_edge = False
            for state in active.state_rows:
                work[0, state], work[1, state] = work[2, state], work[3, state]
            work[0, SENSOR], work[1, SENSOR] = work[2, SENSOR], work[3, SENSOR]
            for state in active.state_rows:
                # `not <=`: NaN counts as out of range.
                if not abs(work[0, state]) <= MAX_STATE:
                    return False
        now_s = end_s if reaches_edge else now_s + h_s
        if reaches_edge:
            edge_s, after_edge = now_s, True
            if gate_on:
                gate_on, row = False, row + 1
                c[POWER_W] = 0.0
    return True
