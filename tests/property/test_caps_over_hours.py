"""The shipped displays driven for as long as their panel warms, judged by an integrator that shares no code.

Everything that a finger can touch has the touch cap: the touch surfaces, which the panel shifts as a whole, the walls
between the pixels, and the panel itself.
"""

import pytest

from displays import DISPLAYS
from optodrive.planning.limiter.limiter import build_cold_budget_state, concatenate, limit
from optodrive.planning.limiter.panel_bound import Uncertainty
from optodrive.planning.limiter.worst_case import build_heat_bound
from reference_models.shipped_display import build_model, build_worst_factors
from reference_models.thermal_display import TOUCHED, build_plan, build_true_display

HOUR_S = 3600.0
REST_S = 1.2e-3
BATCH = 20_000
FULL_W = 2.45
MINUTES = 0.13
"""Eight minutes, in hours: three time constants of the smallest panels."""


def visit(pixels, span_s, width_s, begin_s):
    """Return pulses on pixels in turn, one after the other, as rows of pixel, start and width."""
    period_s = width_s + REST_S
    return [
        (pixels[k % len(pixels)], round((begin_s + k * period_s) * 1e6) * 1e-6, width_s)
        for k in range(int(span_s / period_s))
    ]


def warm_and_hammer(name, hours):
    """Warm the panel by all pixels, then drive one, then all again with short pulses."""
    count = len(DISPLAYS[name].pixels)
    everything, span_s = list(range(count)), hours * HOUR_S / 4.0
    rows = visit(everything, 2.0 * span_s, 0.020, 0.001)
    rows += visit([count // 2], span_s, 0.010, rows[-1][1] + 0.05)
    return rows + visit(everything, span_s, 0.003, rows[-1][1] + 0.05)


def limit_all(name, rows, budget):
    """Limit full-power pulses in batches from a cold display."""
    display = DISPLAYS[name]
    state, parts = build_cold_budget_state(len(display.pixels)), []
    for begin in range(0, len(rows), BATCH):
        part, state = limit(build_plan(rows[begin : begin + BATCH], FULL_W, display.config.display), state, budget)
        parts.append(part)
    return concatenate(parts, state, budget)


def compute_fractions(name, plan, factors):
    """Return the largest value over each cap that an executed plan reaches on the true display."""
    peaks, caps = build_true_display(build_model(name), factors).peaks(plan, dark_s=10.0), DISPLAYS[name].budget.caps
    return {
        "absorber": peaks[0] / caps.absorber_k,
        "wall": peaks[2] / caps.wall_k,
        "touched": max(peaks[row] for row in TOUCHED) / caps.touch_k,
        "panel": peaks[4] / caps.touch_k,
    }


def judge(name, hours, capacity_sign, mutate=lambda name, budget: budget):
    """Limit the sequence by a budget. Return the fraction of each cap that the worst true display reaches."""
    plan = limit_all(name, warm_and_hammer(name, hours), mutate(name, DISPLAYS[name].budget))
    return compute_fractions(name, plan, build_worst_factors(name, capacity_sign))


@pytest.mark.parametrize("name", ["display-1", "display-16"])
def test_no_cap_is_exceeded_while_a_small_panel_warms(name):
    """Within eight minutes both come to a cap: display-1 to its absorber's, display-16 to that of touched surfaces."""
    fractions = judge(name, MINUTES, -1)
    assert 0.95 <= max(fractions.values()) <= 1 + 1e-9, fractions


@pytest.mark.slow
@pytest.mark.timeout(7200)
@pytest.mark.parametrize("capacity_sign", [-1, 1])
@pytest.mark.parametrize("name", DISPLAYS)
def test_no_cap_is_exceeded_over_hours_of_a_shipped_display(name, capacity_sign):
    """An hour is fourteen time constants of every panel, two for the displays that come to its cap."""
    fractions = judge(name, 2.0 if len(DISPLAYS[name].pixels) <= 16 else 1.0, capacity_sign)
    assert max(fractions.values()) <= 1 + 1e-9, fractions


def pass_on_the_shares(name, budget):
    """Mutant: a touch surface follows only its shares of the panel."""
    touch = build_model(name).touch
    shares = touch.gas_share + touch.wall_share
    return budget._replace(heat=budget.heat._replace(touch_per_panel=shares * budget.heat.touch_per_panel))


def ignore_the_exponent(name, budget):
    """Mutant: bridges of a parameter set without bridge_conductivity are certain to conduct alike when hot."""
    config = DISPLAYS[name].config
    unsure = Uncertainty(**config.limits.uncertainty.model_dump() | {"exponent": 0.0})
    return budget._replace(heat=build_heat_bound(build_model(name), unsure, budget.caps, config.laser.max_power_w))


MUTANTS = {
    "touched": ("display-16", pass_on_the_shares),
    "absorber": ("display-1", ignore_the_exponent),
}


@pytest.mark.parametrize("cap", MUTANTS)
def test_a_mutant_is_caught(cap):
    name, mutate = MUTANTS[cap]
    assert judge(name, MINUTES, -1, mutate)[cap] > 1.002
