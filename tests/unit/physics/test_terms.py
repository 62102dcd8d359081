"""Terms in the limits where they vanish, equilibria of gas and membrane, and a new term as one file."""

import subprocess
import sys
from itertools import product

import numpy as np
import pytest

from optodrive.core.errors import DivergedError, InputError
from optodrive.physics import stability
from optodrive.physics.pixel import Pixel, advance
from optodrive.physics.pixel_ode import ActiveTerms, PixelExperiment, simulate_signals
from optodrive.physics.stability import check_time_constants
from optodrive.physics.term_kernels import CHAINS
from optodrive.physics.terms import check_requirements, discover_terms, find_term
from optodrive.physics.terms.mechanical import equilibrium_height_m

PIXEL = Pixel(184.0, 126e-6, 0.66, 3e-3, 4e-6, 2.3e-4)
AMBIENT_K = 293.15
PULSE = np.array([[0.002, 0.038, 2.45, 0.0]])
T_S = np.array([0.040, 0.060])


def simulate(values, ambient_k=AMBIENT_K):
    """Simulate rise, displacement and force of one pixel at T_S."""
    experiment = PixelExperiment(PULSE, 0, ambient_k, (T_S, T_S, T_S))
    return simulate_signals(experiment, PIXEL, ActiveTerms.from_values(values))


def nominal_rises_k():
    on = advance(PIXEL, 0.0, 0.0, 2.45, 0.038)
    return np.array([on, advance(PIXEL, *on, 0.0, 0.020)]).T


@pytest.mark.parametrize(
    ("values", "rel"),
    [
        ({}, 1e-5),
        ({"bridge_conductivity": {"exponent": 0.0}}, 1e-5),
        ({"wall_heating": {"resistance": 1e-3, "capacity": 10.0}}, 2e-5),
    ],
    ids=str,
)
def test_a_term_at_its_limit_is_the_nominal_pixel(values, rel):
    absorber_k, gas_k = nominal_rises_k()
    rise_k, displacement_m, force_n = simulate(values)
    assert rise_k == pytest.approx(absorber_k, rel=rel)
    assert displacement_m == pytest.approx(PIXEL.kappa_m_per_k * gas_k, rel=rel)
    assert force_n == pytest.approx(PIXEL.phi_n_per_k * gas_k, rel=rel)


@pytest.mark.parametrize("key", ["lateral_conduction", "touch_surface"])
def test_what_only_the_limiter_accounts_for_leaves_the_pixel_nominal(key):
    values = {key: {item.name: item.default for item in discover_terms()[key].parameters}}
    assert np.array_equal(simulate(values), simulate({}))
    assert not discover_terms()[key].in_pixel


@pytest.mark.parametrize("gas_k", [-5.0, 0.0, 1.0, 20.0, 250.0])
def test_the_membrane_balances_its_gas(gas_k):
    z_m = equilibrium_height_m(gas_k / AMBIENT_K, 7.8e-9)
    e, nu, h, r = 50e3, 0.49, 0.25e-3, 1.5e-3
    held_pa = 16 * e * h**3 * z_m / (3 * (1 - nu**2) * r**4) + 8 * e * h * z_m**3 / (3 * (1 - nu) * r**4)
    pushed_pa = 101_325 * ((AMBIENT_K + gas_k) / AMBIENT_K / (1 + 0.5 * np.pi * r**2 * z_m / 7.8e-9) - 1)
    assert pushed_pa == pytest.approx(held_pa, rel=1e-9, abs=1e-6)
    assert np.sign(z_m) == np.sign(gas_k)


def test_a_small_bulge_is_held_by_the_plate_and_the_gas_alone():
    e, nu, h, r = 50e3, 0.49, 0.25e-3, 1.5e-3
    stiffness = 16 * e * h**3 / (3 * (1 - nu**2) * r**4) + 101_325 * 0.5 * np.pi * r**2 / 7.8e-9
    assert equilibrium_height_m(0.7e-6 / AMBIENT_K, 7.8e-9) == pytest.approx(
        101_325 * 0.7e-6 / AMBIENT_K / stiffness, rel=1e-4
    )


def test_the_whole_aperture_at_half_the_rise_is_the_force_of_text_s1():
    values = {"force_area": {"area": np.pi * 1.5e-3**2, "share": 0.5}}
    gas_k = nominal_rises_k()[1]
    assert simulate(values, ambient_k=300.0)[2] == pytest.approx(2.387e-3 * gas_k, rel=1e-3)


@pytest.mark.parametrize(
    ("key", "values", "message"),
    [
        ("wall_heeting", {}, "a known term, nearest is 'wall_heating'"),
        ("touch_surface", {"lag": 1.0, "gas_share": 0.3, "wall_sharr": 0.4}, "nearest is 'wall_share'"),
        ("wall_heating", {"resistance": 20.0}, r"terms\.wall_heating\.capacity: missing"),
    ],
)
def test_mistaken_values_are_refused_in_one_line(key, values, message):
    with pytest.raises(InputError, match=message) as caught:
        find_term(f"terms.{key}", key, values)
    assert "\n" not in str(caught.value)


def test_a_term_without_the_one_it_builds_on_is_refused():
    with pytest.raises(InputError, match=r"terms\.lateral_conduction: .* expected terms\.wall_heating"):
        check_requirements("terms", ["lateral_conduction"])


def test_every_module_of_the_package_is_a_term():
    terms = discover_terms()
    for key, term in terms.items():
        assert term.key == key
        assert term.label
        assert term.parameters
        for parameter in term.parameters:
            assert parameter.low <= parameter.default <= parameter.high
            assert all(parameter.low <= start <= parameter.high for start in parameter.starts)
            assert parameter.source


def test_the_generated_module_keeps_its_name_whatever_its_terms():
    assert {getattr(chain, "__module__", None) for chain in CHAINS} == {"optodrive_chains"}


@pytest.mark.parametrize(("rate", "found"), [(500.0, "2 ms"), (1000.0, "1 ms"), (5000.0, "200 µs")])
def test_a_term_that_is_too_fast_for_the_integrator_is_refused_by_name(rate, found):
    """Steps grow to 6 ms. Between 2 ms and half of that, an error may grow without leaving the range."""
    values = {"gas_leak": {"rate": rate}, "wall_heating": {"resistance": 20.0, "capacity": 0.06}}
    message = f"term gas_leak: got a time constant of {found}, expected 2.2 ms or more"
    with pytest.raises(DivergedError, match=message) as caught:
        check_time_constants(values)
    assert "\n" not in str(caught.value)


def test_an_oscillating_pair_of_states_is_judged_by_its_frequency(monkeypatch):
    """No state of the pair has a time constant of its own."""
    monkeypatch.setattr(stability, "_compute_jacobian", lambda *_: np.array([[0.0, 2e3], [-2e3, 0.0]]))
    with pytest.raises(DivergedError, match="a time constant of 500 µs"):
        stability._check_term.__wrapped__("gas_leak", (("gas_leak", (("rate", 1.0),)),))


def test_a_state_that_leaves_its_range_is_refused_by_name():
    with pytest.raises(
        DivergedError, match=r"term gas_leak: got -[0-9.e+]+ as state 'leaked_k', expected at most ±1e"
    ) as e:
        simulate({"gas_leak": {"rate": 5000.0}, "wall_heating": {"resistance": 20.0, "capacity": 0.06}})
    assert "\n" not in str(e.value)


def test_a_signal_that_is_no_number_is_refused_by_name():
    with pytest.raises(DivergedError, match="term sensor_scale: got a temperature that is no number"):
        simulate({"sensor_scale": {"gain": np.inf, "offset": 0.0}})


def test_a_pixel_without_terms_that_leaves_its_range_is_refused():
    experiment = PixelExperiment(np.array([[0.0, 0.1, 1e9, 0.0]]), 0, AMBIENT_K, (T_S, T_S, T_S))
    with pytest.raises(DivergedError, match=r"the pixel: got .* as state"):
        simulate_signals(experiment, PIXEL, ActiveTerms.from_values({}))


def test_every_term_stays_in_range_at_the_limits_and_starts_of_its_parameters():
    """Of a slow gas, whose integrator takes the longest steps."""
    t_s = np.array([0.5, 1.0])
    experiment = PixelExperiment(
        np.array([[0.0, 0.5, 2.45, 0.0]]), 0, AMBIENT_K, (t_s, t_s, t_s), dose_before=0.5, session_time=1.0
    )
    for key, term in discover_terms().items():
        ends = [dict.fromkeys((item.low, item.high, *item.starts)) for item in term.parameters]
        for numbers in product(*ends):
            values = {key: dict(zip((item.name for item in term.parameters), numbers, strict=True))}
            for required in term.requires:
                values[required] = {item.name: item.default for item in discover_terms()[required].parameters}
            check_time_constants(values)
            simulate_signals(experiment, PIXEL._replace(tau_g_s=0.02), ActiveTerms.from_values(values))


LEAK = """
from optodrive.core.kernels import kernel
from optodrive.physics.hypothesis import TermParameter
from optodrive.physics.term import ABSORBER, Kernels, Term

@kernel
def heat_loss(v, y, s, c, x):
    return x + y[ABSORBER] / v[0]

class HeatLeak(Term):
    key = "heat_leak"
    label = "the absorber leaks heat"
    parameters = (TermParameter("resistance", "K/W", 100.0, 1.0, 1e6, "here", starts=(50.0, 500.0)),)
    kernels = Kernels(heat_loss=heat_loss)
    cannot_add_heat = True
    signature = "plateaus"

TERM = HeatLeak()
"""

USE = """
import sys
from pathlib import Path

import optodrive.physics.terms as terms

terms.__path__.append(sys.argv[1])

import numpy as np

from optodrive.device.config_file import load_config
from optodrive.physics.hypothesis import RecordingScope
from optodrive.physics.parameters import build_display_pixels, load_parameters
from optodrive.physics import stability
from optodrive.physics.pixel import Pixel
from optodrive.physics.pixel_ode import ActiveTerms, PixelExperiment, simulate_signals
from optodrive.planning.budget_setup import build_budget

t_s = np.array([0.5])
experiment = PixelExperiment(np.array([[0.0, 0.5, 2.0, 0.0]]), 0, 293.15, (t_s, t_s, t_s))
pixel = Pixel(184.0, 126e-6, 0.66, 3e-3, 4e-6, 2.3e-4)
rise_k = simulate_signals(experiment, pixel, ActiveTerms.from_values({"heat_leak": {"resistance": 184.0}}))[0]
assert abs(rise_k[0] / (0.5 * 0.66 * 2.0 * 184.0) - 1.0) < 1e-5
scope = RecordingScope(("temperature",), (0,), frozenset([0]), False, 1)
(hypothesis,) = terms.discover_terms()["heat_leak"].build_hypotheses(scope)
assert len(hypothesis.starts) == 2
path = Path(sys.argv[1], "with_leak.toml")
path.write_text('''format = "optodrive-parameters"
version = 1
name = "with_leak"
base = "surroundings"
claims = "none"
planner_terms = ["heat_leak"]
[terms.heat_leak.resistance]
value = 500.0
unit = "K/W"
source = "a test"
''')
parameters, config = load_parameters(path), load_config("display-16")
build_budget(config, parameters, build_display_pixels(config, parameters))
"""


@pytest.mark.slow
def test_a_new_term_is_a_new_file_and_nothing_else(tmp_path):
    """The term is simulated, searched for, loaded from a parameter set and bounded by the limiter."""
    (tmp_path / "heat_leak.py").write_text(LEAK)
    finished = subprocess.run([sys.executable, "-c", USE, str(tmp_path)], capture_output=True, text=True, check=False)
    assert finished.returncode == 0, finished.stderr
