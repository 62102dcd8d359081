"""Heat and budget as executed: against the display's own heat, over a clock that moves, and what comes out of order."""

import numpy as np
import pytest

from optodrive.daemon.engine.display_snapshot import ExecutedBatch, LiveThermalState
from optodrive.device.config import load_config
from optodrive.planning.display_model import DisplayModel

DISPLAY = DisplayModel.from_config(load_config("display-16"))


def executed(pixel, start_s, width_s=0.01, power_w=2.0):
    pixel, start_s = np.atleast_1d(pixel), np.atleast_1d(np.asarray(start_s, dtype=float))
    count = len(pixel)
    none = np.zeros(count)
    return ExecutedBatch(
        None, np.arange(count), pixel, start_s, np.full(count, width_s), np.full(count, power_w), none, none
    )


def shares(live, at_s):
    return {item.cap: item.used / item.limit for item in live.compute_usage(at_s)}


def test_reports_one_by_one_are_as_all_at_once():
    pixel, start_s = np.array([1, 5, 1, 9]), np.array([1.0, 1.1, 1.2, 1.3])
    bit_by_bit, whole = LiveThermalState(DISPLAY), LiveThermalState(DISPLAY)
    whole.apply(executed(pixel, start_s))
    for row in range(len(pixel)):
        bit_by_bit.apply(executed(pixel[row], start_s[row]))
    heat = DISPLAY.build_cold_heat()
    heat.apply_pulses(pixel, start_s, np.full(4, 0.01), np.full(4, 2.0))
    for live in (bit_by_bit, whole):
        assert live.state_at(1.32).displacement_m == pytest.approx(heat.state_at(1.32).displacement_m)
    assert shares(bit_by_bit, 1.32) == pytest.approx(shares(whole, 1.32), rel=1e-6, abs=1e-9)
    assert shares(whole, 1.32)["pixel_mean_power"] > 0.02


def test_a_clock_set_anew_takes_what_is_known_along():
    live, still = LiveThermalState(DISPLAY), LiveThermalState(DISPLAY)
    for one in (live, still):
        one.apply(executed(3, 100.0))
    live.shift_clock(-99.0)
    assert live.state_at(1.03).absorber_k == pytest.approx(still.state_at(100.03).absorber_k, rel=1e-6)
    assert shares(live, 1.03) == pytest.approx(shares(still, 100.03), rel=1e-6, abs=1e-9)
    live.apply(executed(3, 1.05))
    assert live.out_of_order == 0


def test_a_pulse_from_before_is_left_out_of_the_heat_counted_in_the_budget_and_said():
    live = LiveThermalState(DISPLAY)
    live.apply(executed(3, 5.0))
    before = live.state_at(5.02).displacement_m.copy()
    live.apply(executed(3, 4.0))
    assert live.out_of_order == 1
    assert live.state_at(5.02).displacement_m == pytest.approx(before)
    assert shares(live, 5.02)["display_mean_power"] == pytest.approx(2 * 0.01 * 2.0 / 10.0 / 2.45)
