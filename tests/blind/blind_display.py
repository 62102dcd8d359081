"""Ground truth of the blind tests: a pixel with any of its effects, integrated by an independent Runge–Kutta scheme.

Independent of the package: no module imports the other. All units are SI. Temperatures inside are rises above the
ambient at the start of the run, unless a name ends in `_K`.

    C dθ/dt = ε P − flow(θ, w) − …      flow = (θ − w)/R in the nominal model
    τ_g dγ/dt = (θ + w)/2 − γ           z = κ γ,  F = φ γ,  T = ambient + θ
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field, replace

import numpy as np
from numba import njit

ABSORBED = 0.66
FULL_POWER_W = 2.45

TEMPERATURE = "absorber_temperature_K"
DISPLACEMENT = "displacement_m"
FORCE = "force_N"
MIRRORS = ("mirror_x_rad", "mirror_y_rad")

CREEP_TERMS = 6

# Rows of the state: 0 absorber, 1 wall, 2 slower wall, 3 gas, 4 gas lost, 5..10 creep, 11 node behind the absorber,
# 12 neighbour, 13 crosstalk after its lag, 14 thermometer, 15 sum of the absorber, 16 and 17 droop, 18 membrane
# and 19 its speed. Numbers stand in the compiled code below.

# Columns of the dense output.
OUT_THETA, OUT_SENSED, OUT_GAS, OUT_MEMBRANE, OUT_SUM = range(5)

# A segment of the drive: start, end, power, instant of turn-on, 0 own or 1 neighbour, mode, instant of turn-off,
# drive of the droop, share that misses the absorber. The modes:
GATE_OFF, GATE_ON, AFTER_FLAT, AFTER_FADING = 0.0, 1.0, 2.0, 3.0


@dataclass(frozen=True)
class Physics:
    """All parameters of the hidden display. The defaults are the nominal model."""

    R: float = 200.0
    C: float = 1.0e-4
    tau_g: float = 3.0e-3
    kappa: float = 4.0e-6
    phi: float = 2.3e-4

    bridge: str = ""  # "", "mean", "integrated"
    bridge_n: float = 0.0
    capacity: str = ""  # "", "linear", "graphite"
    capacity_c: float = 0.0  # per 100 K at the start
    capacity_knee: float = 300.0
    radiating: float = 0.0  # εA, m²
    radiating_rise: float = 0.0  # emissivity grows as T to this power
    wall_r: float = 0.0
    wall_c: float = 1.0
    wall_takes_flow: float = 1.0
    gas_takes_wall: float = 1.0  # share of the wall's rise that the gas follows
    wall2_r: float = 0.0
    wall2_c: float = 1.0
    crosstalk: float = 0.0
    crosstalk_lag: float = 0.0

    turn_on: str = ""  # "", "ramp", "exponential", "raised_cosine"
    turn_on_s: float = 1.0e-4
    droop: tuple[float, float] = (0.0, 0.0)
    droop_s: tuple[float, float] = (1.0, 1.0)
    droop_by_power: bool = False
    power: str = ""  # "", "threshold", "threshold_full", "curvature"
    power_size: float = 0.0
    ageing: str = ""  # by dose "linear", "saturating"; over the session "by_time", "by_run", "step"; "" for none
    ageing_loss: float = 0.0
    ageing_dose: float = 1.0  # J at which the loss is reached
    ageing_knee: float = 0.4  # saturating: share of that dose
    ageing_s: float = 1.0  # by_time: duration until the loss is reached; step: its time
    ageing_runs: float = 1.0  # by_run: number of runs until the loss is reached
    stray_pixel: int = -1
    stray: float = 0.0

    leak: float = 0.0  # 1/s
    creep: tuple[float, ...] = ()
    creep_s: tuple[float, ...] = ()
    stiff: str = ""  # "", "cubic", "tanh"
    stiff_m: float = 1.0

    sensor: str = ""  # "", "first_order", "moving_average"
    sensor_s: float = 1.0e-3
    scale: float = 1.0
    scale_room_k: float = 295.0
    clock_s: dict[str, float] = field(default_factory=dict)
    room: str = ""  # "", "ramp", "sine"
    room_k: float = 0.0
    room_phase: float = 0.0
    room_session_s: float = 3600.0
    room_in_run: float = 0.0  # K/s

    mirror_hz: float = 0.0
    mirror_zeta: float = 0.7
    mirror_delay_s: float = 0.0
    mirror_slew: float = 0.0  # rad/s, 0 for none

    # Outside the catalogue.
    ring_hz: float = 0.0
    ring_zeta: float = 0.1
    glare: float = 0.0  # m/W
    hop: float = 0.0
    hop_rate: float = 0.0
    play_m: float = 0.0
    ceiling_k: float = 0.0
    ceiling_slope: float = 0.0
    node_share: float = 0.0
    node_s: float = 1.0
    hum_signal: str = ""
    hum: float = 0.0
    hum_phase: float = 0.0
    hum_hz: float = 50.0
    hum_is_random: bool = False  # another phase in every run
    jump_signal: str = ""  # telegraph of one instrument's zero
    jump: float = 0.0
    jump_rate: float = 0.0
    wander_signal: str = ""  # drift of one instrument's zero over the session
    wander: float = 0.0
    wander_s: float = 1.0
    wander_phase: float = 0.0  # 0: a ramp
    after: str = ""  # "", "flat", "fading"
    after_s: float = 0.0
    after_share: float = 1.0
    missed: float = 0.0
    melt_j: float = 0.0
    melt_at: float = 100.0
    melt_width: float = 8.0
    one_way: float = 0.0
    slack_m: float = 0.0

    def with_(self, **changes: object) -> Physics:
        return replace(self, **changes)  # type: ignore[arg-type]


_KINDS = {"": 0.0, "mean": 1.0, "integrated": 2.0, "linear": 1.0, "graphite": 2.0}
_TURNS = {"": 0.0, "ramp": 1.0, "exponential": 2.0, "raised_cosine": 3.0}


def _pack_parameters(p: Physics, ambient_k: float) -> np.ndarray:
    v = np.zeros(64)
    v[:5] = p.R, p.C, p.tau_g, _KINDS[p.bridge], p.bridge_n
    v[5:8] = _KINDS[p.capacity], p.capacity_c, p.capacity_knee
    v[8:10] = p.radiating, p.radiating_rise
    v[10:15] = p.wall_r, p.wall_c, p.wall_takes_flow, p.wall2_r, p.wall2_c
    v[15:17] = p.crosstalk, p.crosstalk_lag
    v[17:19] = _TURNS[p.turn_on], p.turn_on_s
    v[19:23] = *p.droop, *p.droop_s
    v[23] = p.leak
    v[24] = {"": 0.0, "first_order": 1.0, "moving_average": 2.0}[p.sensor]
    v[25] = p.sensor_s
    v[26:28] = 2 * math.pi * p.ring_hz, p.ring_zeta
    v[28:30] = p.node_share, p.node_s
    v[30:33] = p.melt_j, p.melt_at, p.melt_width
    v[33] = p.one_way
    v[34:36] = p.after_s, p.after_share
    v[36] = ambient_k
    v[37] = len(p.creep)
    v[38] = p.gas_takes_wall
    v[40 : 40 + len(p.creep)] = p.creep
    v[50 : 50 + len(p.creep)] = p.creep_s
    return v


@njit(cache=True)
def _compute_capacity_j_per_k(v, theta):
    c = v[1]
    if v[5] == 1.0:
        c *= 1.0 + v[6] * theta / 100.0
    elif v[5] == 2.0:
        c *= 1.0 + v[6] * v[7] / 100.0 * (1.0 - math.exp(-theta / v[7]))
    if v[30] > 0.0:
        x = (theta - v[31]) / v[32]
        c += v[30] / (v[32] * 2.5066282746310002) * math.exp(-0.5 * x * x)
    return c


@njit(cache=True)
def _compute_flow_w(v, theta, wall):
    room = v[36]
    if v[3] == 0.0:
        return (theta - wall) / v[0]
    n = v[4]
    if v[3] == 1.0:
        mean = room + 0.5 * (theta + wall)
        return (theta - wall) / (v[0] * (mean / room) ** n)
    hot, cold = 1.0 + theta / room, 1.0 + wall / room
    if abs(n - 1.0) < 1e-6:
        return room / v[0] * math.log(hot / cold)
    return room / v[0] * (hot ** (1.0 - n) - cold ** (1.0 - n)) / (1.0 - n)


@njit(cache=True)
def _compute_radiation_w(v, theta):
    if v[8] == 0.0:
        return 0.0
    room = v[36]
    hot = room + theta
    return v[8] * 5.670374e-8 * (hot**4 - room**4) * (hot / room) ** v[9]


@njit(cache=True)
def _compute_beam_power_w(v, seg, t, s):
    """Return the power of the beam at t, W, independent of its target."""
    if seg[5] == 0.0:
        return 0.0
    power = seg[2] * (1.0 - v[19] * s[16] - v[20] * s[17])
    if seg[5] == 2.0:
        return power * v[35]
    if seg[5] == 3.0:
        return power * v[35] * math.exp(-(t - seg[6]) / v[34])
    x = t - seg[3]
    if v[17] == 1.0:
        power *= min(1.0, x / v[18])
    elif v[17] == 2.0:
        power *= 1.0 - math.exp(-x / v[18])
    elif v[17] == 3.0 and x < v[18]:
        power *= 0.5 - 0.5 * math.cos(math.pi * x / v[18])
    return power


@njit(cache=True)
def _compute_rates(v, seg, t, s, d):
    light = _compute_beam_power_w(v, seg, t, s)
    own, beside = 0.0, 0.0
    if seg[4] == 0.0:
        own = light
    else:
        beside = light
    theta = s[0]
    wall = s[1]
    if v[15] > 0.0:
        d[12] = (
            0.66 * beside - _compute_flow_w(v, s[12], 0.0) - _compute_radiation_w(v, s[12])
        ) / _compute_capacity_j_per_k(v, s[12])
        if v[16] > 0.0:
            d[13] = (s[12] - s[13]) / v[16]
            wall += v[15] * s[13]
        else:
            wall += v[15] * s[12]
    flow = _compute_flow_w(v, theta, wall)
    net = 0.66 * own * (1.0 - seg[8]) - flow - _compute_radiation_w(v, theta)
    if v[28] > 0.0:
        net -= v[28] * v[1] / v[29] * (theta - s[11])
        d[11] = (theta - s[11]) / v[29]
    d[0] = net / _compute_capacity_j_per_k(v, theta)
    if v[10] > 0.0:
        out = (s[1] - s[2]) / v[10]
        d[1] = (v[12] * flow + 0.66 * own * seg[8] - out) / v[11]
        if v[13] > 0.0:
            d[2] = (out - s[2] / v[13]) / v[14]
    drive = 0.5 * (theta + v[38] * wall) - s[3]
    tau = v[2]
    if drive < 0.0:
        tau *= 1.0 + v[33]
    d[3] = drive / tau
    d[4] = v[23] * (s[3] - s[4])
    pressure = s[3] - s[4]
    stretched = pressure
    for k in range(int(v[37])):
        d[5 + k] = (pressure - s[5 + k]) / v[50 + k]
        stretched += v[40 + k] * s[5 + k]
    if v[24] == 1.0:
        d[14] = (theta - s[14]) / v[25]
    elif v[24] == 2.0:
        d[15] = theta
    if v[19] > 0.0:
        d[16] = (seg[7] - s[16]) / v[21]
        if v[20] > 0.0:
            d[17] = (seg[7] - s[17]) / v[22]
    if v[26] > 0.0:
        d[18] = s[19]
        d[19] = v[26] * (v[26] * (stretched - s[18]) - 2.0 * v[27] * s[19])


@njit(cache=True)
def _compute_outputs(v, x, y):
    """Compute linear outputs of a state, or of its derivatives."""
    y[0] = x[0]
    y[1] = x[14] if v[24] == 1.0 else x[0]
    y[2] = x[3] - x[4]
    if v[26] > 0.0:
        y[3] = x[18]
    else:
        y[3] = y[2]
        for k in range(int(v[37])):
            y[3] += v[40 + k] * x[5 + k]
    y[4] = x[15]


@njit(cache=True)
def _integrate(v, segments, longest, shortest):
    """Integrate with classical Runge–Kutta steps that start short after each edge and grow, with Hermite output."""
    count = 0
    for i in range(len(segments)):
        t = 0.0
        span = segments[i, 1] - segments[i, 0]
        while t < span * (1.0 - 1e-12):
            t += min(longest, shortest + 0.12 * t)
            count += 1
    times = np.empty(count + 1)
    values = np.zeros((count, 2, 5))
    slopes = np.zeros((count, 2, 5))
    s = np.zeros(20)
    work = np.zeros(20)
    k1, k2, k3, k4 = np.zeros(20), np.zeros(20), np.zeros(20), np.zeros(20)
    at = 0
    for i in range(len(segments)):
        seg = segments[i]
        start, span, t = seg[0], seg[1] - seg[0], 0.0
        _compute_rates(v, seg, start, s, k1)
        while t < span * (1.0 - 1e-12):
            nominal = min(longest, shortest + 0.12 * t)
            h = min(nominal, span - t)
            now = start + t
            times[at] = now
            _compute_outputs(v, s, values[at, 0])
            _compute_outputs(v, k1, slopes[at, 0])
            for j in range(20):
                work[j] = s[j] + 0.5 * h * k1[j]
            _compute_rates(v, seg, now + 0.5 * h, work, k2)
            for j in range(20):
                work[j] = s[j] + 0.5 * h * k2[j]
            _compute_rates(v, seg, now + 0.5 * h, work, k3)
            for j in range(20):
                work[j] = s[j] + h * k3[j]
            _compute_rates(v, seg, now + h, work, k4)
            for j in range(20):
                s[j] += h / 6.0 * (k1[j] + 2.0 * k2[j] + 2.0 * k3[j] + k4[j])
            t += nominal
            _compute_rates(v, seg, now + h, s, k1)
            _compute_outputs(v, s, values[at, 1])
            _compute_outputs(v, k1, slopes[at, 1])
            at += 1
    times[at] = segments[len(segments) - 1, 1]
    return times, values, slopes


@njit(cache=True)
def _interpolate(times, values, slopes, column, query_s):
    """Return one output at the query times. It is zero before the start."""
    result = np.zeros(len(query_s))
    last = len(times) - 2
    for i in range(len(query_s)):
        t = query_s[i]
        if t <= times[0]:
            continue
        k = min(np.searchsorted(times, t, side="right") - 1, last)
        h = times[k + 1] - times[k]
        x = (t - times[k]) / h
        a = (1.0 + 2.0 * x) * (1.0 - x) ** 2
        b = x * x * (3.0 - 2.0 * x)
        c = h * x * (1.0 - x) ** 2
        e = h * x * x * (x - 1.0)
        result[i] = (
            a * values[k, 0, column] + b * values[k, 1, column] + c * slopes[k, 0, column] + e * slopes[k, 1, column]
        )
    return result


@njit(cache=True)
def _apply_backlash(times, ends, query_s, inputs, reach):
    """Return a follower with dead travel of ± reach, propagated along the steps and evaluated between them."""
    held = np.zeros(len(times))
    for k in range(len(times) - 1):
        held[k + 1] = min(max(held[k], ends[k] - reach), ends[k] + reach)
    result = np.zeros(len(query_s))
    for i in range(len(query_s)):
        k = max(np.searchsorted(times, query_s[i], side="right") - 1, 0)
        result[i] = min(max(held[k], inputs[i] - reach), inputs[i] + reach)
    return result


@njit(cache=True)
def _simulate_servo(steps, targets, query_s, omega, zeta, slew):
    """Return a second-order position servo with limited speed at the query times."""
    result = np.zeros(len(query_s))
    h = min(4e-6, 0.02 / omega)
    x, speed, t, row = 0.0, 0.0, 0.0, -1
    for i in range(len(query_s)):
        while t < query_s[i] - 1e-12:
            dt = min(h, query_s[i] - t)
            while row + 1 < len(steps) and steps[row + 1] <= t + 1e-12:
                row += 1
            if row + 1 < len(steps):
                dt = min(dt, steps[row + 1] - t)
            target = targets[row] if row >= 0 else 0.0
            a1 = omega * (omega * (target - x) - 2.0 * zeta * speed)
            mid_speed = speed + 0.5 * dt * a1
            mid_x = x + 0.5 * dt * speed
            a2 = omega * (omega * (target - mid_x) - 2.0 * zeta * mid_speed)
            if slew > 0.0:
                mid_speed = min(max(mid_speed, -slew), slew)
            x += dt * mid_speed
            speed += dt * a2
            if slew > 0.0:
                speed = min(max(speed, -slew), slew)
            t += dt
        result[i] = x
    return result


def compute_delivered_w(p: Physics, commanded_w: float) -> float:
    """Return the optical power for a commanded power."""
    if p.power == "threshold":
        return max(commanded_w - p.power_size, 0.0)
    if p.power == "threshold_full":
        return max(commanded_w - p.power_size, 0.0) * FULL_POWER_W / (FULL_POWER_W - p.power_size)
    if p.power == "curvature":
        return commanded_w * (1.0 + p.power_size * (commanded_w / FULL_POWER_W - 1.0))
    return commanded_w


def compute_absorption(p: Physics, dose_j: float, session_s: float, run: int) -> float:
    """Return the remaining share of the absorption after a dose, in a run at a time of the session."""
    if p.ageing == "by_time":
        return 1.0 - p.ageing_loss * session_s / p.ageing_s
    if p.ageing == "by_run":
        return 1.0 - p.ageing_loss * run / p.ageing_runs
    if p.ageing == "step":
        return 1.0 - p.ageing_loss * (session_s > p.ageing_s)
    x = dose_j / p.ageing_dose
    if p.ageing == "linear":
        return 1.0 - p.ageing_loss * x
    if p.ageing == "saturating":
        return 1.0 - p.ageing_loss * -math.expm1(-x / p.ageing_knee) / -math.expm1(-1.0 / p.ageing_knee)
    return 1.0


def _build_segments(
    p: Physics,
    pulses: np.ndarray,
    pixel: int,
    end: float,
    factor: float,
    dose: float,
    noise_seed: int,
    session_s: float = 0.0,
):
    """Return the drive as segments with smooth power."""
    rng = np.random.default_rng([noise_seed, 77])
    order = np.argsort(pulses[:, 0], kind="stable") if len(pulses) else np.zeros(0, int)
    hops = np.zeros(0)
    if p.hop:
        hops = np.sort(rng.uniform(0.0, end, rng.poisson(p.hop_rate * end) + 1))
    levels = 1.0 - p.hop * (np.arange(len(hops) + 1) % 2 if rng.random() < 0.5 else 1 - np.arange(len(hops) + 1) % 2)
    rows: list[list[float]] = []
    clock = 0.0

    def add(start: float, stop: float, row: list[float]) -> None:
        cuts = [start, *(float(x) for x in hops if start < x < stop), stop]
        for a, b in itertools.pairwise(cuts):
            if b - a > 1e-9:
                level = float(levels[np.searchsorted(hops, 0.5 * (a + b))]) if p.hop else 1.0
                rows.append([a, b, row[0] * level, *row[1:]])

    for nth, index in enumerate(order):
        start, width, commanded, pulsed = pulses[index]
        missed = p.missed and len(order) > 5 and rng.random() < p.missed
        own = int(pulsed) == pixel
        power = compute_delivered_w(p, commanded) * factor
        wall = 0.0
        if own:
            power *= compute_absorption(p, dose, session_s, noise_seed % 1000)
            dose += commanded * width
        if int(pulsed) == p.stray_pixel:
            wall = p.stray
        if missed:
            continue
        target = 0.0 if own else 1.0
        begin, stop = min(start, end), min(start + width, end)
        drive = commanded / FULL_POWER_W if p.droop_by_power else 1.0
        if begin > clock:
            rows.append([clock, begin, 0.0, 0.0, 0.0, GATE_OFF, 0.0, 0.0, 0.0])
        full = [power, start, target, GATE_ON, 0.0, drive, wall]
        ready = start + p.turn_on_s
        if p.turn_on in ("ramp", "raised_cosine") and ready < stop:
            add(start, ready, full)
            add(ready, stop, full)
        else:
            add(start, stop, full)
        clock = stop
        if p.after:
            following = pulses[order[nth + 1], 0] if nth + 1 < len(order) else end
            lasting = p.after_s * (1.0 if p.after == "flat" else 12.0)
            last = min(stop + lasting, following, end)
            mode = AFTER_FLAT if p.after == "flat" else AFTER_FADING
            add(stop, last, [power, start, target, mode, stop, 0.0, wall])
            clock = max(clock, last)
    if clock < end:
        rows.append([clock, end, 0.0, 0.0, 0.0, GATE_OFF, 0.0, 0.0, 0.0])
    return np.array(rows)


def _compute_max_step_s(p: Physics) -> float:
    """Return the longest step that resolves every time constant present."""
    longest = min(1e-4, 0.04 * p.tau_g)
    if p.sensor == "first_order":
        longest = min(longest, 0.8 * p.sensor_s)
    if p.ring_hz:
        longest = min(longest, 0.12 / (2 * math.pi * p.ring_hz))
    return longest


def compute_ambient_rise_k(p: Physics, session_s: float) -> float:
    """Return the unrecorded change of the ambient temperature, K, at a time of the session."""
    x = session_s / p.room_session_s
    if p.room == "ramp":
        return p.room_k * x
    if p.room == "sine":
        return p.room_k * math.sin(2 * math.pi * x + p.room_phase)
    return 0.0


def compute_membrane_m(p: Physics, free_m: np.ndarray) -> np.ndarray:
    """Return the displacement of a stiffening membrane from that of a linear one."""
    if p.stiff == "tanh":
        return p.stiff_m * np.tanh(free_m / p.stiff_m)
    if p.stiff == "cubic":
        z = free_m / (1.0 + (free_m / p.stiff_m) ** 2) ** (1.0 / 3.0)
        for _ in range(20):
            x = z / p.stiff_m
            z = z - (z + z * x * x - free_m) / (1.0 + 3.0 * x * x)
        return z
    return free_m


def simulate_signals(
    p: Physics,
    pulses: np.ndarray,
    times: dict[str, np.ndarray],
    *,
    pixel: int = 0,
    ambient_k: float = 295.0,
    session_s: float = 0.0,
    dose_j: float = 0.0,
    noise_seed: int = 0,
    factor: float = 1.0,
    late_s: float = 0.0,
    commands: np.ndarray | None = None,
    refinement: float = 1.0,
) -> dict[str, np.ndarray]:
    """Return the readings of ideal instruments at `pixel` at the given times, with effects and without noise."""
    query_s = {name: t - late_s - p.clock_s.get(name, 0.0) for name, t in times.items()}
    result: dict[str, np.ndarray] = {}
    thermal = [name for name in times if name not in MIRRORS]
    if thermal:
        end = max(max(float(query_s[name][-1]) for name in thermal), 1e-3) + 1e-6
        segments = _build_segments(
            p, np.asarray(pulses, float).reshape(-1, 4), pixel, end, factor, dose_j, noise_seed, session_s
        )
        v = _pack_parameters(p, ambient_k)
        steps = _integrate(v, segments, _compute_max_step_s(p) / refinement, 2e-6 / refinement)
        for name in thermal:
            result[name] = _simulate_instrument(
                p, name, segments, steps, query_s[name], times[name], ambient_k, session_s, noise_seed
            )
    for name in times:
        if name in MIRRORS:
            assert commands is not None
            result[name] = _simulate_mirror(p, commands[:, 0], commands[:, 1 + MIRRORS.index(name)], query_s[name])
    return result


def _simulate_instrument(
    p: Physics, name, segments, steps, query_s, shown_t_s, ambient_k, session_s, noise_seed
) -> np.ndarray:
    grid, values, slopes = steps
    if name == TEMPERATURE:
        if p.sensor == "moving_average":
            window = 2.0 * p.sensor_s
            total = _interpolate(grid, values, slopes, OUT_SUM, query_s)
            result = (total - _interpolate(grid, values, slopes, OUT_SUM, query_s - window)) / window
        else:
            result = _interpolate(grid, values, slopes, OUT_SENSED, query_s)
        result = result + ambient_k + compute_ambient_rise_k(p, session_s) + p.room_in_run * shown_t_s
        if p.ceiling_k:
            over = result > p.ceiling_k
            result = np.where(over, p.ceiling_k + p.ceiling_slope * (result - p.ceiling_k), result)
        result = p.scale_room_k + p.scale * (result - p.scale_room_k)
    elif name == DISPLACEMENT:
        result = p.kappa * _interpolate(grid, values, slopes, OUT_MEMBRANE, query_s)
        if p.play_m:
            result = _apply_backlash(grid, p.kappa * values[:, 1, OUT_MEMBRANE], query_s, result, p.play_m)
        result = compute_membrane_m(p, result)
        if p.slack_m:
            result = np.maximum(result - p.slack_m, 0.0)
        if p.glare:
            row = np.clip(np.searchsorted(segments[:, 0], query_s, side="right") - 1, 0, len(segments) - 1)
            result = result - p.glare * np.where(segments[row, 5] == GATE_ON, segments[row, 2], 0.0)
    else:
        result = p.phi * _interpolate(grid, values, slopes, OUT_GAS, query_s)
    if p.hum_signal == name:
        phase = p.hum_phase
        if p.hum_is_random:
            phase = float(np.random.default_rng([noise_seed, 78]).uniform(0.0, 2.0 * math.pi))
        result = result + p.hum * np.sin(2 * math.pi * p.hum_hz * shown_t_s + phase)
    if p.jump_signal == name:
        rng = np.random.default_rng([noise_seed, 79])
        jumps = np.sort(rng.uniform(0.0, shown_t_s[-1], rng.poisson(p.jump_rate * shown_t_s[-1])))
        result = result + p.jump * (np.searchsorted(jumps, shown_t_s) % 2)
    if p.wander_signal == name:
        x = session_s / p.wander_s
        result = result + p.wander * (math.sin(2 * math.pi * x + p.wander_phase) if p.wander_phase else x)
    return result


def _simulate_mirror(p: Physics, steps: np.ndarray, targets: np.ndarray, query_s: np.ndarray) -> np.ndarray:
    steps, targets = np.ascontiguousarray(steps), np.ascontiguousarray(targets)
    if p.mirror_hz:
        omega = 2 * math.pi * p.mirror_hz
        return _simulate_servo(steps + p.mirror_delay_s, targets, query_s, omega, p.mirror_zeta, p.mirror_slew)
    row = np.searchsorted(steps, query_s, side="right") - 1
    return np.where(row >= 0, targets[np.maximum(row, 0)], 0.0)


def compute_max_rise_k(p: Physics, pulses: np.ndarray, pixel: int = 0) -> float:
    """Return the largest rise of the absorber, K."""
    pulses = np.asarray(pulses, float).reshape(-1, 4)
    end = float((pulses[:, 0] + pulses[:, 1]).max()) + 1e-3
    steps = _integrate(
        _pack_parameters(p, 295.0), _build_segments(p, pulses, pixel, end, 1.0, 0.0, 0), _compute_max_step_s(p), 2e-6
    )
    return float(steps[1][:, 1, OUT_THETA].max())


@njit(cache=True)
def compute_nominal_rises(edges, powers, query_s, r, c, tau):
    """Return nominal rises of absorber and gas for piecewise constant absorbed power, in closed form."""
    theta, gas = np.zeros(len(query_s)), np.zeros(len(query_s))
    rc = r * c
    t, a, g, power, row = 0.0, 0.0, 0.0, 0.0, 0
    mix = 0.5 * rc / (rc - tau)
    for i in range(len(query_s)):
        if query_s[i] <= 0.0:
            continue
        while row < len(edges) and edges[row] <= query_s[i]:
            dt = edges[row] - t
            ea, eg = math.exp(-dt / rc), math.exp(-dt / tau)
            rest = r * power
            g = 0.5 * rest + mix * (a - rest) * ea + (g - 0.5 * rest - mix * (a - rest)) * eg
            a = rest + (a - rest) * ea
            t, power = edges[row], powers[row]
            row += 1
        dt = query_s[i] - t
        ea, eg = math.exp(-dt / rc), math.exp(-dt / tau)
        rest = r * power
        gas[i] = 0.5 * rest + mix * (a - rest) * ea + (g - 0.5 * rest - mix * (a - rest)) * eg
        theta[i] = rest + (a - rest) * ea
    return theta, gas


def find_edges(pulses: np.ndarray, pixel: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the times at which the absorbed power of a pixel changes, and the power from then on, W."""
    own = np.asarray(pulses, float).reshape(-1, 4)
    own = own[own[:, 3].astype(int) == pixel]
    own = own[np.argsort(own[:, 0], kind="stable")]
    edges = np.empty(2 * len(own))
    powers = np.zeros(2 * len(own))
    edges[0::2], edges[1::2] = own[:, 0], own[:, 0] + own[:, 1]
    powers[0::2] = ABSORBED * own[:, 2]
    return edges, powers
