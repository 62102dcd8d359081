"""Each cap has a test that its removal breaks: `test_a_cap_taken_away_is_noticed` proves it."""

from dataclasses import replace

import numpy as np
import pytest

from optodrive.errors import LocalProtocolError, RefusedError
from optodrive.flow import PulsePlan
from optodrive.limit.budget import Budget, EnergyWindow
from optodrive.limit.limiter import fresh_state, limit, shifted, verify

ROOMY = Budget(
    gain_k_per_w=np.full(3, 120.0),
    tau_s=np.full(3, 0.023),
    rise_cap_k=1e6,
    pulse_energy_max_j=1e3,
    pulse_width_max_s=0.050,
    pulse_rest_min_s=5e-4,
    pixel_mean_power_max_w=1e3,
    pixel_mean_window_s=1.0,
    display_mean_power_max_w=1e3,
    display_mean_window_s=2.0,
)


def pulses(*rows):
    """Rows of (pixel, start_s, width_s, power_w)."""
    pixel, start, width, power = (np.array(column, dtype=float) for column in zip(*rows, strict=True))
    zero = np.zeros(len(rows))
    return PulsePlan(
        start_s=start,
        width_s=width,
        x_rad=zero,
        y_rad=zero,
        power_w=power,
        pixel=pixel.astype(np.int64),
        settle_s=zero,
        target_m=np.full(len(rows), np.nan),
        nominal_s=start,
        source=np.zeros(len(rows), dtype=np.int64),
    )


def run(budget, *rows, policy="trim"):
    return limit(pulses(*rows), fresh_state(3), budget, policy)[0]


CASES = {
    "absorber_temperature": (dict(rise_cap_k=150.0), [(0, 0.0, 0.050, 2.45)]),
    "pulse_energy": (dict(pulse_energy_max_j=0.050), [(0, 0.0, 0.040, 2.45)]),
    "spot_energy": (
        dict(pulse_energy_max_j=0.125, pixel_mean_power_max_w=1.3),
        [(0, 0.0, 0.040, 2.45), (0, 0.05, 0.040, 2.45)],
    ),
    "pixel_mean_power": (
        dict(pixel_mean_power_max_w=0.2),
        [(0, 0.0, 0.040, 2.45), (0, 0.1, 0.040, 2.45), (0, 0.2, 0.040, 2.45)],
    ),
    "display_mean_power": (
        dict(display_mean_power_max_w=0.1),
        [(0, 0.0, 0.040, 2.45), (1, 0.1, 0.040, 2.45), (2, 0.2, 0.040, 2.45)],
    ),
    "pulse_width": ({}, [(0, 0.0, 0.030, 1.0), (0, 0.0302, 0.030, 1.0)]),
}


@pytest.mark.parametrize("cause", CASES)
def test_each_cap_trims_the_last_pulse_and_gives_its_reason(cause):
    caps, rows = CASES[cause]
    limited = run(replace(ROOMY, **caps), *rows)
    assert limited.reason[-1] == cause
    assert limited.trimmed_j[-1] > 0
    assert limited.energy_j[-1] + limited.trimmed_j[-1] == pytest.approx(rows[-1][2] * rows[-1][3])
    assert set(limited.reason[:-1]) <= {""}


@pytest.mark.parametrize("cause", CASES)
def test_a_cap_taken_away_is_noticed(cause):
    rows = CASES[cause][1]
    if cause == "pulse_width":
        assert run(replace(ROOMY, pulse_rest_min_s=1e-6), *rows).reason[-1] == ""
    else:
        assert run(ROOMY, *rows).reason[-1] == ""


@pytest.mark.parametrize("cause", CASES)
def test_refuse_names_pixel_and_cap(cause):
    caps, rows = CASES[cause]
    with pytest.raises(RefusedError, match=rf"pulse {len(rows) - 1} on pixel {rows[-1][0]} .*cap|bucket"):
        run(replace(ROOMY, **caps), *rows, policy="refuse")


def test_nothing_is_trimmed_inside_the_caps():
    limited = run(ROOMY, (0, 0.0, 0.02, 2.45), (1, 0.03, 0.02, 2.45))
    assert limited.trimmed_j.sum() == 0
    assert limited.reason.tolist() == ["", ""]


def test_the_temperature_cap_is_met_exactly_and_headroom_reaches_zero():
    budget = replace(ROOMY, rise_cap_k=150.0)
    limited = run(budget, (1, 0.0, 0.050, 2.45))
    rise = 120.0 * limited.power_w[0] * (1 - np.exp(-0.050 / 0.023))
    assert rise == pytest.approx(150.0, rel=1e-12)
    assert limited.headroom_k == pytest.approx([150.0, 0.0, 150.0])


def test_a_pulse_wider_than_the_cap_is_refused_under_any_policy():
    with pytest.raises(RefusedError, match=r"60\.000 ms wide, the cap is 50\.000 ms"):
        run(ROOMY, (0, 0.0, 0.060, 1.0))


def test_state_goes_on_over_plans_and_pauses():
    budget = replace(ROOMY, rise_cap_k=200.0, display_mean_power_max_w=0.5)
    rows = [(k % 3, 0.06 * k + (0.3 if k > 5 else 0.0), 0.05, 2.45) for k in range(12)]
    whole = run(budget, *rows)
    state, power = fresh_state(3), []
    for row in rows:
        piece, state = limit(pulses(row), state, budget)
        power += piece.power_w.tolist()
    assert power == pytest.approx(whole.power_w.tolist(), rel=1e-12, abs=1e-12)


def test_a_state_moved_in_time_limits_the_same():
    budget = replace(ROOMY, rise_cap_k=150.0, pixel_mean_power_max_w=0.6)
    _, state = limit(pulses((0, 0.0, 0.05, 2.45)), fresh_state(3), budget)
    here, _ = limit(pulses((0, 0.07, 0.05, 2.45)), state, budget)
    there, _ = limit(pulses((0, 5.07, 0.05, 2.45)), shifted(state, 5.0), budget)
    assert there.power_w == pytest.approx(here.power_w)


def test_a_plan_may_not_start_in_the_past_of_the_budget():
    _, state = limit(pulses((0, 1.0, 0.05, 1.0)), fresh_state(3), ROOMY)
    with pytest.raises(RefusedError, match="before the budget's time"):
        limit(pulses((1, 0.5, 0.05, 1.0)), state, ROOMY)


def test_proof_before_emission_passes_what_was_limited_and_catches_what_was_not():
    budget = replace(ROOMY, rise_cap_k=150.0)
    plan = run(budget, (0, 0.0, 0.05, 2.45), (1, 0.06, 0.05, 2.45))
    columns = [plan.start_s, plan.width_s, plan.power_w]
    verify([0, 1], *columns, fresh_state(3), budget)
    with pytest.raises(LocalProtocolError, match="encoded pulse 1 on pixel 1 passes a cap"):
        verify([0, 1], *columns[:2], plan.power_w * [1.0, 1.001], fresh_state(3), budget)


def brute_allowed(window_s, cap_j, rows, start, width):
    """Largest power found by trying every window end on a fine grid."""
    ends = np.linspace(start, start + width, 4001)[1:]
    best = np.inf
    for end in ends:
        used = sum(p * max(0.0, min(end, s + w) - max(end - window_s, s)) for s, w, p in rows)
        best = min(best, (cap_j - used) / (end - start))
    return best


def test_energy_window_agrees_with_trying_every_window():
    rng = np.random.default_rng(5)
    for _ in range(30):
        window, time, rows = EnergyWindow(0.5, 1.0), 0.0, []
        for _ in range(12):
            time += rng.uniform(0.0, 0.1)
            width, power = rng.uniform(0.001, 0.05), rng.uniform(0.0, 4.0)
            exact = window.allowed_w(time, width)
            tried = brute_allowed(0.5, 0.5, rows, time, width)
            assert exact <= tried * (1 + 1e-9) + 1e-9
            assert exact == pytest.approx(tried, rel=2e-2, abs=2e-2)
            power = max(0.0, min(power, exact))
            window.add(time, width, power)
            rows.append((time, width, power))
            time += width
