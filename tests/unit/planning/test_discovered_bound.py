"""The limiter bounds what a discovery found, or refuses it by name."""

import numpy as np
import pytest

from displays import DISPLAYS
from optodrive.core.errors import InputError
from optodrive.core.quantity import ZERO_CELSIUS_K
from optodrive.core.types.plans import PulsePlan
from optodrive.physics.discovered_term import KEY, KNOTS, UNITS, DiscoveredTerm, list_values
from optodrive.physics.parameters import load_parameters
from optodrive.physics.pixel_ode import ActiveTerms, PixelExperiment, simulate_signals
from optodrive.planning.budget_setup import build_budget
from optodrive.planning.limiter.limiter import build_cold_budget_state, limit

DISPLAY = DISPLAYS["display-16"]
CONFIG = DISPLAY.config
SURE = dict.fromkeys(CONFIG.limits.uncertainty.model_dump(), 0.0)
UNCERTAINTY = CONFIG.limits.uncertainty.model_copy(update=SURE)
LIMITS = CONFIG.limits.model_copy(update={"uncertainty": UNCERTAINTY, "absorber_max_c": 120.0})
EXACT = CONFIG.model_copy(update={"limits": LIMITS})
"""A display without declared uncertainty, whose absorber's cap the light exceeds easily.

What is left to spare must not hide a missing bound.
"""
R_K_PER_W = float(DISPLAY.pixels.r_k_per_w.max())


def term(where, depends_on, function, high=100.0, low=0.0, **more):
    unit = "W" if depends_on == "power" else UNITS[where]
    values = [float(function(z)) for z in np.linspace(low, high, KNOTS)]
    given = {"where": where, "depends_on": depends_on, "unit": unit, "formula": "f", "source": "here"}
    return DiscoveredTerm.model_validate(given | {"low": low, "high": high, "values": values} | more)


HOT = {
    "brighter when hot": [term("light", "absorber", lambda z: 0.3 * z / 100.0)],
    "brighter at first": [term("light", "since_opening", lambda z: 0.4 * np.exp(-z / 0.01), high=0.2)],
    "more at high power": [term("light", "power", lambda z: 0.1 * z**2, high=2.45)],
    "less capacity in a range": [term("heat_capacity", "absorber", lambda z: 0.6 * np.exp(-(((z - 40) / 8) ** 2)))],
    "more capacity in a range": [term("heat_capacity", "absorber", lambda z: -0.6 * np.exp(-(((z - 40) / 8) ** 2)))],
    "feedback": [term("absorber", "absorber", lambda z: 0.3 * z / R_K_PER_W)],
    "memory": [term("absorber", "memory", lambda z: 0.3 * z / R_K_PER_W, memory_time_s=0.04)],
    "fast memory": [term("absorber", "memory", lambda z: 0.5 * z / R_K_PER_W, memory_time_s=0.006)],
    "feedback and memory": [
        term("absorber", "absorber", lambda z: 0.2 * z / R_K_PER_W),
        term("absorber", "memory", lambda z: 0.2 * z / R_K_PER_W, memory_time_s=0.03),
    ],
    "light and memory": [
        term("light", "absorber", lambda z: 0.2 * np.tanh(z / 20.0)),
        term("absorber", "memory", lambda z: 0.2 * z / R_K_PER_W, memory_time_s=0.03),
        term("heat_capacity", "absorber", lambda z: 0.3 * z / 100.0),
    ],
}


def build_limits(terms, config=EXACT, base="calibrated"):
    parameters = load_parameters(base).model_copy(update={"discovered": tuple(terms), "planner_terms": (KEY,)})
    return build_budget(config, parameters, DISPLAY.pixels)


def build_hostile_plan(power_w, seed):
    """Build pulses that stress one pixel at the given power, short and long, with short and long rests."""
    generator = np.random.default_rng(seed)
    count = 120
    width_s = generator.integers(25, 250, count) * 2e-4
    rest_s = generator.choice([5e-4, 5e-3, 0.03, 0.1], count)
    start_s = 0.01 + np.cumsum(np.concatenate([[0.0], (width_s + rest_s)[:-1]]))
    return build_plan(start_s, width_s, power_w)


def build_plan(start_s, width_s, power_w):
    """Build pulses of one power on one pixel."""
    count = len(start_s)
    pixel = np.full(count, 5)
    angles_rad = DISPLAY.scan_head.field.angles_rad(DISPLAY.layout.x_m, DISPLAY.layout.y_m)
    x_rad, y_rad = (angle_rad[pixel] for angle_rad in angles_rad)
    zero, nothing = np.zeros(count), np.full(count, np.nan)
    stage, source = np.zeros(count, np.int64), pixel.astype(np.int64)
    columns = (start_s, width_s, x_rad, y_rad, np.full(count, power_w), pixel, zero, nothing, start_s, source, stage)
    return PulsePlan(*columns)


def find_peak_share(terms, budget, plan):
    """Return the absorber's peak over its cap, when the limited plan is played on a pixel with the terms."""
    limited, _ = limit(plan, build_cold_budget_state(len(DISPLAY.pixels)), budget)
    pulses = np.column_stack([limited.start_s, limited.width_s, limited.power_w, limited.pixel])
    t_s = np.arange(0.0, float(plan.start_s[-1]) + 0.3, 1e-4)
    scene = PixelExperiment(pulses, 5, CONFIG.ambient_c + ZERO_CELSIUS_K, (t_s, t_s[:0], t_s[:0]))
    active = ActiveTerms.from_values({KEY: list_values(terms)} if terms else {})
    rise_k = simulate_signals(scene, DISPLAY.pixels.elements[5], active)[0].max()
    return float(rise_k) / (EXACT.limits.absorber_max_c - EXACT.ambient_c)


@pytest.mark.parametrize("name", sorted(HOT))
def test_no_discovered_term_takes_an_absorber_above_its_cap(name):
    budget = build_limits(HOT[name])
    shares = [
        find_peak_share(HOT[name], budget, build_hostile_plan(power_w, seed))
        for power_w in (2.45, 1.2)
        for seed in range(3)
    ]
    assert max(shares) <= 1.0
    assert max(shares) > 0.3  # the limiter still plays


@pytest.mark.parametrize("name", sorted(set(HOT) - {"more capacity in a range"}))
def test_a_limiter_that_ignores_the_term_is_caught(name):
    """Mutant: the budget of the set without the term."""
    budget = build_limits([])
    shares = [find_peak_share(HOT[name], budget, build_hostile_plan(2.45, seed)) for seed in range(3)]
    assert max(shares) > 1.0


def build_warm_budget(terms):
    """Build the budget of a pixel with a wall and a touch surface, whose caps alone bind."""
    own = {key: load_parameters("surroundings").terms[key] for key in ("wall_heating", "touch_surface")}
    parameters = load_parameters("calibrated").model_copy(update={"terms": own, "discovered": tuple(terms)})
    loose = {"absorber_max_c": 400.0, "pixel_mean_max_w": 2.0, "display_mean_max_w": 2.0}
    config = EXACT.model_copy(update={"limits": LIMITS.model_copy(update=loose)})
    return build_budget(config, parameters, DISPLAY.pixels)


def find_warmest_k(terms, budget, h_s=2e-4, until_s=8.0):
    """Return the largest rises of wall and touch surface under limited pulses, integrated by Euler's method."""
    pixel, surroundings = DISPLAY.pixels.elements[5], load_parameters("surroundings")
    wall, touch = (surroundings.term_values(key) for key in ("wall_heating", "touch_surface"))
    starts_s = np.arange(0.01, until_s - 0.5, 0.051)
    width_s = np.full(len(starts_s), 0.05)
    plan = build_plan(starts_s, width_s, 2.45)
    limited, _ = limit(plan, build_cold_budget_state(len(DISPLAY.pixels)), budget)
    power_w = np.zeros(round(until_s / h_s))
    for start_s, wide_s, watts in zip(limited.start_s, limited.width_s, limited.power_w, strict=True):
        power_w[round(start_s / h_s) : round((start_s + wide_s) / h_s)] = watts
    (term_,) = terms
    slope = term_.values[-1] / term_.high
    absorber = gas = memory = wall_k = touch_k = 0.0
    warmest = [0.0, 0.0]
    for watts in power_w.tolist():
        flow_w = (absorber - wall_k) / pixel.r_k_per_w
        back_w = slope * (memory if term_.depends_on == "memory" else absorber - wall_k)
        absorber += h_s * (pixel.epsilon * watts - flow_w + back_w) / pixel.c_j_per_k
        gas += h_s * (0.5 * (absorber + wall_k) - gas) / pixel.tau_g_s
        memory += h_s * (absorber - wall_k - memory) / (term_.memory_time_s or 1.0)
        wall_k += h_s * (flow_w - wall_k / wall["resistance"]) / wall["capacity"]
        drive_k = touch["gas_share"] * gas + touch["wall_share"] * wall_k
        touch_k += h_s * (drive_k - touch_k) / touch["lag"]
        warmest = [max(warmest[0], wall_k), max(warmest[1], touch_k)]
    return warmest


@pytest.mark.parametrize("name", ["memory", "fast memory", "feedback"])
def test_a_finger_stays_below_its_cap(name):
    """Also a mutant: the budget of the set without the term passes the cap."""
    budget = build_warm_budget(HOT[name])
    wall_k, touch_k = find_warmest_k(HOT[name], budget)
    assert wall_k <= budget.caps.wall_k
    assert 0.3 * budget.caps.touch_k < touch_k <= budget.caps.touch_k
    assert find_warmest_k(HOT[name], build_warm_budget([]))[1] > budget.caps.touch_k


@pytest.mark.parametrize(
    "terms",
    [
        [term("absorber", "gas", lambda z: 1e-4 * z)],
        [term("absorber", "absorber", lambda z: 0.9 * z / R_K_PER_W)],
        [term("absorber", "memory", lambda z: 0.06 * z / R_K_PER_W, memory_time_s=0.2)],
        [term("light", "power", lambda z: 0.1, high=2.45)],
        [term("heat_capacity", "absorber", lambda z: -0.5), term("heat_capacity", "absorber", lambda z: -0.5)],
    ],
    ids=["from the gas", "runaway", "warm for long", "light in the dark", "no rate is left"],
)
def test_a_term_without_a_bound_is_refused_by_name(terms):
    with pytest.raises(InputError, match=r"terms\.discovered: .* a term that the limiter can bound"):
        build_limits(terms)


@pytest.mark.parametrize(
    "terms",
    [
        [term("displacement", "gas", lambda z: -1e-6 * z)],
        [term("force", "drive", lambda z: 1e-3 * z, low=-20.0)],
        [term("absorber", "absorber", lambda z: -1e-4 * z**2)],
        [term("absorber", "gas", lambda z: -1e-4 * z)],
        [term("light", "absorber", lambda z: -0.3 * z / 100.0)],
    ],
)
def test_a_term_that_heats_nothing_changes_no_bound(terms):
    plain, with_it = build_limits([], CONFIG, "surroundings"), build_limits(terms, CONFIG, "surroundings")
    assert with_it.caps == plain.caps
    for ours, theirs in zip(with_it.heat, plain.heat, strict=True):
        assert np.array_equal(ours, theirs)


def test_a_gas_that_stays_warm_leaves_less_to_the_touch_surface():
    slower = [term("gas", "drive", lambda z: max(0.0, -20.0 * z), low=-40.0, high=40.0)]
    plain, with_it = build_limits([], CONFIG, "surroundings"), build_limits(slower, CONFIG, "surroundings")
    assert with_it.caps.touch_k < plain.caps.touch_k
