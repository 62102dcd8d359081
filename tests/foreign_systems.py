"""Systems simulated by SciPy's adaptive integrators with events, for discoveries, and simulations that lack a term."""

import numpy as np
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

from optodrive.lab.discovery import OdeModel, Parameter, Record


def smooth_input(rng, t_s, bandwidth_hz, rms):
    """Return a random-phase multisine, as a function of time and as samples."""
    frequencies = np.arange(1, 40) / 39.0 * bandwidth_hz
    phases = rng.uniform(0.0, 2.0 * np.pi, len(frequencies))
    size = rms * np.sqrt(2.0 / len(frequencies))

    def u(t):
        return size * np.sum(np.cos(2.0 * np.pi * np.multiply.outer(t, frequencies) + phases), axis=-1)

    return u, u(t_s)


def motor_model():
    """Return a motor with viscous friction only: angle from voltage."""
    return OdeModel(
        states=("angle", "speed"),
        inputs=("voltage",),
        outputs=("angle_measured",),
        parameters={"gain": Parameter(30.0, 1.0, 1e3), "damping": Parameter(3.0, 0.01, 100.0)},
        rhs=lambda t, state, u, p: [state[1], p["gain"] * u[0] - p["damping"] * state[1]],
        output=lambda state, u, p: [state[0]],
        initial=lambda first, p: [first[0, 0], 0.0],
    )


def motor_record(seed, friction, noise=1e-3, count=2000, dt_s=0.005):
    """Return a motor with dry friction, which holds it while the drive is weaker."""
    rng = np.random.default_rng(seed)
    t = dt_s * np.arange(count)
    u, samples = smooth_input(rng, t, 3.0, 1.0)
    gain, damping = 50.0, 2.0
    angle, now, state, sign = np.zeros(count), 0.0, np.zeros(2), 0.0

    def rate(time, y):
        return [y[1], gain * u(time) - damping * y[1] - friction * sign]

    def stops(time, y):
        return y[1]

    def breaks_away(time, y):
        return abs(gain * u(time)) - friction - 1e-9

    stops.terminal = breaks_away.terminal = True
    while now < t[-1]:
        if sign == 0.0 and abs(gain * u(now)) <= friction:
            event, moving = breaks_away, False
        else:
            sign = sign or float(np.sign(gain * u(now)))
            event, moving = stops, True
            stops.direction = -sign
        later = t[(t > now)]
        solution = solve_ivp(
            rate if moving else (lambda time, y: [0.0, 0.0]),
            (now, t[-1]),
            state,
            events=event,
            t_eval=later,
            rtol=1e-8,
            atol=1e-10,
            max_step=0.01,
        )
        if len(later) and len(solution.t):
            angle[np.searchsorted(t, solution.t)] = solution.y[0]
        if solution.status != 1:
            break
        now, state = float(solution.t_events[0][0]), solution.y_events[0][0].copy()
        state[1] = 0.0
        sign = 0.0 if moving else float(np.sign(gain * u(now)))
        if moving and abs(gain * u(now)) > friction:
            sign = float(np.sign(gain * u(now)))
    return Record(t, samples, angle + noise * rng.standard_normal(count))


def pendulum_model():
    """Return a pendulum without an end stop: angle from torque."""
    return OdeModel(
        states=("angle", "speed"),
        inputs=("torque",),
        outputs=("angle_measured",),
        parameters={
            "gravity": Parameter(20.0, 1.0, 200.0),
            "damping": Parameter(0.5, 0.01, 20.0),
            "gain": Parameter(5.0, 0.1, 100.0),
        },
        rhs=lambda t, s, u, p: [s[1], p["gain"] * u[0] - p["gravity"] * np.sin(s[0]) - p["damping"] * s[1]],
        output=lambda s, u, p: [s[0]],
        initial=lambda first, p: [first[0, 0], 0.0],
    )


def pendulum_record(seed, stop_rad, noise=1e-3, count=3000, dt_s=0.01):
    """Return a pendulum that hits a rubber buffer on one side: events switch its spring and its damper on and off."""
    rng = np.random.default_rng(seed)
    t = dt_s * np.arange(count)
    u, samples = smooth_input(rng, t, 1.5, 0.4)
    angle, now, state, touches = np.zeros(count), 0.0, np.zeros(2), False

    def rate(time, y):
        push = 3000.0 * (y[0] - stop_rad) + 8.0 * y[1] if touches else 0.0
        return [y[1], 12.0 * u(time) - 30.0 * np.sin(y[0]) - 0.8 * y[1] - push]

    def crosses(time, y):
        return y[0] - stop_rad

    crosses.terminal = True
    while now < t[-1]:
        crosses.direction = -1.0 if touches else 1.0
        later = t[t > now]
        solution = solve_ivp(
            rate, (now, t[-1]), state, events=crosses, t_eval=later, rtol=1e-8, atol=1e-10, max_step=0.02
        )
        if len(later) and len(solution.t):
            angle[np.searchsorted(t, solution.t)] = solution.y[0]
        if solution.status != 1:
            break
        now, state = float(solution.t_events[0][0]), solution.y_events[0][0].copy()
        touches = not touches
    return Record(t, samples, angle + noise * rng.standard_normal(count))


def solve(rate, t, state, inputs=None):
    """Return the states [m, n] at times t, of rate(time, state, u) with inputs [m] that are linear between samples."""

    def total(time, y):
        return rate(time, y, 0.0 if inputs is None else np.interp(time, t, inputs))

    return solve_ivp(total, (t[0], t[-1]), state, "LSODA", t, rtol=1e-8, atol=1e-10, max_step=2.0 * (t[1] - t[0])).y.T


def measure(seed, t, values, noise, inputs=None):
    """Return a record of one output with noise."""
    noisy = values + noise * np.random.default_rng(seed).standard_normal(len(t))
    return Record(t, np.zeros((len(t), 0)) if inputs is None else inputs, noisy)


def oscillator_model(has_input=True):
    """Return a linear oscillator, driven by a force or not, that starts at rest."""
    gain = {"gain": Parameter(1.0, 0.1, 10.0)} if has_input else {}
    return OdeModel(
        states=("x", "v"),
        inputs=("force",) if has_input else (),
        outputs=("position",),
        parameters={"stiffness": Parameter(20.0, 1.0, 400.0), "damping": Parameter(0.3, 0.01, 20.0), **gain},
        rhs=(lambda t, s, u, p: [s[1], p["gain"] * u[0] - p["stiffness"] * s[0] - p["damping"] * s[1]])
        if has_input
        else (lambda t, s, u, p: [s[1], -p["stiffness"] * s[0] - p["damping"] * s[1]]),
        output=lambda s, u, p: [s[0]],
        initial=lambda first, p: [first[0, 0], 0.0],
    )


def first_order_model(state, signal, gain, loss, rest):
    """Return a store that an input fills and that empties in proportion to its level above rest."""
    return OdeModel(
        states=(state,),
        inputs=(signal,),
        outputs=("measured",),
        parameters={"gain": Parameter(*gain), "loss": Parameter(*loss)},
        rhs=lambda t, s, u, p: [p["gain"] * u[0] - p["loss"] * (s[0] - rest)],
        output=lambda s, u, p: [s[0]],
        initial=lambda first, p: [first[0, 0]],
    )


def decay(seed, start, drag=0.0, friction=0.0):
    """Return the free decay of an oscillator with quadratic drag or dry friction."""
    t = 0.02 * np.arange(900)
    states = solve(
        lambda _, y, u: [y[1], -25.0 * y[0] - 0.15 * y[1] - drag * y[1] * abs(y[1]) - friction * np.tanh(y[1] / 2e-3)],
        t,
        [start, 0.0],
    )
    return measure(seed, t, states[:, 0], 1e-3)


def heated_plate(seed, power):
    """Return a plate, K above its surroundings, that radiates; power [m] in steps of 2 s."""
    t = 2.0 * np.arange(len(power))

    def rate(_, y, u):
        return [0.02 * u - 0.004 * y[0] - 2.5e-13 * ((y[0] + 293.0) ** 4 - 293.0**4)]

    return measure(seed, t, solve(rate, t, [0.0], power)[:, 0], 0.05, power)


def draining_tank(seed, flow, start=1.0):
    """Return a tank that drains through an orifice; flow [m] in steps of 1 s."""
    t = 1.0 * np.arange(len(flow))
    levels = solve(lambda _, y, u: [0.05 * u - 0.09 * np.sqrt(max(y[0], 0.0))], t, [start], flow)
    return measure(seed, t, levels[:, 0], 2e-3, flow)


def driven(seed, force, cubic=0.0, friction=0.0):
    """Return an oscillator with a cubic spring, dry friction, or both under a force [m] in steps of 0.02 s."""
    t = 0.02 * np.arange(len(force))

    def rate(_, y, u):
        spring = 25.0 * y[0] + cubic * y[0] ** 3
        return [y[1], 2.0 * u - spring - 0.8 * y[1] - friction * np.tanh(y[1] / 2e-3)]

    return measure(seed, t, solve(rate, t, [0.0, 0.0], force)[:, 0], 1e-3, force)


def servo(seed, reference):
    """Return a motor with a dead zone of its drive under proportional control of its angle; its voltage is measured."""
    t, rng = 0.01 * np.arange(len(reference)), np.random.default_rng(seed)
    angle, voltages, state = np.zeros(len(t)), np.zeros(len(t)), np.zeros(2)
    for k in range(len(t)):
        angle[k] = state[0]
        voltages[k] = 2.0 * (reference[k] - state[0]) + 0.02 * rng.standard_normal()
        if k + 1 < len(t):
            drive = np.sign(voltages[k]) * max(abs(voltages[k]) - 0.5, 0.0)
            step = solve_ivp(lambda _, y, d=drive: [y[1], 40.0 * d - 6.0 * y[1]], (0.0, 0.01), state, rtol=1e-8)
            state = step.y[:, -1]
    return Record(t, voltages, angle + 1e-3 * rng.standard_normal(len(t)))


def coupled_tanks_model(is_start_known=True, is_complete=False):
    """Return two tanks in cascade with orifices: level of the lower one from the pump.

    is_start_known: of the upper tank; is_complete: with an overflow of the upper tank and a ceiling of the level
    """
    names = {"k1": 0.06, "k2": 0.06, "k3": 0.05}
    parameters = {name: Parameter(value, 1e-3, 1.0) for name, value in names.items()}
    if not is_start_known:
        parameters["upper0"] = Parameter(5.0, 0.0, 20.0)
    if is_complete:
        parameters["spill"] = Parameter(0.1, 1e-3, 10.0)
        parameters |= {name: Parameter(9.0, 3.0, 20.0) for name in ("brim", "ceiling")}

    def rates(t, x, u, p):
        out = p["k1"] * np.sqrt(max(x[0], 0.0))
        return [p["k3"] * u[0] - out, out - p["k2"] * np.sqrt(max(x[1], 0.0))]

    def complete_rates(t, x, u, p):
        out = p["k1"] * np.sqrt(max(x[0], 0.0))
        spill = p["spill"] * max(x[0] - p["brim"], 0.0)
        return [p["k3"] * u[0] - out - spill, out - p["k2"] * np.sqrt(max(x[1], 0.0))]

    return OdeModel(
        states=("upper", "lower"),
        inputs=("pump",),
        outputs=("level",),
        parameters=parameters,
        rhs=complete_rates if is_complete else rates,
        output=(lambda x, u, p: [min(x[1], p["ceiling"])]) if is_complete else (lambda x, u, p: [x[1]]),
        initial=(lambda first, p: [6.0, first[0, 0]])
        if is_start_known
        else (lambda first, p: [p["upper0"], first[0, 0]]),
    )


def coupled_tanks(seed, pump, ceiling=np.inf, lower=5.0):
    """Return the lower level of two tanks of which the upper one overflows at 10; pump [m] in steps of 4 s.

    ceiling: level above which the sensor reads no more; lower: level of the lower one at the start
    """
    t = 4.0 * np.arange(len(pump))

    def rate(_, y, u):
        upper, lower = max(y[0], 0.0), max(y[1], 0.0)
        out1 = 0.085 * np.sqrt(upper)
        return [0.065 * u - out1 - 0.3 * max(upper - 10.0, 0.0), out1 - 0.08 * np.sqrt(lower)]

    levels = solve(rate, t, [6.0, lower], pump)[:, 1]
    return measure(seed, t, np.minimum(levels, ceiling), 0.02, pump)


def random_pump(seed, count=1024):
    """Return a pump's voltage [m] in steps of 4 s that fills both tanks to their brims."""
    return np.clip(3.2 + 1.6 * _noise(seed, count, 1.0, 0.012, 4.0), 0.0, None)


def _steps(seed, count, length, low, high):
    return np.repeat(np.random.default_rng(seed).uniform(low, high, count), length)


def _noise(seed, count, rms, bandwidth_hz=1.2, dt_s=0.02):
    return smooth_input(np.random.default_rng(seed), dt_s * np.arange(count), bandwidth_hz, rms)[1]


def poor_excitation():
    """Return systems of poor excitation that lack one term: model, records, and records for judging alone.

    By name, with what is missing: kind of term, its place and its variable.
    """
    sine = np.sin(3.0 * 0.02 * np.arange(1000))
    plate = first_order_model("rise", "power", (0.02, 1e-3, 1.0), (0.01, 1e-4, 1.0), 0.0)
    tank = first_order_model("height", "flow", (0.05, 1e-3, 1.0), (0.05, 1e-3, 1.0), 0.0)
    ramp, servo_steps = np.linspace(0.5, 3.0, 700), _steps(6, 12, 80, -1.5, 1.5)
    pumps = np.concatenate([np.full(150, 3.0), np.linspace(3.0, 5.2, 400), np.full(150, 4.6)])
    free, forced = oscillator_model(False), oscillator_model()
    return {
        "decay, quadratic drag": (free, [decay(1, 1.0, drag=0.8)], [decay(2, 2.0, drag=0.8), decay(3, 0.4, drag=0.8)]),
        "decay, dry friction": (free, [decay(1, 1.0, friction=0.6)], [decay(2, 2.0, friction=0.6)]),
        "two decays, dry friction": (
            free,
            [decay(1, 1.0, friction=0.6), decay(4, 0.5, friction=0.6)],
            [decay(2, 2.0, friction=0.6)],
        ),
        "one step, radiation": (
            plate,
            [heated_plate(1, np.concatenate([np.zeros(10), np.full(290, 120.0)]))],
            [heated_plate(2, _steps(1, 10, 60, 0.0, 200.0))],
        ),
        "slow ramp, orifice": (tank, [draining_tank(1, ramp)], [draining_tank(2, _steps(2, 14, 50, 0.3, 4.0))]),
        "one amplitude, cubic spring": (
            forced,
            [driven(1, 4.0 * sine, cubic=40.0)],
            [driven(2, _noise(3, 1500, 6.0), cubic=40.0)],
        ),
        "one amplitude, dry friction": (
            forced,
            [driven(1, 4.0 * sine, friction=1.5)],
            [driven(2, _noise(4, 1500, 4.0), friction=1.5)],
        ),
        "closed loop, dead zone": (motor_model(), [servo(1, servo_steps)], [servo(2, _noise(5, 900, 1.5, dt_s=0.01))]),
        "slow pump, overflow": (
            coupled_tanks_model(),
            [coupled_tanks(1, pumps)],
            [coupled_tanks(2, _steps(7, 14, 50, 2.0, 5.5))],
        ),
    }


def scaled_records():
    """Return makers of the records of poor excitation, by name: record(seed, factor of start and inputs)."""
    sine, ramp = np.sin(3.0 * 0.02 * np.arange(1000)), np.linspace(0.5, 3.0, 700)
    pumps = np.concatenate([np.full(150, 3.0), np.linspace(3.0, 5.2, 400), np.full(150, 4.6)])
    step, dry = np.concatenate([np.zeros(10), np.full(290, 120.0)]), {"friction": 0.6}
    return {
        "decay, quadratic drag": [lambda seed, f: decay(seed, f, drag=0.8)],
        "decay, dry friction": [lambda seed, f: decay(seed, f, **dry)],
        "two decays, dry friction": [
            lambda seed, f: decay(seed, f, **dry),
            lambda seed, f: decay(seed + 3, 0.5 * f, **dry),
        ],
        "one step, radiation": [lambda seed, f: heated_plate(seed, f * step)],
        "slow ramp, orifice": [lambda seed, f: draining_tank(seed, f * ramp, f)],
        "one amplitude, cubic spring": [lambda seed, f: driven(seed, 4.0 * f * sine, cubic=40.0)],
        "one amplitude, dry friction": [lambda seed, f: driven(seed, 4.0 * f * sine, friction=1.5)],
        "closed loop, dead zone": [lambda seed, f: servo(seed, f * _steps(seed + 5, 12, 80, -1.5, 1.5))],
        "slow pump, overflow": [lambda seed, f: coupled_tanks(seed, f * pumps, lower=5.0 * f)],
    }


def _solve_delayed(rate, t, state, drive, delay):
    """Return the states [m, n] of rate(time, state, u) with an input, as a function of time, that arrives late."""
    late = drive(t - delay)
    spline = CubicSpline(t, late)
    return solve_ivp(lambda time, y: rate(time, y, spline(time)), (t[0], t[-1]), state, "RK45", t, rtol=1e-8).y.T


def _excite(seed, count, dt_s, bandwidth_hz, rms, offset=0.0):
    t = dt_s * np.arange(count)
    drive, _ = smooth_input(np.random.default_rng(seed), t, bandwidth_hz, rms)
    return t, (lambda time: offset + drive(time)), offset + drive(t)


def presliding(seed, rms, friction=3.0, distance=0.15, beta=1.0, gamma=0.0, order=1.0):
    """Return an oscillator of which a part slips, after Bouc and Wen; gamma of 0 and order of 1 is Dahl's friction."""
    t, force, samples = _excite(seed, 1500, 0.02, 1.5, rms)

    def rate(time, y):
        x, v, h = y
        slip = (v - beta * abs(v) * np.sign(h) * abs(h) ** order - gamma * v * abs(h) ** order) / distance
        return [v, force(time) - 25.0 * x - 0.4 * v - friction * h, slip]

    states = solve_ivp(rate, (0.0, t[-1]), [0.0] * 3, "RK45", t, rtol=1e-7, atol=1e-9, max_step=0.01).y.T
    return measure(seed + 1, t, states[:, 0], 1e-3, samples)


def relaxing_spring(seed, rms):
    """Return an oscillator with a second spring whose far end creeps after it (standard linear solid)."""
    t, force, samples = _excite(seed, 1500, 0.02, 1.5, rms)
    states = solve_ivp(
        lambda time, y: [y[1], force(time) - 25.0 * y[0] - 0.4 * y[1] - 15.0 * (y[0] - y[2]), (y[0] - y[2]) / 0.4],
        (0.0, t[-1]), [0.0] * 3, "RK45", t, rtol=1e-8,
    ).y.T  # fmt: skip
    return measure(seed + 1, t, states[:, 0], 1e-3, samples)


def creeping_actuator(seed, rms, hysteresis=0.0, creep=0.0):
    """Return an actuator of first order whose position has hysteresis of its voltage, or creeps on."""
    t, voltage, samples = _excite(seed, 1500, 0.02, 1.0, rms)
    slope = CubicSpline(t, samples).derivative()

    def rate(time, y):
        speed = float(slope(time))
        return [(2.0 * voltage(time) - y[0]) / 0.1, (speed - abs(speed) * y[1]) / 0.4, (y[0] - y[2]) / 3.0]

    states = solve_ivp(
        rate, (0.0, t[-1]), [2.0 * samples[0], 0.0, 2.0 * samples[0]], "RK45", t, rtol=1e-7, max_step=0.02
    )
    x, h, m = states.y
    return measure(seed + 1, t, x + hysteresis * h + creep * m, 2e-3, samples)


def two_nodes(seed, mean, rms, wall_s=40.0, conductance=0.03):
    """Return a plate that heats a wall behind it, K above the surroundings; samples every 2 s."""
    t, power, samples = _excite(seed, 1200, 2.0, 0.01, rms, mean)
    states = solve_ivp(
        lambda time, y: [
            0.02 * power(time) - 0.01 * y[0] - conductance * (y[0] - y[1]),
            (y[0] - y[1]) / wall_s,
        ],
        (0.0, t[-1]), [0.0, 0.0], "RK45", t, rtol=1e-8,
    ).y.T  # fmt: skip
    return measure(seed + 1, t, states[:, 0], 0.05, samples)


def late_input(seed, rms, delay, order=2):
    """Return an oscillator, or a plate of first order, whose drive arrives late."""
    if order == 2:
        t, force, samples = _excite(seed, 1500, 0.02, 1.5, rms)
        states = _solve_delayed(lambda _, y, u: [y[1], u - 25.0 * y[0] - 0.8 * y[1]], t, [0.0, 0.0], force, delay)
        return measure(seed + 1, t, states[:, 0], 1e-3, samples)
    t, power, samples = _excite(seed, 1200, 2.0, 0.01, rms, 100.0)
    states = _solve_delayed(lambda _, y, u: [0.02 * u - 0.02 * y[0]], t, [0.0], power, delay)
    return measure(seed + 1, t, states[:, 0], 0.05, samples)


def late_output(seed, rms, delay):
    """Return an oscillator whose position is shown late."""
    t, force, samples = _excite(seed, 1500, 0.02, 1.5, rms)
    states = solve_ivp(
        lambda time, y: [y[1], force(time) - 25.0 * y[0] - 0.8 * y[1]], (0.0, t[-1]), [0.0, 0.0], "RK45", t, rtol=1e-8
    ).y.T
    return measure(seed + 1, t, np.interp(t - delay, t, states[:, 0]), 1e-3, samples)


def with_memory():
    """Return systems that lack a term with one inner state.

    By name: kind of term, place, variable, model, records, and one of another size for judging alone.
    """
    forced = oscillator_model()
    plate = first_order_model("rise", "power", (0.02, 1e-3, 1.0), (0.01, 1e-4, 1.0), 0.0)
    stage = OdeModel(
        states=("x",),
        inputs=("voltage",),
        outputs=("position",),
        parameters={"gain": Parameter(1.0, 0.1, 10.0), "tau": Parameter(0.2, 0.01, 2.0)},
        rhs=lambda t, s, u, p: [(p["gain"] * u[0] - s[0]) / p["tau"]],
        output=lambda s, u, p: [s[0]],
        initial=lambda first, p: [first[0, 0]],
    )
    friction, spring = ("hysteresis", "dv/dt", "x"), ("second node", "dv/dt", "x")
    sizes = (6.0, 3.0, 4.0)

    def slip(seed, **numbers):
        return [presliding(seed + 10 * k, size, **numbers) for k, size in enumerate(sizes)]

    def build(make, seed, *further):
        return [make(seed + 10 * k, size, *further) for k, size in enumerate(sizes)]

    systems = {
        "Dahl": (friction, forced, slip(1)),
        "Dahl, short": (friction, forced, slip(2, distance=0.05, friction=2.0)),
        "Bouc-Wen, closed": (friction, forced, slip(3, beta=0.5, gamma=0.5, distance=0.2)),
        "Bouc-Wen, sharp": (friction, forced, slip(4, order=2.0, friction=4.0, distance=0.25)),
        "hysteresis of a voltage": (
            ("hysteresis", "position", "voltage"),
            stage,
            [creeping_actuator(5 + 10 * k, 0.3 * size, hysteresis=0.3) for k, size in enumerate(sizes)],
        ),
        "creep": (
            ("creep", "position", "x"),
            stage,
            [creeping_actuator(6 + 10 * k, 0.3 * size, creep=0.15) for k, size in enumerate(sizes)],
        ),
        "relaxing spring": (spring, forced, build(relaxing_spring, 7)),
        "wall": (
            ("second node", "drise/dt", "rise"),
            plate,
            [two_nodes(8 + 10 * k, 100.0, 10.0 * size) for k, size in enumerate(sizes)],
        ),
        "slow wall": (
            ("second node", "drise/dt", "rise"),
            plate,
            [two_nodes(9 + 10 * k, 100.0, 10.0 * size, 150.0, 0.01) for k, size in enumerate(sizes)],
        ),
        "late force": (("delay", "dv/dt", "force"), forced, build(late_input, 10, 0.09)),
        "late power": (
            ("delay", "drise/dt", "power"),
            plate,
            [late_input(11 + 10 * k, 10.0 * size, 13.0, 1) for k, size in enumerate(sizes)],
        ),
        "late position": (("delay", "position", "x"), forced, build(late_output, 12, 0.07)),
    }
    return {name: (*hidden, model, records[:2], records[2]) for name, (hidden, model, records) in systems.items()}


def compute_error(model, parameters, record):
    """Return the rms error of a model in free run, by an integrator that shares no code with the package."""
    inputs = record.inputs.T

    def rate(time, state):
        return model.rhs(time, state, [np.interp(time, record.t_s, each) for each in inputs], parameters)

    start, span = model.initial(record.outputs[:1], parameters), (record.t_s[0], record.t_s[-1])
    longest = 2.0 * float(np.diff(record.t_s).max())
    states = solve_ivp(rate, span, start, "LSODA", record.t_s, rtol=1e-7, atol=1e-9, max_step=longest).y
    predicted = [model.output(state, u, parameters)[0] for state, u in zip(states.T, record.inputs, strict=True)]
    return float(np.sqrt(np.nanmean((np.array(predicted) - record.outputs[:, 0]) ** 2)))
