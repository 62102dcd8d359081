"""How near each cap is, against what the limiter itself allows."""

from types import SimpleNamespace

import numpy as np
import pytest

from optodrive.device.config import load_config
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.limiter.limiter import cold_state, commit_executed, shift_state
from optodrive.planning.limiter.usage import compute_usage

DISPLAY = DisplayModel.from_config(load_config("display-16"))
BUDGET = DISPLAY.budget


def train(pixel=5, count=20, start_s=0.1, width_s=0.02, gap_s=0.02, power_w=2.0):
    start = start_s + (width_s + gap_s) * np.arange(count)
    pulses = SimpleNamespace(
        start_s=start,
        width_s=np.full(count, width_s),
        power_w=np.full(count, power_w),
        x_rad=np.zeros(count),
        y_rad=np.zeros(count),
    )
    state = commit_executed(np.full(count, pixel), pulses, cold_state(len(DISPLAY.pixels)), BUDGET)
    return state, float(start[-1] + width_s)


def of(state, at_s):
    return {item.cap: item for item in compute_usage(state, BUDGET, at_s)}


def test_a_display_at_rest_uses_nothing():
    assert all(item.used == 0.0 for item in compute_usage(cold_state(len(DISPLAY.pixels)), BUDGET, 100.0))


def test_mean_powers_are_the_energy_within_their_windows():
    state, end_s = train()
    seen, caps = of(state, end_s), BUDGET.caps
    energy_j = 20 * 0.02 * 2.0
    assert seen["pixel_mean_power"].used == pytest.approx(energy_j / caps.pixel_window_s)
    assert seen["pixel_mean_power"].pixel == 5
    assert seen["display_mean_power"].used == pytest.approx(energy_j / caps.display_window_s)
    half_gone = of(state, end_s + caps.pixel_window_s - 0.39)
    assert half_gone["pixel_mean_power"].used == pytest.approx(0.5 * energy_j / caps.pixel_window_s, rel=0.06)
    assert of(state, end_s + caps.display_window_s)["display_mean_power"].used == 0.0


def test_the_absorber_is_bounded_from_above_at_its_hottest_and_cools():
    state, end_s = train()
    heat = DISPLAY.build_cold_heat()
    start = 0.1 + 0.04 * np.arange(20)
    heat.apply_pulses(np.full(20, 5), start, np.full(20, 0.02), np.full(20, 2.0))
    warm = of(state, end_s)["absorber_temperature"]
    assert warm.pixel == 5
    assert warm.used >= heat.state_at(end_s).absorber_k[5] > 10.0
    used = [of(state, end_s + later_s)["absorber_temperature"].used for later_s in (0.0, 0.05, 0.5, 60.0)]
    assert used == sorted(used, reverse=True)
    assert used[-1] < 0.1


def test_asking_changes_nothing_and_the_past_counts_as_the_states_own_time():
    state, end_s = train()
    before = compute_usage(state, BUDGET, end_s)
    compute_usage(state, BUDGET, end_s + 50.0)
    assert compute_usage(state, BUDGET, end_s) == before
    assert compute_usage(state, BUDGET, 0.0) == compute_usage(state, BUDGET, state.at_s)


def test_what_is_counted_moves_with_the_clock():
    state, end_s = train()
    moved = of(shift_state(state, 7.0), end_s + 7.0)
    for cap, item in of(state, end_s).items():
        assert moved[cap].used == pytest.approx(item.used, rel=1e-6, abs=1e-9)


def test_counted_goes_on_from_chunk_to_chunk_as_in_one():
    whole, end_s = train(count=20)
    first, _ = train(count=10)
    rest = 0.1 + 0.04 * np.arange(10, 20)
    columns = dict(x_rad=np.zeros(10), y_rad=np.zeros(10), start_s=rest, width_s=np.full(10, 0.02))
    second = commit_executed(np.full(10, 5), SimpleNamespace(**columns, power_w=np.full(10, 2.0)), first, BUDGET)
    for one, other in zip(compute_usage(whole, BUDGET, end_s), compute_usage(second, BUDGET, end_s), strict=True):
        assert other.used == pytest.approx(one.used, rel=1e-6, abs=1e-9)
