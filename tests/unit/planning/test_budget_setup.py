"""Terms and the limiter: the heat that a term can add is bounded, or the parameter set is refused by name."""

import numpy as np
import pytest

from displays import DISPLAYS
from optodrive.core.errors import InputError
from optodrive.core.quantity import ZERO_CELSIUS_K
from optodrive.core.types.plans import PulsePlan
from optodrive.device.config_sections import PanelSection
from optodrive.physics.parameters import Parameter, load_parameters
from optodrive.physics.pixel_ode import ActiveTerms, PixelExperiment, simulate_signals
from optodrive.physics.term import HeatGainBound
from optodrive.physics.terms import discover_terms
from optodrive.planning import budget_setup
from optodrive.planning.budget_setup import (
    BOUNDED_TERMS,
    build_budget,
    build_galvo_model,
    build_nominal_panel,
    compute_heat_gain_bound,
    compute_long_move_load,
)
from optodrive.planning.limiter.galvo_load import move_energy
from optodrive.planning.limiter.limiter import build_cold_budget_state, limit

DISPLAY = DISPLAYS["display-16"]
CONFIG = DISPLAY.config
LARGE = {
    "heat_capacity": {"slope": 3e-3},
    "neighbour_crosstalk": {"share": 0.02, "lag": 0.02},
    "power_nonlinearity": {"threshold": 0.0, "curvature": 0.25},
    "absorber_ageing": {"share": 0.1, "time_share": 0.1, "step_share": 0.05, "step_at": 0.5},
    "beam_misalignment": {"share": 0.2, "pixel": 5.0, "resistance": 20.0, "time": 0.3},
    "ambient_drift": {"offset": 3.0, "ramp": -1.0, "bend": 0.5, "rate": 0.0},
}


def with_term(key, base="surroundings", **values):
    term = discover_terms()[key]
    own = {
        item.name: Parameter(value=values.get(item.name, max(item.default, item.low)), unit=item.unit, source="here")
        for item in term.parameters
    }
    below = load_parameters(base)
    return below.model_copy(update={"terms": {**below.terms, key: own}, "planner_terms": (key,)})


def build_budget_with(key, base="surroundings"):
    return build_budget(CONFIG, with_term(key, base, **LARGE.get(key, {})), DISPLAY.pixels)


@pytest.mark.parametrize("key", sorted(discover_terms()))
def test_every_term_has_a_bound_except_crosstalk_above_the_touch_cap(key):
    if key == "neighbour_crosstalk":
        with pytest.raises(InputError, match=r"limits\.touch_max_c: got 43\.0, expected more than .* may warm it"):
            build_budget(CONFIG, with_term(key, share=0.15), DISPLAY.pixels)
    build_budget_with(key)


@pytest.mark.parametrize("name", ["share", "time_share", "step_share"])
def test_increasing_absorption_has_no_bound(name):
    with pytest.raises(InputError, match=r"terms\.absorber_ageing: .* a term that the limiter can bound"):
        build_budget(CONFIG, with_term("absorber_ageing", **{name: -0.05}), DISPLAY.pixels)


def test_terms_that_cannot_add_heat_change_no_bound():
    plain = build_budget(CONFIG, load_parameters("surroundings"), DISPLAY.pixels)
    for key, term in discover_terms().items():
        if term.cannot_add_heat and key not in BOUNDED_TERMS:
            with_it = build_budget_with(key)
            assert with_it.caps == plain.caps
            for ours, theirs in zip(with_it.heat, plain.heat, strict=True):
                assert np.array_equal(ours, theirs), key


def test_a_threshold_that_full_power_does_not_reach_is_refused():
    """Above it the formula of the term would make weak light the brightest, and at it divide by zero."""
    laser = CONFIG.laser.model_copy(update={"max_power_w": 0.4})
    weak, parameters = CONFIG.model_copy(update={"laser": laser}), with_term("power_nonlinearity", threshold=0.4)
    with pytest.raises(InputError, match=r"power_nonlinearity\.threshold: got 0\.4, expected less than .* 0\.4 W"):
        build_budget(weak, parameters, DISPLAY.pixels)


@pytest.mark.parametrize("threshold_w", [0.4, 0.5])
def test_a_laser_below_its_threshold_emits_nothing(threshold_w):
    t_s = np.arange(0.0, 0.1, 1e-3)
    scene = PixelExperiment([[0.0, 0.05, 0.2, 0]], 0, 293.15, (t_s, t_s, t_s), full_w=0.4)
    active = ActiveTerms.from_values({"power_nonlinearity": {"threshold": threshold_w, "curvature": 0.0}})
    assert not simulate_signals(scene, DISPLAY.pixels.elements[0], active)[0].any()


def build_hostile_plan(power_w, seed):
    """Build pulses that stress one pixel and its neighbours at the given power."""
    generator = np.random.default_rng(seed)
    count = 120
    width_s = generator.integers(25, 250, count) * 2e-4
    rest_s = generator.choice([5e-4, 5e-3, 0.03], count)
    start_s = 0.01 + np.cumsum(np.concatenate([[0.0], (width_s + rest_s)[:-1]]))
    pixel = generator.choice([5, 5, 5, 4, 6], count)
    angles_rad = DISPLAY.scan_head.field.angles_rad(DISPLAY.layout.x_m, DISPLAY.layout.y_m)
    x_rad, y_rad = (angle_rad[pixel] for angle_rad in angles_rad)
    zero, nothing = np.zeros(count), np.full(count, np.nan)
    stage, source = np.zeros(count, np.int64), pixel.astype(np.int64)
    columns = (start_s, width_s, x_rad, y_rad, np.full(count, power_w), pixel, zero, nothing, start_s, source, stage)
    return PulsePlan(*columns)


def compute_peak_fraction(key, budget, plan):
    """Return the peak of the absorber over its cap, simulated with that term alone."""
    limited, _ = limit(plan, build_cold_budget_state(len(DISPLAY.pixels)), budget)
    pulses = np.column_stack([limited.start_s, limited.width_s, limited.power_w, limited.pixel])
    t_s = np.arange(0.0, float(plan.start_s[-1]) + 0.3, 1e-4)
    ambient_k = CONFIG.ambient_c + ZERO_CELSIUS_K
    dose, session_time = (0.0, -1.0) if key == "absorber_ageing" else (1.0, 0.0)
    times = (t_s, t_s[:0], t_s[:0])
    scene = PixelExperiment(pulses, 5, ambient_k, times, dose_before=dose, session_time=session_time)
    values = {key: LARGE[key]} if key != "ambient_drift" else {}
    rise_k = simulate_signals(scene, DISPLAY.pixels.elements[5], ActiveTerms.from_values(values))[0].max()
    drift_k = 4.5 if key == "ambient_drift" else 0.0
    return (rise_k + drift_k) / (CONFIG.limits.absorber_max_c - CONFIG.ambient_c)


@pytest.mark.parametrize("key", sorted(LARGE))
@pytest.mark.parametrize("power_w", [2.45, 1.2])
def test_no_term_takes_an_absorber_above_its_cap(key, power_w):
    budget = build_budget_with(key, base="calibrated")
    for seed in range(3):
        assert compute_peak_fraction(key, budget, build_hostile_plan(power_w, seed)) <= 1.0


@pytest.mark.parametrize("key", ["power_nonlinearity", "ambient_drift"])
def test_a_limiter_that_ignores_the_term_is_caught(key, monkeypatch):
    """Mutant: without the term's bound, and without any declared uncertainty, the cap is exceeded."""
    sure = dict.fromkeys(CONFIG.limits.uncertainty.model_dump(), 0.0)
    limits = CONFIG.limits.model_copy(update={"uncertainty": CONFIG.limits.uncertainty.model_copy(update=sure)})
    # A wide energy bucket makes the absorber's own cap the binding one.
    limits = limits.model_copy(update={"pixel_mean_power_max_w": 2.45, "display_mean_power_max_w": 2.45})
    config = CONFIG.model_copy(update={"limits": limits.model_copy(update={"absorber_max_c": 160.0})})
    parameters = with_term(key, "calibrated", **LARGE[key])

    def share(budget):
        scale = (CONFIG.limits.absorber_max_c - CONFIG.ambient_c) / (160.0 - CONFIG.ambient_c)
        return max(compute_peak_fraction(key, budget, build_hostile_plan(1.2, seed)) for seed in range(3)) * scale

    assert share(build_budget(config, parameters, DISPLAY.pixels)) <= 1.0
    monkeypatch.setattr(budget_setup, "compute_heat_gain_bound", lambda *_: HeatGainBound())
    assert share(build_budget(config, parameters, DISPLAY.pixels)) > 1.0


def test_a_larger_heat_capacity_when_hot_slows_the_cooling_of_the_bound():
    plain = build_budget(CONFIG, load_parameters("calibrated"), DISPLAY.pixels).heat
    hot = build_budget_with("heat_capacity", "calibrated").heat
    cap_k = CONFIG.limits.absorber_max_c - CONFIG.ambient_c
    assert hot.c_low_j_per_k.tolist() == plain.c_low_j_per_k.tolist()
    assert hot.c_high_j_per_k == pytest.approx(plain.c_high_j_per_k * (1 + 3e-3 * cap_k))


def test_a_uniform_rise_is_subtracted_from_every_cap_with_its_effect_on_walls_and_touch_surfaces():
    parameters = with_term("ambient_drift", **LARGE["ambient_drift"])
    heat_gain = compute_heat_gain_bound(parameters, DISPLAY.pixels, CONFIG)
    assert 4.5 < heat_gain.uniform_rise_k < 4.7
    plain = build_budget(CONFIG, load_parameters("surroundings"), DISPLAY.pixels).caps
    caps = build_budget(CONFIG, parameters, DISPLAY.pixels).caps
    for name in ("absorber_k", "wall_k", "touch_k"):
        assert getattr(plain, name) - getattr(caps, name) == pytest.approx(heat_gain.uniform_rise_k, rel=0.01)


def build_with_panel(**values):
    config = CONFIG.model_copy(update={"panel": PanelSection(**values)})
    return build_budget(config, load_parameters("surroundings"), DISPLAY.pixels)


def test_a_panel_with_less_capacity_than_its_walls_is_refused():
    with pytest.raises(InputError, match=r"panel\.capacity_j_per_k: got 0\.5, expected more than 0\.96, .*16 pixels"):
        build_with_panel(capacity_j_per_k=0.5)


def test_a_panel_that_is_as_fast_as_its_walls_is_refused():
    with pytest.raises(InputError, match=r"panel: got 'a time constant of .* s', expected at least 4 times"):
        build_with_panel(resistance_k_per_w=0.5)


def test_without_walls_the_absorbers_warm_the_panel():
    heat = build_budget(CONFIG, load_parameters("calibrated"), DISPLAY.pixels).heat
    walled = build_budget(CONFIG, load_parameters("surroundings"), DISPLAY.pixels).heat
    assert heat.panel_k_per_j[0] == pytest.approx(walled.panel_k_per_j[0], rel=0.03)
    assert 1.0 < heat.touch_per_panel < walled.touch_per_panel


def with_panel(base="surroundings", **values):
    return with_term("panel_heating", base, **{"resistance": 40.0, "capacity": 6.0, "share": 0.6, **values})


def test_a_panel_that_the_parameter_set_states_replaces_that_of_the_configuration():
    panel = PanelSection(resistance_k_per_w=40.0, capacity_j_per_k=6.0)
    configured = build_budget(
        CONFIG.model_copy(update={"panel": panel}), load_parameters("surroundings"), DISPLAY.pixels
    )
    stated = build_budget(CONFIG, with_panel(), DISPLAY.pixels)
    assert stated.caps == configured.caps
    for ours, theirs in zip(stated.heat, configured.heat, strict=True):
        assert np.array_equal(ours, theirs)


def test_a_panel_that_takes_more_light_than_the_absorbers_is_bounded_as_warmer():
    epsilon = float(DISPLAY.pixels.epsilon.min())
    usual, warmer = (build_nominal_panel(CONFIG, with_panel(share=share), DISPLAY.pixels) for share in (epsilon, 1.0))
    assert warmer.r_k_per_w == pytest.approx(usual.r_k_per_w / epsilon)
    assert warmer.c_j_per_k < usual.c_j_per_k * epsilon


def test_a_stated_panel_below_the_capacity_of_its_walls_is_refused():
    with pytest.raises(
        InputError, match=r"terms\.panel_heating\.capacity: got 0\.1, expected more than .* of the walls"
    ):
        build_budget(CONFIG, with_panel(capacity=0.1), DISPLAY.pixels)


def test_a_panel_without_walls_is_bounded_as_with_them():
    heat = build_budget(CONFIG, with_panel("calibrated"), DISPLAY.pixels).heat
    unsure = CONFIG.limits.uncertainty
    assert heat.panel_tau_s[0] == pytest.approx(
        40.0 * 6.0 * (1 + unsure.panel_resistance) * (1 - unsure.panel_capacity)
    )
    assert compute_heat_gain_bound(with_panel("calibrated"), DISPLAY.pixels, CONFIG).uniform_rise_k == 0.0


def test_a_galvo_cap_under_which_no_pulse_fits_is_refused():
    galvo = build_galvo_model(CONFIG)
    load = compute_long_move_load(galvo)
    assert load == pytest.approx((move_energy(galvo, 1e9) / galvo.averaging_s) ** 0.5)
    limits = CONFIG.limits.model_copy(update={"galvo_acceleration_rms_max_rad_per_s2": 1.4 * load})
    with pytest.raises(InputError, match=r"limits\.galvo_acceleration_rms_max_rad_per_s2: got .*, expected at least"):
        build_budget(CONFIG.model_copy(update={"limits": limits}), DISPLAY.parameters, DISPLAY.pixels)
