"""Tables `[[discovered]]` of a parameter set: read or refused by name, and simulated as they say."""

import numpy as np
import pytest

from optodrive.core.errors import InputError
from optodrive.physics.discovered_term import KEY, KNOTS, UNITS, DiscoveredTerm, list_values
from optodrive.physics.parameters import load_parameters
from optodrive.physics.pixel import Pixel
from optodrive.physics.pixel_ode import ActiveTerms, PixelExperiment, simulate_signals

PIXEL = Pixel(184.0, 126e-6, 0.66, 4e-3, 4e-6, 2.3e-4)
T_S = np.arange(0.0, 0.3, 2e-4)
PULSES = [[0.01, 0.05, 1.5, 0], [0.1, 0.02, 0.8, 0]]
HEAD = 'format = "optodrive-parameters"\nversion = 1\nname = "own"\nbase = "calibrated"\nclaims = "a test"\n'


def term(where, depends_on, function, high=200.0, low=0.0, **more):
    values = [float(function(z)) for z in np.linspace(low, high, KNOTS)]
    unit = "W" if depends_on == "power" else UNITS[where]
    given = {"where": where, "depends_on": depends_on, "unit": unit, "formula": "f", "source": "here"}
    return DiscoveredTerm.model_validate(given | {"low": low, "high": high, "values": values} | more)


def simulate(*terms):
    scene = PixelExperiment(np.array(PULSES), 0, 293.15, (T_S, T_S, T_S))
    return simulate_signals(scene, PIXEL, ActiveTerms.from_values({KEY: list_values(terms)} if terms else {}))


def integrate(rate, outputs, h_s=1e-5):
    """Integrate rates of (absorber, gas, memory) by Euler's method with small steps: an independent reference."""
    state, rows = np.zeros(3), []
    for k in range(round(T_S[-1] / h_s) + 1):
        t_s = k * h_s
        pulse = next((p for p in PULSES if p[0] <= t_s < p[0] + p[1]), None)
        power_w, since_s = (0.0, 0.0) if pulse is None else (pulse[2], t_s - pulse[0])
        if k % round(2e-4 / h_s) == 0:
            rows.append(outputs(state))
        state = state + h_s * np.array(rate(state, power_w, since_s))
    return np.array(rows).T


def nominal(state, power_w, heat_w=0.0, light=1.0, capacity=1.0, gas=0.0, memory_s=0.05):
    absorber, gas_k, memory = state
    return [
        (PIXEL.epsilon * power_w * light - absorber / PIXEL.r_k_per_w + heat_w) / (PIXEL.c_j_per_k * capacity),
        (0.5 * absorber - gas_k) / PIXEL.tau_g_s + gas,
        (absorber - memory) / memory_s,
    ]


def plain(state):
    return state[0], PIXEL.kappa_m_per_k * state[1], PIXEL.phi_n_per_k * state[1]


CASES = {
    "heat flow": (
        [term("absorber", "absorber", lambda z: -2e-5 * z**2)],
        lambda y, p, s: nominal(y, p, heat_w=-2e-5 * y[0] ** 2),
        plain,
    ),
    "memory": (
        [term("absorber", "memory", lambda z: 1e-3 * z, memory_time_s=0.05)],
        lambda y, p, s: nominal(y, p, heat_w=1e-3 * y[2]),
        plain,
    ),
    "capacity": (
        [term("heat_capacity", "absorber", lambda z: -0.004 * z)],
        lambda y, p, s: nominal(y, p, capacity=1.0 / (1.0 - 0.004 * y[0])),
        plain,
    ),
    "light by temperature": (
        [term("light", "absorber", lambda z: -0.002 * z)],
        lambda y, p, s: nominal(y, p, light=1.0 - 0.002 * y[0]),
        plain,
    ),
    "light by time": (
        [term("light", "since_opening", lambda z: -4.0 * z, high=0.05)],
        lambda y, p, s: nominal(y, p, light=1.0 - 4.0 * s),
        plain,
    ),
    "light by power": (
        [term("light", "power", lambda z: -0.1 * z, high=2.0)],
        lambda y, p, s: nominal(y, p, light=0.9),
        plain,
    ),
    "gas": (
        [term("gas", "drive", lambda z: max(0.0, -60.0 * z), low=-50.0, high=50.0)],
        lambda y, p, s: nominal(y, p, gas=max(0.0, -60.0 * (0.5 * y[0] - y[1]))),
        plain,
    ),
    "membrane": (
        [term("displacement", "gas", lambda z: -1e-6 * z), term("force", "gas", lambda z: 1e-5 * z)],
        lambda y, p, s: nominal(y, p),
        lambda y: (y[0], 3e-6 * y[1], 2.4e-4 * y[1]),
    ),
}


@pytest.mark.parametrize("name", sorted(CASES))
def test_a_term_acts_where_its_table_says(name):
    terms, rate, outputs = CASES[name]
    for found, expected in zip(simulate(*terms), integrate(rate, outputs), strict=True):
        size = np.abs(expected).max()
        assert np.abs(found - expected[: len(found)]).max() < 2e-3 * size
    assert any(np.abs(a - b).max() > 0.02 * np.abs(b).max() for a, b in zip(simulate(*terms), simulate(), strict=True))


def test_a_function_is_constant_beyond_its_data():
    narrow = term("displacement", "gas", lambda z: 1e-6 * z, high=5.0)
    shift_m = simulate(narrow)[1] - simulate()[1]
    assert shift_m.max() == pytest.approx(5e-6, rel=1e-3)


def table(**changes):
    given = {
        "where": '"displacement"',
        "depends_on": '"gas"',
        "unit": '"m"',
        "formula": '"-1e-6 gas"',
        "source": '"here"',
        "low": "0.0",
        "high": "60.0",
        "values": str([0.0] * KNOTS),
    }
    return "[[discovered]]\n" + "".join(f"{name} = {value}\n" for name, value in (given | changes).items())


def load(tmp_path, text):
    path = tmp_path / "own.toml"
    path.write_text(text)
    return load_parameters(path)


def test_a_parameter_set_states_it_and_plans_with_it(tmp_path):
    found = load(tmp_path, HEAD + 'planner_terms = ["discovered"]\n' + table())
    assert found.planner_terms == ("discovered",)
    assert found.term_keys[-1] == "discovered"
    assert len(found.discovered[0].values) == KNOTS


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"where": '"wall"'}, r"discovered\.0\.where: got 'wall'"),
        ({"depends_on": '"memory"', "memory_time_s": "0.05"}, "depends_on one of absorber, gas, drive where"),
        ({"unit": '"mm"'}, "unit m, not 'mm'"),
        ({"low": "60.0"}, "low less than high"),
        ({"values": str([1e-6] * KNOTS)}, r"discovered\.0\.values: got 1e-06, expected 0 m where gas is 0"),
        ({"values": "[0.0, 1.0]"}, "65 values, not 2"),
        ({"values": str([float("nan")] * KNOTS)}, r"discovered\.0\.values\.0: got nan"),
        ({"memory_time_s": "0.05"}, "memory_time_s together with depends_on = 'memory'"),
        ({"where": '"absorber"', "depends_on": '"memory"', "unit": '"W"'}, "memory_time_s together with"),
        (
            {"where": '"heat_capacity"', "depends_on": '"absorber"', "unit": '"1"', "values": str([-0.95] * KNOTS)},
            r"discovered\.0\.values\.0: got -0\.95, expected -0\.9 to 10 1",
        ),
        (
            {"where": '"gas"', "depends_on": '"gas"', "unit": '"K/s"', "values": str([0.0, *[-1e4] * (KNOTS - 1)])},
            "a time constant of .*, expected 2.5 ms or more",
        ),
        ({"colour": '"red"'}, "colour"),
    ],
)
def test_a_wrong_table_is_refused_by_name(tmp_path, changes, message):
    with pytest.raises(InputError, match=message):
        load(tmp_path, HEAD + table(**changes))


def test_five_tables_are_one_too_many(tmp_path):
    with pytest.raises(InputError, match="discovered"):
        load(tmp_path, HEAD + 5 * table())


def test_planning_with_nothing_discovered_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"planner_terms.*discovered"):
        load(tmp_path, HEAD + 'planner_terms = ["discovered"]\n')
