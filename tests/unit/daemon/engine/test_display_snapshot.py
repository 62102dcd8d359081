"""Live thermal state: agreement with the display model, clock shifts and out-of-order pulses."""

import numpy as np
import pytest

from optodrive.daemon.engine.telemetry_events import EmittedPulses, LiveThermalState, join_in_order
from optodrive.device.config_file import load_config
from optodrive.planning.display_model import DisplayModel

DISPLAY = DisplayModel.from_config(load_config("display-16"))


def executed(pixel, start_s, width_s=0.01, power_w=2.0):
    pixel, start_s = np.atleast_1d(pixel), np.atleast_1d(np.asarray(start_s, dtype=float))
    count = len(pixel)
    zeros = np.zeros(count)
    columns = pixel, start_s, np.full(count, width_s), np.full(count, power_w), zeros, zeros
    return EmittedPulses(*columns, stage=np.zeros(count, dtype=np.int64))


def shares(live, at_s):
    return {item.cap: item.used / item.limit for item in live.compute_usage(at_s)}


def test_single_reports_equal_one_batch():
    pixel, start_s = np.array([1, 5, 1, 9]), np.array([1.0, 1.1, 1.2, 1.3])
    stepwise, batch = LiveThermalState(DISPLAY), LiveThermalState(DISPLAY)
    batch.apply(executed(pixel, start_s))
    for row in range(len(pixel)):
        stepwise.apply(executed(pixel[row], start_s[row]))
    heat = DISPLAY.build_cold_heat()
    heat.apply_pulses(pixel, start_s, np.full(4, 0.01), np.full(4, 2.0))
    for live in (stepwise, batch):
        assert live.state_at(1.32).displacement_m == pytest.approx(heat.state_at(1.32).displacement_m)
    assert shares(stepwise, 1.32) == pytest.approx(shares(batch, 1.32), rel=1e-6, abs=1e-9)
    assert shares(batch, 1.32)["pixel_mean_power"] > 0.02


def test_batches_are_joined_until_one_begins_before_the_last_pulse():
    batches = [executed([1, 2], [1.0, 1.1]), executed(3, 1.2), executed([3, 4], [1.15, 1.3]), executed(5, 1.3)]
    joined = list(join_in_order(batches))
    assert [batch.pixel.tolist() for batch in joined] == [[1, 2, 3], [3, 4, 5]]
    assert [batch.start_s.tolist() for batch in joined] == [[1.0, 1.1, 1.2], [1.15, 1.3, 1.3]]
    assert list(join_in_order([])) == []


@pytest.mark.parametrize("at_once", [True, False])
def test_every_peak_is_taken_once_however_seldom(at_once):
    """Three pulses on pixel 1: the peaks are those of its trace, sampled finely."""
    pixel, start_s = np.array([1, 5, 1, 1]), np.array([1.0, 1.1, 1.2, 1.4])
    live, widths_s, powers_w = LiveThermalState(DISPLAY), np.full(4, 0.01), np.full(4, 2.0)
    batches = [slice(None)] if at_once else [slice(row, row + 1) for row in range(4)]
    taken = []
    for batch in batches:
        live.apply(executed(pixel[batch], start_s[batch]))
        taken.append(live.take_peaks())
    t_s = np.arange(1.0, 2.0, 1e-5)
    pulses = np.stack([start_s, widths_s, powers_w, pixel], axis=1)
    held = [np.max(column, axis=0) for column in zip(*taken, strict=True)]
    for one in (1, 5):
        trace = DISPLAY.build_cold_heat().simulate_traces(pulses, [one], t_s)
        assert held[0][one] == pytest.approx(trace.displacement_m.max(), rel=1e-6)
        assert held[1][one] == pytest.approx(trace.absorber_k.max(), rel=1e-3)  # a corner between two samples
    assert not any(column[[0, 2, 3, 4]].any() for column in held)
    assert not np.any(live.take_peaks())


def test_a_clock_shift_moves_the_state():
    live, still = LiveThermalState(DISPLAY), LiveThermalState(DISPLAY)
    for one in (live, still):
        one.apply(executed(3, 100.0))
    live.shift_clock(-99.0)
    assert live.state_at(1.03).absorber_k == pytest.approx(still.state_at(100.03).absorber_k, rel=1e-6)
    assert shares(live, 1.03) == pytest.approx(shares(still, 100.03), rel=1e-6, abs=1e-9)
    live.apply(executed(3, 1.05))
    assert live.out_of_order == 0


def test_an_out_of_order_pulse_counts_in_the_budget_but_not_in_the_heat():
    live = LiveThermalState(DISPLAY)
    live.apply(executed(3, 5.0))
    before = live.state_at(5.02).displacement_m.copy()
    live.apply(executed(3, 4.0))
    assert live.out_of_order == 1
    assert live.state_at(5.02).displacement_m == pytest.approx(before)
    assert shares(live, 5.02)["display_mean_power"] == pytest.approx(2 * 0.01 * 2.0 / 10.0 / 2.45)
