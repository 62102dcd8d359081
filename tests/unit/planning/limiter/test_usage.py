"""Usage of each cap against the limiter and the physics."""

from types import SimpleNamespace

import numpy as np
import pytest

from optodrive.device.config_file import load_config
from optodrive.device.panel import complete_panel
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.limiter.cap_checks import compute_panel_k, compute_usage
from optodrive.planning.limiter.limiter import build_cold_budget_state, commit_executed, shift_state

DISPLAY = DisplayModel.from_config(load_config("display-16"))
BUDGET = DISPLAY.budget


def build_train_state(pixel=5, count=20, start_s=0.1, width_s=0.02, gap_s=0.02, power_w=2.0):
    start = start_s + (width_s + gap_s) * np.arange(count)
    pulses = SimpleNamespace(
        start_s=start,
        width_s=np.full(count, width_s),
        power_w=np.full(count, power_w),
        x_rad=np.zeros(count),
        y_rad=np.zeros(count),
    )
    state = commit_executed(
        np.full(count, pixel), np.zeros(count, int), pulses, build_cold_budget_state(len(DISPLAY.pixels)), BUDGET
    )
    return state, float(start[-1] + width_s)


def of(state, at_s):
    return {item.cap: item for item in compute_usage(state, BUDGET, at_s)}


def test_a_cold_display_uses_nothing():
    assert all(item.used == 0.0 for item in compute_usage(build_cold_budget_state(len(DISPLAY.pixels)), BUDGET, 100.0))


def test_mean_powers_are_the_energy_within_their_windows():
    state, end_s = build_train_state()
    used, caps = of(state, end_s), BUDGET.caps
    energy_j = 20 * 0.02 * 2.0
    assert used["pixel_mean_power"].used == pytest.approx(energy_j / caps.pixel_window_s)
    assert used["pixel_mean_power"].pixel == 5
    assert used["display_mean_power"].used == pytest.approx(energy_j / caps.display_window_s)
    half_gone = of(state, end_s + caps.pixel_window_s - 0.39)
    assert half_gone["pixel_mean_power"].used == pytest.approx(0.5 * energy_j / caps.pixel_window_s, rel=0.06)
    assert of(state, end_s + caps.display_window_s)["display_mean_power"].used == 0.0


def test_the_absorber_usage_is_an_upper_bound_and_decreases():
    state, end_s = build_train_state()
    heat = DISPLAY.build_cold_heat()
    start = 0.1 + 0.04 * np.arange(20)
    heat.apply_pulses(np.full(20, 5), start, np.full(20, 0.02), np.full(20, 2.0))
    warm = of(state, end_s)["absorber_temperature"]
    assert warm.pixel == 5
    assert warm.used >= heat.state_at(end_s).absorber_k[5] > 10.0
    used = [of(state, end_s + later_s)["absorber_temperature"].used for later_s in (0.0, 0.05, 0.5, 60.0, 1800.0)]
    assert used == sorted(used, reverse=True)
    assert used[-2] < 0.2  # the panel is warm for minutes
    assert used[-1] < 1e-3


def test_reading_usage_changes_nothing_and_earlier_times_count_as_the_states_time():
    state, end_s = build_train_state()
    before = compute_usage(state, BUDGET, end_s)
    compute_usage(state, BUDGET, end_s + 50.0)
    assert compute_usage(state, BUDGET, end_s) == before
    assert compute_usage(state, BUDGET, 0.0) == compute_usage(state, BUDGET, state.at_s)


def test_usage_shifts_with_the_time_line():
    state, end_s = build_train_state()
    shifted = of(shift_state(state, 7.0), end_s + 7.0)
    for cap, item in of(state, end_s).items():
        assert shifted[cap].used == pytest.approx(item.used, rel=1e-6, abs=1e-9)


def test_usage_in_parts_equals_usage_at_once():
    whole, end_s = build_train_state(count=20)
    first, _ = build_train_state(count=10)
    rest = 0.1 + 0.04 * np.arange(10, 20)
    columns = dict(x_rad=np.zeros(10), y_rad=np.zeros(10), start_s=rest, width_s=np.full(10, 0.02))
    second = commit_executed(
        np.full(10, 5), np.zeros(10, int), SimpleNamespace(**columns, power_w=np.full(10, 2.0)), first, BUDGET
    )
    for one, other in zip(compute_usage(whole, BUDGET, end_s), compute_usage(second, BUDGET, end_s), strict=True):
        assert other.used == pytest.approx(one.used, rel=1e-6, abs=1e-9)


def test_the_panel_warms_by_the_energy_over_its_capacity_and_cools_through_its_resistance():
    state, end_s = build_train_state()
    panel = complete_panel(DISPLAY.config)
    absorbed_j = 20 * 0.02 * 2.0 * float(DISPLAY.pixels.epsilon[5])
    rise_k = absorbed_j / panel.capacity_j_per_k
    tau_s = panel.resistance_k_per_w * panel.capacity_j_per_k
    for taus in (0.0, 1.0, 5.0):
        bound_k = compute_panel_k(shift_state(state, 5.0), BUDGET, end_s + 5.0 + taus * tau_s)
        assert rise_k * np.exp(-taus) < bound_k < 1.4 * rise_k * np.exp(-taus / 1.5), taus
