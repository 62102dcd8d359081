"""Utilisation of each cap by hostile sequences, and mutants of the limiter that exceed it."""

import numpy as np
import pytest

from displays import DISPLAYS
from optodrive.core.units import ZERO_CELSIUS_K
from optodrive.device.neighbours import Neighbours
from optodrive.physics.parameters import load_parameters
from optodrive.planning.budget_setup import build_nominal_model
from optodrive.planning.limiter.budget import Budget
from optodrive.planning.limiter.limiter import build_cold_budget_state, limit
from optodrive.planning.limiter.worst_case import Uncertainty, build_heat_bound
from reference_models.thermal_display import (
    NO_CAPS,
    build_plan,
    build_true_display,
    galvo_peak,
    upper_factors,
    window_peak_w,
)


def repeat_pulses(span_s, width_s=0.010, rest_s=5.2e-4, pixel=0):
    """Return pulse after pulse on one pixel."""
    period_s = width_s + rest_s
    return [(pixel, round(k * period_s * 1e6) * 1e-6, width_s) for k in range(int(span_s / period_s))]


def alternate_pixels(span_s):
    """Return alternating pulses on two distant pixels, as fast as the mirrors settle."""
    return [(8 * (k % 2), round(k * 1.2e3) * 1e-6, 2e-4) for k in range(int(span_s / 1.2e-3))]


# display, binding caps, sequence before and after the pause, pause
SCENARIOS = {
    "absorber": ("display-1", dict(absorber_k=380.0), repeat_pulses(0.4), 0.015),
    "wall": ("display-16", dict(wall_k=15.0), repeat_pulses(6.0), 0.2),
    "touch": ("display-16", dict(touch_k=23.0), repeat_pulses(6.0), 0.2),
    "diode": ("display-16", dict(display_mean_w=0.5), repeat_pulses(2.3), 0.2),
    "galvo": ("display-16", dict(galvo_rad2_per_s4=5e4**2), alternate_pixels(3.0), 0.05),
}


def build_model(name):
    display = DISPLAYS[name]
    parameters = load_parameters(display.config.pixel_model.parameters)
    return build_nominal_model(
        parameters, display.pixels, Neighbours.from_display(display.config.display), 20.0 + ZERO_CELSIUS_K
    )


def keep_budget(budget):
    return budget


def keep_state(state, before, at_s, pixels):
    return state


def cap_fraction(guard, factor=None, mutate=keep_budget, carry=keep_state):
    """Return the largest value, over the cap, that the sequence, a pause and the sequence again reach."""
    name, binding, rows, pause_s = SCENARIOS[guard]
    display, model = DISPLAYS[name], build_model(name)
    caps = NO_CAPS._replace(**binding)
    budget = Budget(caps, display.budget.heat, display.budget.galvo)
    pixels = len(model.epsilon)
    offset_s = rows[-1][1] + rows[-1][2] + pause_s
    again = [(pixel, start_s + offset_s, width_s) for pixel, start_s, width_s in rows]
    state, limited = build_cold_budget_state(pixels), []
    for part in (rows, again):
        batch, after = limit(build_plan(part, 2.45, display.config.display), state, mutate(budget))
        limited.append(batch)
        state = carry(after, state, offset_s, pixels)
    plan = build_plan(rows + again, np.concatenate([batch.power_w for batch in limited]), display.config.display)
    if guard == "galvo":
        return galvo_peak(plan, budget) / caps.galvo_rad2_per_s4
    if guard == "diode":
        return window_peak_w(plan, caps.display_window_s) / caps.display_mean_w
    absorber, _, wall, touch = build_true_display(model, factor).peaks(plan)
    return {
        "absorber": absorber / caps.absorber_k,
        "wall": wall / caps.wall_k,
        "touch": touch / caps.touch_k,
    }[guard]


@pytest.mark.parametrize("guard", SCENARIOS)
def test_the_limiter_is_not_overly_conservative(guard):
    """At nominal parameters, with the shipped uncertainty declared, at least 90 % of each cap is reached."""
    assert 0.9 <= cap_fraction(guard) <= 1 + 1e-9


def worst_factors(guard):
    unsure = Uncertainty(**DISPLAYS[SCENARIOS[guard][0]].config.limits.uncertainty.model_dump())
    slow = {name: 1 - getattr(unsure, name) for name in ("absorber_capacity", "wall_capacity", "touch_lag", "gas_lag")}
    return upper_factors(unsure) | slow


def test_every_cap_holds_in_the_worst_case():
    for guard in SCENARIOS:
        assert 0.95 <= cap_fraction(guard, worst_factors(guard)) <= 1 + 1e-9, guard


def cap_five_percent_off(guard):
    cap = next(iter(SCENARIOS[guard][1]))

    def mutate(budget):
        # The galvo cap is a squared acceleration.
        factor_off = 1.05**2 if guard == "galvo" else 1.05
        return budget._replace(caps=budget.caps._replace(**{cap: getattr(budget.caps, cap) * factor_off}))

    return dict(mutate=mutate)


def wrong_constant(guard):
    def mutate(budget):
        heat, galvo, caps = budget.heat, budget.galvo, budget.caps
        if guard == "absorber":
            heat = heat._replace(r_k_per_w=0.8 * heat.r_k_per_w)
        elif guard == "wall":
            heat = heat._replace(wall_w_per_k=heat.wall_w_per_k / 0.8)
        elif guard == "touch":
            heat = heat._replace(touch_k_per_j=0.8 * heat.touch_k_per_j)
        elif guard == "diode":
            caps = caps._replace(display_window_s=2.0 * caps.display_window_s)
        else:
            galvo = galvo._replace(omega_rad_per_s=0.8 * galvo.omega_rad_per_s)
        return Budget(caps, heat, galvo)

    return dict(mutate=mutate)


def forgotten_over_a_pause(guard):
    return dict(carry=lambda state, before, at_s, pixels: build_cold_budget_state(pixels, at_s))


def unacknowledged_not_counted(guard):
    return dict(carry=lambda state, before, at_s, pixels: before)


MUTANTS = (cap_five_percent_off, wrong_constant, forgotten_over_a_pause, unacknowledged_not_counted)


LONGEST = {("absorber", wrong_constant), ("wall", wrong_constant), ("touch", wrong_constant)}
"""Cases that only scripts/test --slow runs."""
CASES = [
    pytest.param(guard, mutant, marks=[pytest.mark.slow] if (guard, mutant) in LONGEST else [])
    for guard in SCENARIOS
    for mutant in MUTANTS
]


@pytest.mark.parametrize(("guard", "mutant"), CASES)
def test_a_mutant_is_caught(guard, mutant):
    assert cap_fraction(guard, worst_factors(guard), **mutant(guard)) > 1.0005


def credit_transit_twice(heat):
    """Return a bound that subtracts the in-transit heat credit twice and lets it arrive half as fast."""
    return heat._replace(
        wall_transit_credit=2 * heat.wall_transit_credit,
        touch_transit_credit=2 * heat.touch_transit_credit,
        lower_bound_rate_per_s=0.5 * heat.lower_bound_rate_per_s,
    )


@pytest.mark.parametrize("guard", [pytest.param("wall", marks=pytest.mark.slow), "touch"])
def test_in_transit_heat_credited_twice_is_caught(guard):
    """Without uncertainty, so that no other margin hides it."""
    name, binding, _, _ = SCENARIOS[guard]
    exact = Uncertainty(**dict.fromkeys(Uncertainty.__dataclass_fields__, 0.0))
    heat = build_heat_bound(
        build_model(name), exact, NO_CAPS._replace(**binding), DISPLAYS[name].config.laser.max_power_w
    )
    assert 0.97 <= cap_fraction(guard, mutate=lambda budget: budget._replace(heat=heat)) <= 1 + 1e-9
    twice = credit_transit_twice(heat)
    assert cap_fraction(guard, mutate=lambda budget: budget._replace(heat=twice)) > 1.0005
