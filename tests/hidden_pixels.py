"""Recordings of hidden pixels that remember: hysteresis, dead travel, creep, delay, ringing, second nodes.

Integrated in small steps by code of its own; only the types of a recording are the package's.
"""

import numpy as np

from optodrive.core.types.measurements import Measurement, Run, Signal

STEP_S, RATE_HZ, AMBIENT_K = 2e-5, 2000.0, 294.0
ABSORBED = 0.66
GROUPS = {
    "short": [(0.02, 0.006, 2.4)],
    "weak": [(0.02, 0.06, 0.8)],
    "middle": [(0.02, 0.05, 1.6)],
    "strong": [(0.02, 0.06, 2.4)],
    "falling": [(0.02, 0.05, 2.4), (0.1, 0.03, 1.5), (0.16, 0.02, 0.9), (0.21, 0.01, 0.5)],
    "train": [(0.02 + 0.05 * k, 0.02, 2.4) for k in range(8)],
}


def heat(pixel, pulses, count, node=0.0, node_s=0.05, behind=0.0):
    """Return absorber and gas [count] in small steps; a node of the gas, or behind the absorber, takes heat."""
    light = np.zeros(count)
    for start_s, width_s, power_w in pulses:
        # The share of a step in which the gate is open: edges lie anywhere.
        left, right = start_s / STEP_S, (start_s + width_s) / STEP_S
        light += power_w * np.clip(np.minimum(np.arange(count) + 1, right) - np.maximum(np.arange(count), left), 0, 1)
    absorber, gas, far, a, g, m = np.zeros(count), np.zeros(count), 0.0, 0.0, 0.0, 0.0
    for k in range(count):
        absorber[k], gas[k] = a, g
        flow = ABSORBED * light[k] - a / pixel["R"] - behind * (a - m) / pixel["R"]
        a_mid = a + 0.5 * STEP_S * flow / pixel["C"]
        rate = (0.5 * a_mid - g) / pixel["tau_g"] - node * (g - far) / pixel["tau_g"]
        a += STEP_S * flow / pixel["C"]
        far += STEP_S * (g - far) / node_s
        m += STEP_S * (a_mid - m) / node_s
        g += STEP_S * rate
    return absorber, gas


def slip(gas, travel):
    """Return the force of an element that slips at ±1, after a way `travel` of the gas."""
    out, h = np.zeros(len(gas)), 0.0
    for k in range(1, len(gas)):
        h = min(max(h + (gas[k] - gas[k - 1]) / travel, -1.0), 1.0)
        out[k] = h
    return out


def bouc_wen(gas, travel, order=1.0, beta=1.0, gamma=0.0):
    """Return the hysteretic force, of ±1 at most; Dahl's with the defaults."""
    out, h = np.zeros(len(gas)), 0.0
    for k in range(1, len(gas)):
        way = (gas[k] - gas[k - 1]) / travel
        h += way - (beta * abs(way) * h + gamma * way * abs(h)) * abs(h) ** (order - 1.0)
        out[k] = h
    return out


def creep(gas, tau_s):
    """Return what follows the gas with a time constant."""
    out, m = np.zeros(len(gas)), 0.0
    for k in range(len(gas)):
        out[k] = m
        m += STEP_S * (gas[k] - m) / tau_s
    return out


def ring(gas, hertz, damping):
    """Return a mass that the gas pulls by a spring."""
    omega, m, v, out = 2.0 * np.pi * hertz, 0.0, 0.0, np.zeros(len(gas))
    for k in range(len(gas)):
        out[k] = m
        v += STEP_S * (omega**2 * (gas[k] - m) - 2.0 * damping * omega * v)  # the rate first: energy then stays
        m += STEP_S * v
    return out


def late(gas, delay_s):
    """Return the gas as it was before a delay."""
    at = np.arange(len(gas)) - delay_s / STEP_S
    return np.interp(at, np.arange(len(gas)), gas)


HIDDEN = {
    "Dahl": ("hysteresis", {}, lambda g: g - 6.0 * bouc_wen(g, 8.0)),
    "Dahl, short": ("hysteresis", {}, lambda g: g - 4.0 * bouc_wen(g, 3.0)),
    "Bouc-Wen": ("hysteresis", {}, lambda g: g - 6.0 * bouc_wen(g, 8.0, 1.0, 0.5, 0.5)),
    "Bouc-Wen, sharp": ("hysteresis", {}, lambda g: g - 5.0 * bouc_wen(g, 6.0, 2.0)),
    "dead travel": ("hysteresis", {}, lambda g: g - 3.0 * slip(g, 3.0)),
    "dead travel, long": ("hysteresis", {}, lambda g: g - 6.0 * slip(g, 6.0)),
    "creep": ("creep", {}, lambda g: g + 0.12 * creep(g, 0.06)),
    "creep, fast": ("creep", {}, lambda g: g + 0.2 * creep(g, 0.025)),
    "delay": ("delay", {}, lambda g: late(g, 2.5e-3)),
    "second node of the gas": ("second node", {"node": 0.25, "node_s": 0.04}, lambda g: g),
    "ringing": ("oscillation", {}, lambda g: ring(g, 130.0, 0.06)),
    "ringing, fast": ("oscillation", {}, lambda g: ring(g, 260.0, 0.1)),
}
"""By name: class, further nodes of the heat, and what moves the membrane in place of the gas."""


def draw_recording(seed, name=""):
    """Return the recording of a random pixel that hides an effect of random size, or none."""
    rng = np.random.default_rng([23, seed])
    _, nodes, move = HIDDEN.get(name, ("", {}, lambda g: g))
    pixel = {"R": 180.0 * rng.uniform(0.85, 1.15), "C": 1e-4 * rng.uniform(0.85, 1.2)}
    pixel |= {"tau_g": 3e-3 * rng.uniform(0.8, 1.3), "kappa": 4e-6 * rng.uniform(0.8, 1.2), "phi": 2.3e-4}
    size, runs = rng.uniform(0.5, 1.1), list[Run]()
    for group, pulses in GROUPS.items():
        until_s = pulses[-1][0] + pulses[-1][1] + 0.12
        t_s = np.arange(0.5 / RATE_HZ, until_s, 1.0 / RATE_HZ)
        fine_s = STEP_S * np.arange(round(until_s / STEP_S) + 1)
        for _ in range(3):
            power, late_s = np.exp(0.004 * rng.standard_normal()), 1e-5 * rng.standard_normal()
            real = [(start_s + late_s, width_s, power * power_w) for start_s, width_s, power_w in pulses]
            absorber, gas = heat(pixel, real, len(fine_s), **nodes)
            readings = {"absorber_temperature_K": (absorber + AMBIENT_K, 0.2)}
            readings["displacement_m"] = (pixel["kappa"] * (gas + size * (move(gas) - gas)), 1e-6)
            readings["force_N"] = (pixel["phi"] * gas, 1e-4)
            signals = {}
            for signal, (values, sigma) in readings.items():
                white, slow = rng.standard_normal((2, len(t_s)))
                for k in range(1, len(t_s)):
                    slow[k] = 0.95 * slow[k - 1] + 0.31 * slow[k]
                measured = np.interp(t_s, fine_s, values) + sigma * (white + 0.3 * slow)
                signals[signal] = Signal(0, t_s, measured)
            command = np.array([[*pulse, 0.0] for pulse in pulses])
            runs.append(Run(f"run{len(runs):03d}", AMBIENT_K, command, signals, {"group": group, "coupling": "DC"}))
    return Measurement(tuple(runs))
