"""Beams of several stages over one display, of which the limiter must forget none, and mutants that do.

The general property, with one to four stages and clocks that differ, is in test_limiter_caps.py.
"""

import numpy as np
import pytest

from optodrive.core.errors import RefusedError
from optodrive.core.types.plans import PulsePlan
from optodrive.device.config import DisplaySection
from optodrive.device.panel import Neighbours
from optodrive.planning.limiter.budget import Budget, GalvoModel, GalvoModels
from optodrive.planning.limiter.heat_bound import panel_rise_by_others_k
from optodrive.planning.limiter.limiter import build_cold_budget_state, concatenate, limit
from optodrive.planning.limiter.panel_bound import NominalPanel, NominalThermalModel, NominalWalls, Uncertainty
from optodrive.planning.limiter.worst_case import build_heat_bound
from reference_models.thermal_display import NO_CAPS, build_lasers, build_plan, build_true_display

FULL_W = 2.45
SECTION = DisplaySection(rows=2, columns=2, pitch_m=4e-3, bridge_width_m=4e-4)
NEIGHBOURS = Neighbours.from_display(SECTION)
CERTAIN = Uncertainty(**dict.fromkeys(Uncertainty.__dataclass_fields__, 0.0))
FAST_MIRRORS = GalvoModel(1e4, 0.7, 0.0, 1e3, 1e-3, 1.0, 0.0, 0.0, 0.0)
STAGES = 4


def build_model(lateral_k_per_w, panel):
    """Build four pixels, one per stage, whose walls exchange heat or share a panel."""
    return NominalThermalModel(
        epsilon=np.full(4, 0.66),
        r_k_per_w=np.full(4, 184.0),
        c_j_per_k=np.full(4, 126e-6),
        tau_g_s=3e-3,
        ambient_k=293.15,
        exponent=0.0,
        neighbours=NEIGHBOURS.indices,
        frame_edges=NEIGHBOURS.frame_edges,
        walls=NominalWalls(20.0, 0.06, lateral_k_per_w, np.inf),
        touch=None,
        panel=panel,
    )


CASES = {
    "walls": (build_model(100.0, None), 20.0, 8.0),
    "panel": (build_model(np.inf, NominalPanel(30.0, 0.5)), 60.0, 60.0),
}
"""Model, cap of the walls in K, and time of the drive in s."""


def build_budget(name):
    model, cap_k, _ = CASES[name]
    caps = NO_CAPS._replace(wall_k=cap_k)
    heat = build_heat_bound(model, CERTAIN, caps, *[FULL_W] * STAGES)
    return Budget(caps, heat, GalvoModels.from_models(*[FAST_MIRRORS] * STAGES), *build_lasers(1e-6, STAGES))


def build_drive(name):
    """Drive every pixel by a stage of its own, all at the same time."""
    starts = np.arange(0.01, CASES[name][2], 0.04)
    rows = [(pixel, start + 1e-3 * pixel, 0.03) for start in starts for pixel in range(4)]
    return build_plan(rows, FULL_W, SECTION, [pixel for pixel, _, _ in rows])


def select(plan, rows):
    return PulsePlan(**{name: getattr(plan, name)[rows] for name in PulsePlan.__dataclass_fields__})


def compute_wall_share(name, plan):
    """Return the warmest wall of the integrator over the cap."""
    model, cap_k, _ = CASES[name]
    return float(build_true_display(model).peaks(plan)[2]) / cap_k


@pytest.mark.parametrize("name", CASES)
def test_all_stages_together_come_close_to_the_cap_and_not_above(name):
    budget = build_budget(name)
    limited, _ = limit(build_drive(name), build_cold_budget_state(4, stage_count=STAGES), budget)
    assert limited.trimmed_j.any()
    assert 0.88 <= compute_wall_share(name, limited) <= 1 + 1e-9


@pytest.mark.parametrize("name", CASES)
def test_a_limiter_per_stage_is_caught(name):
    """Mutant: each stage has a thermal state of its own."""
    budget, drive = build_budget(name), build_drive(name)
    parts = [
        limit(select(drive, drive.stage == stage), build_cold_budget_state(4, stage_count=STAGES), budget)
        for stage in range(STAGES)
    ]
    apart = concatenate([part for part, _ in parts], parts[0][1], budget)
    order = np.argsort(apart.start_s, kind="stable")
    assert compute_wall_share(name, select(apart, order)) > 1.05


def test_a_pulse_leaves_room_for_what_others_warm_the_panel_meanwhile():
    """Pulses of other stages that begin during a pulse are limited after it."""
    heat = build_budget("panel").heat
    others_j = (STAGES - 1) * FULL_W * 0.05
    reserved_k = panel_rise_by_others_k(heat, 0, 0.05)
    assert reserved_k == pytest.approx(heat.panel_specht_ratio * heat.panel_k_per_j[0] * others_j)
    assert panel_rise_by_others_k(heat._replace(power_max_w=np.array([FULL_W])), 0, 0.05) == 0.0


def limit_two_stages(starts_s, stages):
    """Limit four pulses on pixels of their own by the mean power of a laser."""
    caps = NO_CAPS._replace(display_mean_w=0.5, display_window_s=0.5)
    plan = build_plan([(k, start_s, 0.05) for k, start_s in enumerate(starts_s)], FULL_W, SECTION, stages)
    state = build_cold_budget_state(4, stage_count=STAGES)
    return limit(plan, state, build_budget("walls")._replace(caps=caps))[0]


def test_the_mean_power_of_a_laser_does_not_count_the_others():
    assert not limit_two_stages((0.0, 0.01, 0.1, 0.16), [0, 1, 0, 1]).trimmed_j.any()
    assert limit_two_stages((0.0, 0.06, 0.12, 0.18), [0, 0, 0, 0]).trimmed_j.any()


def test_pulses_of_one_stage_do_not_overlap():
    with pytest.raises(RefusedError, match="starts before"):
        limit_two_stages((0.0, 0.01, 0.1, 0.16), [0, 0, 1, 1])
