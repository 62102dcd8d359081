"""Systems simulated by SciPy's adaptive integrators with events, for discoveries, and simulations that lack a term."""

import numpy as np
from scipy.integrate import solve_ivp

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


def tanks_model():
    """Return two tanks in cascade whose outflow is proportional to the level: level of the lower one from the pump."""
    return OdeModel(
        states=("upper", "lower"),
        inputs=("pump",),
        outputs=("level",),
        parameters={
            "k1": Parameter(0.05, 1e-3, 1.0),
            "k2": Parameter(0.05, 1e-3, 1.0),
            "k3": Parameter(0.05, 1e-3, 1.0),
            "upper0": Parameter(5.0, 0.0, 20.0),
        },
        rhs=lambda t, x, u, p: [p["k3"] * u[0] - p["k1"] * x[0], p["k1"] * x[0] - p["k2"] * x[1]],
        output=lambda x, u, p: [x[1]],
        initial=lambda first, p: [p["upper0"], first[0, 0]],
    )


def tanks_record(seed, noise=0.02, count=1024, dt_s=4.0, overflow_at=10.0):
    """Return two tanks with Torricelli's outflow, of which the upper one overflows into the lower one."""
    rng = np.random.default_rng(seed)
    t = dt_s * np.arange(count)
    _, samples = smooth_input(rng, t, 0.012, 1.0)
    pump = np.clip(3.2 + 1.6 * samples, 0.0, None)

    def rate(time, y):
        drive = np.interp(time, t, pump)
        upper, lower = max(y[0], 0.0), max(y[1], 0.0)
        spill = 0.3 * max(upper - overflow_at, 0.0)
        out1, out2 = 0.085 * np.sqrt(upper), 0.08 * np.sqrt(lower)
        return [0.065 * drive - out1 - spill, out1 + 0.5 * spill - out2]

    solution = solve_ivp(rate, (0.0, t[-1]), [6.0, 5.0], t_eval=t, rtol=1e-7, atol=1e-9, max_step=dt_s)
    return Record(t, pump, solution.y[1] + noise * rng.standard_normal(count))
