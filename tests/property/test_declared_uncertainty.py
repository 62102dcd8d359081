"""Every declared uncertainty counts: one after the other, declared alone, with the true display at either end of it."""

import numpy as np
import pytest

from optodrive.device.config_sections import DisplaySection, UncertaintySection
from optodrive.device.panel import Neighbours
from optodrive.planning.limiter.budget import Budget, GalvoModel, GalvoModels
from optodrive.planning.limiter.limiter import build_cold_budget_state, limit
from optodrive.planning.limiter.panel_bound import (
    NominalPanel,
    NominalThermalModel,
    NominalTouch,
    NominalWalls,
    Uncertainty,
)
from optodrive.planning.limiter.worst_case import build_heat_bound
from reference_models.thermal_display import NO_CAPS, TOUCHED, build_lasers, build_plan, build_true_display

FULL_W = 2.45
SECTION = DisplaySection(rows=2, columns=2, pitch_m=4e-3, bridge_width_m=4e-4)
NEIGHBOURS = Neighbours.from_display(SECTION)
MIRRORS = GalvoModels.from_models(GalvoModel(1e4, 0.7, 0.0, 1e3, 1e-3, 1.0, 0.0, 0.0, 0.0))
WEAK = ("gas_lag", "side_resistance")
"""Uncertainties with less effect than the bound's own margin: they reduce what is granted, which is all that shows."""
HALF_WIDTHS = dict.fromkeys(Uncertainty.__dataclass_fields__, 0.4) | {"exponent": 0.1}
MODEL = NominalThermalModel(
    epsilon=np.full(4, 0.66),
    r_k_per_w=np.full(4, 184.0),
    c_j_per_k=np.full(4, 126e-6),
    tau_g_s=0.01,
    ambient_k=293.15,
    exponent=0.0,
    neighbours=NEIGHBOURS.indices,
    frame_edges=NEIGHBOURS.frame_edges,
    walls=NominalWalls(20.0, 0.06, 430.0, 430.0),
    touch=NominalTouch(0.3, 0.4, 1.2),
    panel=NominalPanel(38.6, 0.9),
)


def drive(pixels, span_s, width_s, rest_s=1e-3):
    """Return pulses on pixels in turn, as rows of pixel, start and width."""
    period_s = width_s + rest_s
    return [(pixels[k % len(pixels)], round(k * period_s * 1e6) * 1e-6, width_s) for k in range(int(span_s / period_s))]


SCENARIOS = {
    "absorber": (dict(absorber_k=150.0), drive([0], 0.5, 0.010)),
    "wall": (dict(wall_k=8.0), drive([0], 5.0, 0.010)),
    "touched": (dict(touch_k=10.0), drive([0], 5.0, 0.010)),
    "panel": (dict(touch_k=15.0), drive([0, 1, 2, 3], 100.0, 0.005)),
}
"""Caps that bind, and pulses of full power."""


def limit_scenario(scenario, **half_widths):
    caps, rows = SCENARIOS[scenario]
    unsure, caps = Uncertainty(**dict.fromkeys(HALF_WIDTHS, 0.0) | half_widths), NO_CAPS._replace(**caps)
    budget = Budget(caps, build_heat_bound(MODEL, unsure, caps, FULL_W), MIRRORS, *build_lasers(2e-4))
    return limit(build_plan(rows, FULL_W, SECTION), build_cold_budget_state(4), budget)[0]


def compute_fraction(scenario, plan, name, sign):
    """Return the fraction of the caps that a display with its parameter at one end of its half-width reaches."""
    factor = sign * HALF_WIDTHS[name] + (0.0 if name == "exponent" else 1.0)
    peaks, caps = build_true_display(MODEL, {name: factor}).peaks(plan), NO_CAPS._replace(**SCENARIOS[scenario][0])
    touched_k = max(peaks[row] for row in TOUCHED)
    return max(peaks[0] / caps.absorber_k, peaks[2] / caps.wall_k, touched_k / caps.touch_k)


@pytest.fixture(scope="module")
def certain():
    return {scenario: limit_scenario(scenario) for scenario in SCENARIOS}


def test_the_configuration_declares_exactly_what_is_walked_over():
    assert set(UncertaintySection.model_fields) == set(HALF_WIDTHS)


@pytest.mark.parametrize("name", HALF_WIDTHS)
def test_a_declared_uncertainty_reduces_what_is_granted_and_covers_both_of_its_ends(name, certain):
    granted = []
    for scenario in SCENARIOS:
        plan = limit_scenario(scenario, **{name: HALF_WIDTHS[name]})
        granted.append(plan.energy_j.sum() / certain[scenario].energy_j.sum())
        for sign in (-1, 1):
            assert compute_fraction(scenario, plan, name, sign) <= 1 + 1e-9, (scenario, sign)
    assert min(granted) < 0.998


@pytest.mark.parametrize("name", [name for name in HALF_WIDTHS if name not in WEAK])
def test_a_limiter_that_ignores_one_uncertainty_is_caught(name, certain):
    assert (
        max(compute_fraction(scenario, certain[scenario], name, sign) for scenario in SCENARIOS for sign in (-1, 1))
        > 1.005
    )
