"""The two equations of the nominal pixel, integrated by solve_ivp, independent of the package."""

import numpy as np
from scipy.integrate import solve_ivp


def height_um(pixel, pulses, t_s):
    """Return the displacement at t_s [m], µm, under pulses [n, 3] (start, width, power) in order, from cold."""
    edges_s = [0.0, *np.concatenate([pulses[:, :1], pulses[:, :1] + pulses[:, 1:2]], axis=1).ravel(), t_s[-1] + 1e-3]
    power_w = [0.0, *np.column_stack([pulses[:, 2], np.zeros(len(pulses))]).ravel()]
    state, height = np.zeros(2), np.zeros(len(t_s))
    for begin_s, end_s, light_w in zip(edges_s[:-1], edges_s[1:], power_w, strict=True):
        if end_s <= begin_s:
            continue

        def slope(_, y, light_w=light_w):
            heating = (pixel.epsilon * light_w - y[0] / pixel.r_k_per_w) / pixel.c_j_per_k
            return [heating, (y[0] / 2 - y[1]) / pixel.tau_g_s]

        inside = (t_s >= begin_s) & (t_s < end_s)
        run = solve_ivp(slope, (begin_s, end_s), state, t_eval=[*t_s[inside], end_s], rtol=1e-7, atol=1e-7)
        height[inside], state = run.y[1][:-1], run.y[:, -1]
    return 1e6 * pixel.kappa_m_per_k * height
