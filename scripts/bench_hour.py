"""One hour of full frames on 1,511 nominal pixels, and a general integrator on the first pulses of it. One run."""

import numpy as np
from bench_plan import build_full_frame
from measuring import measure_median_cpu_s
from scipy.integrate import solve_ivp

from optodrive.physics.nominal_display import NominalThermalState
from optodrive.planning.pipeline import plan_sequence

HOUR_S = 3600.0
INTEGRATED_PULSES = 300
"""Pulses for the general integrator, whose time per pulse is constant."""


def build_hour_of_frames():
    """Return the display and the pulse columns of planned full frames at 50 µm, repeated for one hour."""
    display, *request = build_full_frame()
    planned = plan_sequence(display, *request)
    plan, frames = planned.plan, int(HOUR_S / planned.duration_s)
    start_s = np.tile(plan.start_s, frames) + np.repeat(np.arange(frames) * planned.duration_s, len(plan))
    return display, (np.tile(plan.pixel, frames), start_s, np.tile(plan.width_s, frames), np.tile(plan.power_w, frames))


def integrate_pulses(pixels, columns):
    """Integrate the pulses with solve_ivp from edge to edge. Return the temperature rises [2, p] at the end."""
    pixel, count = pixels.elements[0], len(pixels)

    def make_slope(index, light_w):
        def slope(_, state):
            theta, gas = state[:count], state[count:]
            heating = -theta / pixel.tau_s
            heating[index] += pixel.epsilon * light_w / pixel.c_j_per_k
            return np.concatenate([heating, (theta / 2 - gas) / pixel.tau_g_s])

        return slope

    state, now_s = np.zeros(2 * count), 0.0
    for index, start_s, width_s, power_w in zip(*columns, strict=True):
        for light_w, to_s in ((0.0, start_s), (power_w, start_s + width_s)):
            state = solve_ivp(make_slope(int(index), light_w), (now_s, to_s), state, rtol=1e-8, atol=1e-8).y[:, -1]
            now_s = to_s
    return state.reshape(2, count)


def measure():
    display, columns = build_hour_of_frames()
    count, first = len(columns[0]), [column[:INTEGRATED_PULSES] for column in columns]
    reference = NominalThermalState(display.pixels)
    reference.apply_pulses(*first)
    rises_k = np.transpose([reference.rises_k(pixel, first[1][-1] + first[2][-1]) for pixel in range(1511)])
    heat, states_k = NominalThermalState(display.pixels), []
    kernel_s = measure_median_cpu_s(lambda: heat.apply_pulses(*columns), 1)
    solver_s = measure_median_cpu_s(lambda: states_k.append(integrate_pulses(display.pixels, first)), 1)
    solver_ms, kernel_ms = 1e3 * solver_s / INTEGRATED_PULSES, 1e3 * kernel_s / count
    yield "pulses", count, "1"
    yield "nominal: one hour, with the peaks of every pulse", kernel_s, "s CPU"
    yield "nominal: times real time", HOUR_S / kernel_s, "×"
    yield "nominal: per pulse", kernel_ms, "ms"
    yield "nominal: per pulse by solve_ivp, rtol 1e-8", solver_ms, "ms"
    yield "nominal: time of solve_ivp over kernel", solver_ms / kernel_ms, "×"
    difference_k = np.abs(rises_k - states_k[0]).max()
    yield f"nominal: maximum difference from solve_ivp after {INTEGRATED_PULSES} pulses", difference_k, "K"
