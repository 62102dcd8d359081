"""The compiled pixel with terms against SciPy's solver with independent right-hand sides."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from optodrive.device.servo import Servo, simulate_servo
from optodrive.physics.pixel import Pixel
from optodrive.physics.pixel_ode import ActiveTerms, PixelExperiment, simulate_signals
from optodrive.physics.terms import discover_terms

PIXEL = Pixel(184.0, 126e-6, 0.66, 3e-3, 4e-6, 2.3e-4)
PULSES = np.array([[0.02, 0.05, 2.0, 0.0], [0.1, 0.01, 2.45, 0.0], [0.13, 0.03, 1.5, 1.0]])
T_S = np.linspace(1e-3, 0.3, 400)
AMBIENT_K = 293.15
SIGMA = 5.670374e-8


def power(t, pixel=0):
    return sum(p for start, width, p, target in PULSES if target == pixel and start <= t < start + width)


def since(t):
    return next((t - start for start, width, _, _ in PULSES if start <= t < start + width), 0.0)


def integrate(rates, count):
    """Integrate the states [count, m] at T_S, from edge to edge."""
    edges = np.unique(np.concatenate([[0.0, T_S[-1]], PULSES[:, 0], PULSES[:, 0] + PULSES[:, 1]]))
    y, out = np.zeros(count), np.zeros((count, len(T_S)))
    for begin, end in pairwise(edges):
        inside = (begin < T_S) & (end >= T_S)
        times = np.append(T_S[inside], end)

        def bounded_rates(t, y, begin=begin, end=end):
            return rates(min(max(t, begin + 1e-12), end - 1e-12), y)

        solved = solve_ivp(
            bounded_rates, (begin, end), y, t_eval=np.unique(times), rtol=1e-10, atol=1e-12, method="DOP853"
        )
        out[:, inside] = solved.y[:, : inside.sum()]
        y = solved.y[:, -1]
    return out


def gas(theta, wall, gamma):
    return (0.5 * (theta + wall) - gamma) / PIXEL.tau_g_s


def simulate(terms, late_s=(0.0, 0.0, 0.0), **scene):
    return simulate_signals(
        PixelExperiment(PULSES, 0, AMBIENT_K, (T_S, T_S, T_S), **scene), PIXEL, ActiveTerms.from_values(terms), late_s
    )


def nominal(t, y, light_w=None, r=PIXEL.r_k_per_w, c=PIXEL.c_j_per_k, leaving=0.0, wall=0.0):
    light_w = power(t) if light_w is None else light_w
    return [(PIXEL.epsilon * light_w - (y[0] - wall) / r - leaving) / c, gas(y[0], wall, y[1])]


def with_capacity(t, y):
    return nominal(t, y, c=PIXEL.c_j_per_k * (1 + 2e-3 * y[0]))


def with_conductivity(t, y):
    return nominal(t, y, r=PIXEL.r_k_per_w * ((AMBIENT_K + y[0] / 2) / AMBIENT_K) ** 0.7)


def with_radiation(t, y):
    return nominal(t, y, leaving=5e-6 * SIGMA * ((AMBIENT_K + y[0]) ** 4 - AMBIENT_K**4))


def with_wall(t, y):
    flow = (y[0] - y[2]) / PIXEL.r_k_per_w
    return [*nominal(t, y, wall=y[2]), (flow - y[2] / 8.0) / 0.05]


def with_panel(t, y):
    panel_rate = (0.6 * (power(t) + power(t, 1)) - y[2] / 20.0) / 0.05
    return [*nominal(t, y, wall=y[2]), panel_rate]


def with_wall_and_conductivity(t, y):
    r = PIXEL.r_k_per_w * ((AMBIENT_K + (y[0] + y[2]) / 2) / AMBIENT_K) ** 0.5
    return [*nominal(t, y, r=r, wall=y[2]), ((y[0] - y[2]) / r - y[2] / 8.0) / 0.05]


def membrane_height_m(gas_k):
    """Solve for the height at which plate, cap and atmosphere balance a gas of 0.35 of the absorber's rise."""
    e, nu, h, r = 50e3, 0.49, 0.25e-3, 1.5e-3
    relative = 0.7 * gas_k / AMBIENT_K

    def excess_pa(z_m):
        held_pa = 16 * e * h**3 * z_m / (3 * (1 - nu**2) * r**4) + 8 * e * h * z_m**3 / (3 * (1 - nu) * r**4)
        return 101_325 * ((1 + relative) / (1 + 0.5 * np.pi * r**2 * z_m / 7.8e-9) - 1) - held_pa

    return brentq(excess_pa, 0.0, 5e-3, xtol=1e-15) if relative > 0 else 0.0


def with_neighbour(t, y):
    beside = (PIXEL.epsilon * power(t, 1) - y[2] / PIXEL.r_k_per_w) / PIXEL.c_j_per_k
    return [*nominal(t, y, wall=y[3]), beside, (0.05 * y[2] - y[3]) / 0.02]


def with_turn_on(t, y):
    return nominal(t, y, light_w=power(t) * (1 - np.exp(-since(t) / 5e-4)))


def with_laser_lag(t, y):
    commanded_w, on_target = power(t) + power(t, 1), t < PULSES[2, 0]
    return [*nominal(t, y, light_w=y[2] if on_target else 0.0), (commanded_w - y[2]) / 6e-4]


def with_droop(t, y):
    commanded = power(t) + power(t, 1)
    return [
        *nominal(t, y, light_w=power(t) * (1 - 0.05 * (y[2] + y[3]))),
        (commanded / 2.45 - y[2]) / 0.03,
        (commanded / 2.45 - y[3]) / 0.12,
    ]


def with_miss(t, y):
    return [*nominal(t, y, light_w=0.8 * power(t), wall=y[2]), (5.0 * 0.2 * power(t) - y[2]) / 0.5]


def with_leak(t, y):
    return [*nominal(t, y), 3.0 * (y[1] - y[2])]


def with_creep(t, y):
    return [*nominal(t, y), (y[1] - y[2]) / 0.0125, (y[1] - y[3]) / 0.05, (y[1] - y[4]) / 0.2]


def with_lag(t, y):
    return [*nominal(t, y), (y[0] - y[2]) / 1e-3]


def plain(y):
    return y[0], PIXEL.kappa_m_per_k * y[1], PIXEL.phi_n_per_k * y[1]


CASES = {
    "none": ({}, nominal, 2, plain),
    "heat_capacity": ({"heat_capacity": {"slope": 2e-3}}, with_capacity, 2, plain),
    "bridge_conductivity": ({"bridge_conductivity": {"exponent": 0.7}}, with_conductivity, 2, plain),
    "radiation": ({"radiation": {"emitting_area": 5e-6}}, with_radiation, 2, plain),
    "wall_heating": ({"wall_heating": {"resistance": 8.0, "capacity": 0.05}}, with_wall, 3, plain),
    "panel_heating": ({"panel_heating": {"resistance": 20.0, "capacity": 0.05, "share": 0.6}}, with_panel, 3, plain),
    "wall_heating+bridge_conductivity": (
        {"wall_heating": {"resistance": 8.0, "capacity": 0.05}, "bridge_conductivity": {"exponent": 0.5}},
        with_wall_and_conductivity,
        3,
        plain,
    ),
    "gas_membrane": (
        {"gas_membrane": {"share": 0.35, "volume": 7.8e-9}},
        nominal,
        2,
        lambda y: (y[0], np.array([membrane_height_m(gas_k) for gas_k in y[1]]), PIXEL.phi_n_per_k * y[1]),
    ),
    "force_area": (
        {"force_area": {"area": 1e-6, "share": 0.35}},
        nominal,
        2,
        lambda y: (y[0], PIXEL.kappa_m_per_k * y[1], 1e-6 * 101_325 * 0.7 * y[1] / AMBIENT_K),
    ),
    "neighbour_crosstalk": ({"neighbour_crosstalk": {"share": 0.05, "lag": 0.02}}, with_neighbour, 4, plain),
    "laser_turn_on": ({"laser_turn_on": {"time": 5e-4}}, with_turn_on, 2, plain),
    "laser_lag": ({"laser_lag": {"time": 6e-4}}, with_laser_lag, 3, plain),
    "laser_droop": ({"laser_droop": {"share": 0.1, "time": 0.03, "spread": 4.0}}, with_droop, 4, plain),
    "beam_misalignment": (
        {"beam_misalignment": {"share": 0.2, "pixel": 0.0, "resistance": 5.0, "time": 0.5}},
        with_miss,
        3,
        plain,
    ),
    "gas_leak": (
        {"gas_leak": {"rate": 3.0}},
        with_leak,
        3,
        lambda y: (y[0], PIXEL.kappa_m_per_k * (y[1] - y[2]), PIXEL.phi_n_per_k * (y[1] - y[2])),
    ),
    "membrane_creep": (
        {"membrane_creep": {"share": 0.2, "time": 0.05, "spread": 4.0}},
        with_creep,
        5,
        lambda y: (y[0], PIXEL.kappa_m_per_k * (y[1] + 0.2 / 3 * (y[2] + y[3] + y[4])), PIXEL.phi_n_per_k * y[1]),
    ),
    "sensor_lag": (
        {"sensor_lag": {"time": 1e-3, "delay_share": 0.0}},
        with_lag,
        3,
        lambda y: (y[2], PIXEL.kappa_m_per_k * y[1], PIXEL.phi_n_per_k * y[1]),
    ),
    "membrane_stiffening": (
        {"membrane_stiffening": {"curvature": 2e-3, "order": 2.0}},
        nominal,
        2,
        lambda y: (
            y[0],
            PIXEL.kappa_m_per_k * y[1] / np.sqrt(1 + (2e-3 * y[1]) ** 2),
            PIXEL.phi_n_per_k * y[1],
        ),
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_agrees_with_scipy(name):
    terms, rates, count, outputs = CASES[name]
    expected = outputs(integrate(rates, count))
    for ours, theirs in zip(simulate(terms), expected, strict=True):
        assert np.abs(ours - theirs).max() < 2e-5 * np.abs(theirs).max()


@pytest.mark.parametrize("bridge", [(184.0, 126e-6), (87.5, 101e-6), (20.0, 100e-6)], ids=["narrow", "wide", "wider"])
def test_an_absorber_that_is_faster_than_the_gas(bridge):
    """A step that is right for the gas of Text S1 is too long for an absorber on wide bridges."""
    pixel = Pixel(*bridge, 0.66, 64e-3, 4e-6, 2.3e-4)
    experiment = PixelExperiment(PULSES, 0, AMBIENT_K, (T_S, T_S, T_S))
    found_k = simulate_signals(experiment, pixel, ActiveTerms.from_values({}))[0]
    lag_s, exact_k = bridge[0] * bridge[1], np.zeros(len(T_S))
    for start_s, width_s, power_w, target in PULSES:
        for edge_s, sign in ((start_s, 1.0), (start_s + width_s, -1.0)):
            final_k = sign * power_w * pixel.epsilon * bridge[0] * (target == 0)
            exact_k -= final_k * np.expm1(-np.clip(T_S - edge_s, 0.0, None) / lag_s)
    assert np.abs(found_k - exact_k).max() < 1e-4 * exact_k.max()


def test_every_term_with_kernels_is_checked_here_or_below():
    below = {"sensor_scale", "ambient_drift", "power_nonlinearity", "absorber_ageing"}
    hooked = {key for key, term in discover_terms().items() if any(term.kernels)}
    assert hooked == {key for name in CASES for key in CASES[name][0]} | below


def test_what_only_scales_or_shifts():
    rise_k, height_m, force_n = simulate({})
    shown_k = simulate({"sensor_scale": {"gain": 1.05, "offset": 2.0}})[0]
    assert shown_k == pytest.approx(1.05 * rise_k + 2.0)
    drift = {"ambient_drift": {"offset": 0.5, "ramp": 1.0, "bend": 2.0, "rate": 3.0}}
    shown_k = simulate(drift, session_time=0.5)[0]
    assert shown_k == pytest.approx(rise_k + 0.5 + 0.5 + 2.0 * (1.5 * 0.25 - 0.5) + 3.0 * T_S)
    missed = simulate({"beam_misalignment": {"share": 0.2, "pixel": 0.0, "resistance": 1e-9, "time": 0.5}})
    for ours, theirs in zip(missed, (rise_k, height_m, force_n), strict=True):
        assert ours == pytest.approx(0.8 * theirs)
    assert simulate({"beam_misalignment": {"share": 0.2, "pixel": 3.0, "resistance": 5.0, "time": 0.5}})[
        0
    ] == pytest.approx(rise_k)


def test_the_power_curve_keeps_full_power():
    distorted = {"power_nonlinearity": {"threshold": 0.245, "curvature": 0.2}}
    for watts in (2.45, 1.2, 0.2):
        pulses = np.array([[0.0, 0.05, watts, 0.0]])
        scene = PixelExperiment(pulses, 0, AMBIENT_K, (T_S, T_S, T_S))
        rise_k = simulate_signals(scene, PIXEL, ActiveTerms.from_values({}))[0].max()
        ours_k = simulate_signals(scene, PIXEL, ActiveTerms.from_values(distorted))[0].max()
        left = max(0.0, (watts / 2.45 - 0.1) / 0.9)
        assert ours_k == pytest.approx(rise_k * left * (1 + 0.2 * (1 - left)) / (watts / 2.45))


def test_ageing_counts_the_dose_before_and_within_a_run():
    aged = {"absorber_ageing": {"share": 0.1, "time_share": 0.0, "step_share": 0.0, "step_at": 0.0}}
    energy_j = float((PULSES[:2, 1] * PULSES[:2, 2]).sum())
    fresh, old = simulate(aged)[0], simulate(aged, dose_before=1.0)[0]
    assert fresh == pytest.approx(simulate({})[0])
    assert old == pytest.approx(0.9 * fresh)
    within = simulate(aged, dose_per_j=1.0 / energy_j)[0]
    assert np.all(within <= fresh)
    assert within.max() > old.max()


def test_a_late_clock_shows_what_was():
    early, late = simulate({}), simulate({}, (2e-3, 2e-3, 2e-3))
    for before, after in zip(early, late, strict=True):
        shifted = np.interp(T_S - 2e-3, T_S, before)
        assert np.abs(after - shifted).max() < 0.02 * np.abs(before).max()


def test_a_servo_against_its_closed_form():
    servo = Servo(frequency=500.0, damping=0.6, delay=2e-4, slew=1e5)
    t_s = np.linspace(1e-4, 0.02, 300)
    ours = simulate_servo(np.array([0.0, 1e-3]), np.array([0.0, 0.1]), t_s, servo)
    omega, zeta = 2 * np.pi * 500.0, 0.6
    ringing, after = omega * np.sqrt(1 - zeta**2), np.maximum(0.0, t_s - 1.2e-3)
    expected = 0.1 * (
        1
        - np.exp(-zeta * omega * after)
        * (np.cos(ringing * after) + zeta / np.sqrt(1 - zeta**2) * np.sin(ringing * after))
    )
    assert np.abs(ours - expected).max() < 2e-3 * 0.1
    assert simulate_servo(np.array([0.0, 1e-3]), np.array([0.0, 0.1]), t_s, None)[[0, -1]].tolist() == [0.0, 0.1]
