"""Every cap trims a case that nothing else trims: the same case without the cap passes."""

from dataclasses import replace
from math import inf
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from optodrive.core.errors import LocalProtocolError, OverBudgetError, RefusedError
from optodrive.core.types.plans import PulsePlan
from optodrive.planning.limiter import limiter
from optodrive.planning.limiter.budget import Budget, GalvoModel, GalvoModels
from optodrive.planning.limiter.caps import CAPS
from optodrive.planning.limiter.limiter import (
    build_cold_budget_state,
    commit_until,
    compute_wait_s,
    limit,
    shift_state,
    verify,
)
from optodrive.planning.limiter.panel_bound import (
    NominalThermalModel,
    NominalTouch,
    NominalWalls,
    Uncertainty,
    specht_ratio,
)
from optodrive.planning.limiter.workspace import PulseHistory, WindowChains, append, max_window_power_w
from optodrive.planning.limiter.worst_case import build_heat_bound
from reference_models.thermal_display import NO_CAPS, build_lasers

CERTAIN = Uncertainty(*[0.0] * len(Uncertainty.__dataclass_fields__))
MODEL = NominalThermalModel(
    epsilon=np.full(3, 0.66),
    r_k_per_w=np.full(3, 120.0 / 0.66),
    c_j_per_k=np.full(3, 0.023 / 120.0 * 0.66),
    tau_g_s=3e-3,
    ambient_k=293.15,
    exponent=0.0,
    neighbours=np.array([[-1, 1, -1, -1], [0, 2, -1, -1], [1, -1, -1, -1]]),
    frame_edges=np.zeros(3, dtype=np.int64),
    walls=NominalWalls(20.0, 0.06, 430.0, 430.0),
    touch=NominalTouch(0.3, 0.4, 1.2),
)
SERVO = GalvoModel(
    omega_rad_per_s=1e4,
    damping=0.7,
    delay_s=3e-5,
    slew_rad_per_s=100.0,
    lead_in_s=1e-3,
    averaging_s=1.0,
    rad_per_code=0.0,
    timing_slack_s=0.0,
    early_s=0.0,
)
LASERS = build_lasers(2e-4)


def build_budget(**caps):
    """Build a budget in which only the given caps bind."""
    caps = NO_CAPS._replace(**caps)
    return Budget(caps, build_heat_bound(MODEL, CERTAIN, caps, 2.45), GalvoModels.from_models(SERVO), *LASERS)


WITHOUT_CAPS = build_budget()


def pulses(*rows):
    """Build a plan from rows of (pixel, start_s, width_s, power_w). A pixel lies at its number times 10 mrad."""
    pixel, start, width, power = (np.array(column, dtype=float) for column in zip(*rows, strict=True))
    zero = np.zeros(len(rows))
    return PulsePlan(
        start_s=start,
        width_s=width,
        x_rad=0.01 * pixel,
        y_rad=zero,
        power_w=power,
        pixel=pixel.astype(np.int64),
        settling_s=zero,
        target_m=np.full(len(rows), np.nan),
        requested_start_s=start,
        source=np.zeros(len(rows), dtype=np.int64),
        stage=np.zeros(len(rows), dtype=np.int64),
    )


def run(budget, *rows, policy="trim"):
    return limit(pulses(*rows), build_cold_budget_state(3), budget, policy)[0]


CASES = {
    "absorber_temperature": (dict(absorber_k=150.0), [(0, 0.0, 0.050, 2.45)]),
    "pulse_energy": (dict(pulse_energy_j=0.050), [(0, 0.0, 0.040, 2.45)]),
    "spot_energy": (
        dict(pulse_energy_j=0.125, pixel_mean_w=1.3),
        [(0, 0.0, 0.040, 2.45), (0, 0.05, 0.040, 2.45)],
    ),
    "pixel_mean_power": (
        dict(pixel_mean_w=0.2),
        [(0, 0.0, 0.040, 2.45), (0, 0.1, 0.040, 2.45), (0, 0.2, 0.040, 2.45)],
    ),
    "display_mean_power": (
        dict(display_mean_w=0.1),
        [(0, 0.0, 0.040, 2.45), (1, 0.1, 0.040, 2.45), (2, 0.2, 0.040, 2.45)],
    ),
    "wall_temperature": (dict(wall_k=3.0), [(1, 0.06 * k, 0.050, 2.45) for k in range(3)]),
    "touch_temperature": (dict(touch_k=2.0), [(1, 0.06 * k, 0.050, 2.45) for k in range(2)]),
    "dim": (dict(power_share=0.5), [(0, 0.0, 0.020, 1.0), (1, 0.1, 0.020, 2.0)]),
    "galvo_acceleration": (dict(galvo_rad2_per_s4=1e7), [(0, 0.0, 0.001, 1.0), (2, 0.002, 0.001, 1.0)]),
    "pulse_width": ({}, [(0, 0.0, 0.030, 1.0), (0, 0.0302, 0.030, 1.0)]),
}


def test_every_cap_has_a_case():
    assert set(CASES) == {cap.key for cap in CAPS}


@pytest.mark.parametrize("cause", CASES)
def test_each_cap_trims_the_last_pulse_and_gives_its_reason(cause):
    caps, rows = CASES[cause]
    limited = run(build_budget(**caps), *rows)
    assert limited.reason[-1] == cause
    assert limited.trimmed_j[-1] > 0
    assert limited.energy_j[-1] + limited.trimmed_j[-1] == pytest.approx(rows[-1][2] * rows[-1][3])
    assert set(limited.reason[:-1]) <= {""}


@pytest.mark.parametrize("cause", CASES)
def test_without_its_cap_the_last_pulse_is_not_trimmed(cause):
    rows = CASES[cause][1]
    if cause == "pulse_width":
        assert run(build_budget(pulse_gap_s=1e-6), *rows).reason[-1] == ""
    else:
        assert run(WITHOUT_CAPS, *rows).reason[-1] == ""


@pytest.mark.parametrize("cause", CASES)
def test_refuse_names_pixel_and_cap(cause):
    caps, rows = CASES[cause]
    with pytest.raises(OverBudgetError, match=rf"pulse {len(rows) - 1} on pixel {rows[-1][0]} .*cap|bucket") as caught:
        run(build_budget(**caps), *rows, policy="refuse")
    refusal = caught.value
    assert (refusal.pixel, refusal.cap) == (rows[-1][0], cause)
    assert 0 < refusal.margin_j <= rows[-1][2] * rows[-1][3]


def test_refuse_reports_the_delay_after_which_the_plan_fits():
    budget = build_budget(touch_k=2.0)
    _, warm = limit(pulses((1, 0.0, 0.05, 2.45)), build_cold_budget_state(3), budget)
    again = pulses((1, 0.1, 0.05, 2.45))
    later_s = compute_wait_s(again, warm, budget)
    assert 0.01 < later_s < 10.0
    with pytest.raises(OverBudgetError, match=f"the whole fits {later_s:.3f} s later"):
        limit(again, warm, budget, "refuse")
    limit(pulses((1, 0.1 + later_s, 0.05, 2.45)), warm, budget, "refuse")
    with pytest.raises(OverBudgetError):
        limit(pulses((1, 0.1 + later_s - 0.002, 0.05, 2.45)), warm, budget, "refuse")


def test_a_plan_that_no_delay_makes_feasible_reports_an_infinite_delay():
    with pytest.raises(OverBudgetError, match="does not fit at any later time") as caught:
        run(build_budget(absorber_k=100.0), (0, 0.0, 0.05, 2.45), policy="refuse")
    assert caught.value.fits_after_s == inf


def test_nothing_is_trimmed_within_the_caps():
    limited = run(WITHOUT_CAPS, (0, 0.0, 0.02, 2.45), (1, 0.03, 0.02, 2.45))
    assert limited.trimmed_j.sum() == 0
    assert limited.reason.tolist() == ["", ""]


def test_the_absorber_cap_is_met_exactly_and_headroom_reaches_zero():
    budget = build_budget(absorber_k=150.0)
    limited = run(budget, (1, 0.0, 0.050, 2.45))
    own_k = 120.0 * limited.power_w[0] * (1 - np.exp(-0.050 / 0.023))
    wall_k = budget.heat.wall_k_per_j[0] * limited.energy_j[0] * budget.heat.absorber_wall_factor
    assert 149.95 < own_k + wall_k < 150.0  # the remainder is the bound on heat from neighbours
    assert limited.headroom_k == pytest.approx([150.0, 0.0, 150.0], abs=1e-6)


def test_a_model_without_walls_is_bounded_by_its_absorber_alone():
    caps = NO_CAPS._replace(absorber_k=150.0)
    bare = replace(MODEL, walls=None, touch=None)
    budget = Budget(caps, build_heat_bound(bare, CERTAIN, caps, 2.45), GalvoModels.from_models(SERVO), *LASERS)
    gentle = run(budget, (1, 0.0, 0.050, 1.0), (1, 9.0, 0.050, 1.0))
    assert gentle.trimmed_j.sum() == 0
    limited = run(budget, (1, 0.0, 0.050, 2.45), (0, 100.0, 0.050, 2.45))
    rise = 120.0 * limited.power_w * (1 - np.exp(-0.050 / 0.023))
    assert rise == pytest.approx([150.0, 150.0], rel=1e-9)


def test_a_pulse_wider_than_the_cap_is_refused_under_any_policy():
    with pytest.raises(RefusedError, match=r"60 ms wide, the cap is 50 ms"):
        run(WITHOUT_CAPS, (0, 0.0, 0.060, 1.0))


def test_state_carries_over_plans_and_pauses():
    budget = build_budget(absorber_k=200.0, display_mean_w=0.5)
    rows = [(k % 3, 0.06 * k + (0.3 if k > 5 else 0.0), 0.05, 2.45) for k in range(12)]
    whole = run(budget, *rows)
    state, power = build_cold_budget_state(3), []
    for row in rows:
        batch, state = limit(pulses(row), state, budget)
        power += batch.power_w.tolist()
    assert power == pytest.approx(whole.power_w.tolist(), rel=1e-12, abs=1e-12)


def test_a_shifted_state_gives_the_same_limits():
    budget = build_budget(absorber_k=150.0, pixel_mean_w=0.6)
    _, state = limit(pulses((0, 0.0, 0.05, 2.45)), build_cold_budget_state(3), budget)
    here, _ = limit(pulses((0, 0.07, 0.05, 2.45)), state, budget)
    there, _ = limit(pulses((0, 5.07, 0.05, 2.45)), shift_state(state, 5.0), budget)
    assert there.power_w == pytest.approx(here.power_w)


def test_a_plan_must_not_start_before_the_budgets_time():
    _, state = limit(pulses((0, 1.0, 0.05, 1.0)), build_cold_budget_state(3), WITHOUT_CAPS)
    with pytest.raises(RefusedError, match="before the budget's time"):
        limit(pulses((1, 0.5, 0.05, 1.0)), state, WITHOUT_CAPS)


def build_timed_pulses(plan, power_w):
    columns = {name: getattr(plan, name) for name in ("start_s", "width_s", "x_rad", "y_rad")}
    return SimpleNamespace(**columns, power_w=power_w)


def test_verification_passes_limited_pulses_and_rejects_others():
    budget = build_budget(absorber_k=150.0)
    plan = run(budget, (0, 0.0, 0.05, 2.45), (1, 0.06, 0.05, 2.45))
    verify(plan, np.arange(2), build_timed_pulses(plan, plan.power_w), build_cold_budget_state(3), budget)
    with pytest.raises(LocalProtocolError, match="encoded pulse 1 on pixel 1 passes a cap"):
        verify(
            plan,
            np.arange(2),
            build_timed_pulses(plan, plan.power_w * [1.0, 1.001]),
            build_cold_budget_state(3),
            budget,
        )


def test_a_dimmed_budget_passes_no_power_above_its_share():
    """Also the verification of the bytes refuses it. A share of 1 changes nothing."""
    plan = run(build_budget(power_share=0.5), (0, 0.0, 0.02, 2.45), (1, 0.06, 0.02, 1.0))
    assert plan.power_w.tolist() == [1.225, 1.0]
    bright = run(build_budget(power_share=1.0), (0, 0.0, 0.02, 2.45), (1, 0.06, 0.02, 1.0))
    assert bright.power_w.tolist() == [2.45, 1.0]
    cold = build_cold_budget_state(3)
    verify(bright, np.arange(2), bright, cold, build_budget(power_share=1.0))
    with pytest.raises(LocalProtocolError, match=r"passes a cap \(dim\)"):
        verify(bright, np.arange(2), bright, cold, build_budget(power_share=0.5))
    dark = run(build_budget(power_share=0.0), (0, 0.0, 0.02, 2.45))
    assert (dark.power_w.tolist(), dark.reason.tolist()) == ([0.0], ["dim"])


def test_only_executed_pulses_count():
    budget = build_budget(touch_k=5.0)
    plan, after = limit(pulses((0, 0.0, 0.05, 2.45), (1, 0.1, 0.05, 2.45)), build_cold_budget_state(3), budget)
    first_only = commit_until(plan, 0.1, build_cold_budget_state(3), budget)
    assert first_only.touch_k[0].max() > 0.5
    assert first_only.touch_k[1].max() == 0.0
    assert after.touch_k[1].max() > 0.5


def test_the_state_does_not_grow_with_the_number_of_pulses():
    budget, state = build_budget(pixel_mean_w=1.3, touch_k=20.0), build_cold_budget_state(3)
    sizes = []
    for k in range(30):
        train = pulses(*[(n % 3, 100.0 * k + 0.01 * n, 0.005, 2.45) for n in range(1000)])
        state = limit(train, state, budget)[1]
        sizes.append(sum(column.nbytes for column in vars(state).values() if isinstance(column, np.ndarray)))
    assert max(sizes[1:]) == min(sizes[1:])


def test_a_sum_of_decays_exceeds_its_ends_by_at_most_the_specht_ratio():
    rng = np.random.default_rng(3)
    for half in (0.05, 0.3, 0.5):
        capacities = np.linspace(1 - half, 1 + half, 201)
        for _ in range(50):
            ages, energies = rng.uniform(0, 6, 8), rng.uniform(0, 1, 8)
            rise = (energies / capacities[:, None] * np.exp(-ages / capacities[:, None])).sum(axis=1)
            assert rise.max() <= specht_ratio((1 + half) / (1 - half)) * max(rise[0], rise[-1])


def search_max_power_w(window_s, cap_j, rows, start, width):
    """Find the largest power by checking every window end on a fine grid."""
    ends = np.linspace(start, start + width, 4001)[1:]
    used = np.zeros(4000)
    for s, w, p in rows:
        used += p * np.maximum(0.0, np.minimum(ends, s + w) - np.maximum(ends - window_s, s))
    return ((cap_j - used) / (ends - start)).min()


def test_the_energy_window_agrees_with_an_exhaustive_search():
    rng = np.random.default_rng(5)
    for _ in range(15):
        history = PulseHistory(*np.zeros((3, 12)), *np.zeros((2, 12), dtype=np.int64), np.zeros(1, dtype=np.int64))
        chain = WindowChains(np.full(1, -1), np.full(1, -1), np.zeros(1), np.full(12, -1), np.zeros(12))
        time, rows = 0.0, []
        for row in range(12):
            time += rng.uniform(0.0, 0.1)
            width, power = rng.uniform(0.001, 0.05), rng.uniform(0.0, 4.0)
            exact = max_window_power_w(chain, 0, history, time, width, 0.5, 1.0)
            tried = search_max_power_w(0.5, 0.5, rows, time, width)
            assert exact <= tried * (1 + 1e-9) + 1e-9
            assert exact == pytest.approx(tried, rel=2e-2, abs=2e-2)
            power = max(0.0, min(power, exact))
            history.start_s[row], history.width_s[row], history.power_w[row] = time, width, power
            append(chain, 0, history, row)
            rows.append((time, width, power))
            time += width


def compute_pwm_energy_j(width_s, duty, period_s=2e-4, full_w=2.45):
    """Return the energy of a pulse on a laser with a PWM that begins with the pulse."""
    whole, rest_s = divmod(width_s + 1e-12, period_s)
    return full_w * (whole * duty * period_s + min(rest_s, duty * period_s))


@given(width_us=st.integers(200, 40_000), share=st.floats(0.05, 0.999))
@example(width_us=201, share=0.5)
def test_a_pulse_trimmed_within_a_period_of_the_pwm_keeps_the_cap(width_us, share):
    width_s = 1e-6 * width_us
    cap_j = share * 2.45 * width_s
    plan, _ = limit(pulses((0, 0.01, width_s, 2.45)), build_cold_budget_state(3), build_budget(pulse_energy_j=cap_j))
    energy_j = compute_pwm_energy_j(width_s, plan.power_w[0] / 2.45)
    assert energy_j <= cap_j * (1.0 + 1e-6)
    assert energy_j >= 0.99 * cap_j


@pytest.mark.parametrize("width_s", [0.3e-3, 1.1e-3, 1.19e-3, 2.05e-3])
@pytest.mark.parametrize("share", [0.2, 0.6, 0.99])
def test_of_a_laser_with_a_curve_a_part_of_a_period_counts_as_a_whole_one(width_s, share):
    """When in a period it emits is not known."""
    energy_j = share * 2.45 * width_s
    budget = build_budget(pulse_energy_j=energy_j)._replace(is_proportional=np.array([False]))
    plan, _ = limit(pulses((0, 0.01, width_s, 2.45)), build_cold_budget_state(3), budget)
    periods = np.ceil(width_s / 2e-4 - 1e-9)
    assert plan.power_w[0] * periods * 2e-4 == pytest.approx(energy_j, rel=1e-6)


def test_a_limiter_without_regard_to_split_periods_is_caught(monkeypatch):
    """Mutant: the mean power counts for any width."""
    monkeypatch.setattr(limiter, "_allow_for_split_period", lambda plan, power_w, budget: power_w)
    plan, _ = limit(pulses((0, 0.01, 1.1e-3, 2.45)), build_cold_budget_state(3), build_budget(pulse_energy_j=1.35e-3))
    assert compute_pwm_energy_j(1.1e-3, plan.power_w[0] / 2.45) > 1.03 * 1.35e-3
