"""Memories of a term against SciPy's integrator, which shares no code with them."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from optodrive.lab.discovery import OdeModel, Parameter, Record
from optodrive.lab.discovery.fitting import Point, Simulation, Terms
from optodrive.lab.discovery.forms import POWER
from optodrive.lab.discovery.memory import DAHL, DELAY, FOLLOWER, LAG, OSCILLATION, SLIP, START_DAMPING, remember

T_S = 0.05 * np.arange(400)
SCALE = 0.3
MODEL = OdeModel(
    states=("x",),
    inputs=("u",),
    outputs=("y",),
    parameters={"loss": Parameter(1.0, 0.1, 10.0)},
    rhs=lambda t, s, u, p: [u[0] - p["loss"] * s[0]],
    output=lambda s, u, p: [s[0]],
    initial=lambda first, p: [0.5],
)


def drive(time):
    return np.sin(2.0 * time) + 0.5 * np.sin(0.7 * time)


def rate_of_memory(kind, z, slope, memory):
    if kind in (LAG, FOLLOWER):
        return (z - memory) / SCALE
    if kind == DAHL:
        return (slope - abs(slope) * memory) / SCALE
    return slope / SCALE if abs(memory) < 1.0 or slope * memory < 0.0 else 0.0


@pytest.mark.parametrize("kind", [LAG, FOLLOWER, DAHL, SLIP])
def test_a_memory_along_a_variable(kind):
    def rate(time, memory):
        slope = (drive(time + 1e-6) - drive(time - 1e-6)) / 2e-6
        return [rate_of_memory(kind, drive(time), slope, memory[0])]

    start = 0.0 if kind in (DAHL, SLIP) else drive(0.0)
    expected = solve_ivp(rate, (0.0, T_S[-1]), [start], t_eval=T_S, max_step=2e-3).y[0]
    found = remember(kind, SCALE, T_S, drive(T_S)) + (drive(T_S) if kind == FOLLOWER else 0.0)
    assert found == pytest.approx(expected, abs=0.02)


@pytest.mark.parametrize("kind", [LAG, FOLLOWER, DAHL, SLIP, DELAY])
def test_a_term_with_memory_of_a_state_in_free_run(kind):
    """Expected from an integrator of its own; of the delay by small steps with an index."""
    fine = np.arange(0.0, T_S[-1] + 5e-4, 1e-3)
    x, memory, expected = 0.5, 0.0 if kind in (DAHL, SLIP) else 0.5, []
    for k, time in enumerate(fine):
        expected.append(x)
        value = expected[max(k - round(SCALE / 1e-3), 0)] if kind == DELAY else memory
        past = value - x if kind in (FOLLOWER, DELAY) else value
        slope = drive(time) - x - 0.8 * past
        memory = memory + 1e-3 * rate_of_memory(kind, x, slope, memory) if kind != DELAY else memory
        memory = min(max(memory, -1.0), 1.0) if kind in (DAHL, SLIP) else memory
        x += 1e-3 * slope
    terms = Terms(
        np.array([[0, POWER, 0, -1, kind]]),
        np.array([[-0.8, 1.0, 0.0, SCALE]]),
        np.ones((1, 4), dtype=bool),
        np.full((1, 4), -np.inf),
        np.full((1, 4), np.inf),
    )
    simulation = Simulation(MODEL, h_max=0.01, hold=2)
    record = Record(T_S, drive(T_S), np.zeros(len(T_S)))
    found, states = simulation.run(record, Point(np.array([1.0]), terms))
    assert found[:, 0] == pytest.approx(np.array(expected)[::50], abs=3e-3)
    assert states.shape == (len(T_S), 2)


def test_an_oscillation_along_a_variable_and_in_free_run():
    def rate(time, state):
        x, m, v = state
        pull = (x - m) / SCALE**2 - 2.0 * START_DAMPING * v / SCALE
        return [drive(time) - x, v, pull]

    x, m, _ = solve_ivp(rate, (0.0, T_S[-1]), [0.5, 0.5, 0.0], t_eval=T_S, rtol=1e-8, atol=1e-10).y
    # Along the samples the variable is taken as linear between them.
    assert remember(OSCILLATION, SCALE, T_S, x) == pytest.approx(m - x, abs=0.01)
    terms = Terms(
        np.array([[1, POWER, 0, -1, OSCILLATION]]),
        np.array([[0.7, 1.0, START_DAMPING, SCALE]]),
        np.ones((1, 4), dtype=bool),
        np.full((1, 4), -np.inf),
        np.full((1, 4), np.inf),
    )
    simulation = Simulation(MODEL, h_max=0.01, hold=2)
    record = Record(T_S, drive(T_S), np.zeros(len(T_S)))
    found, states = simulation.run(record, Point(np.array([1.0]), terms))
    assert found[:, 0] == pytest.approx(x + 0.7 * (m - x), abs=1e-3)
    assert states.shape == (len(T_S), 3)


def test_a_delay_of_an_input_is_smooth_between_samples():
    terms = Terms(
        np.array([[1, POWER, 1, -1, DELAY]]),
        np.array([[1.0, 1.0, 0.0, 0.12]]),
        np.ones((1, 4), dtype=bool),
        np.full((1, 4), -np.inf),
        np.full((1, 4), np.inf),
    )
    record = Record(T_S, drive(T_S), np.zeros(len(T_S)))
    for hold, tolerance in ((0, 5e-3), (2, 1e-4)):  # between samples always a line or a spline: smooth in the delay
        late = drive(np.maximum(T_S - 0.12, 0.0))
        simulation = Simulation(MODEL, h_max=0.01, hold=hold)
        point = Point(np.array([1.0]), terms)
        plain = simulation.run(record, Point(np.array([1.0]), Terms.none()))[0][:, 0]
        assert simulation.run(record, point)[0][:, 0] - plain == pytest.approx(late - drive(T_S), abs=tolerance)
