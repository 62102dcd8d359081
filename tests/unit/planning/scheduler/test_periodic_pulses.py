"""Trains by height: every cycle has the requested shape, and each pulse is planned from the residual heat."""

from dataclasses import replace

import numpy as np
import pytest

from displays import DISPLAYS
from optodrive.core.errors import InputError
from optodrive.core.types.stimuli import FrameSequence, HeightTrain, PulseTrain, TactileFrame
from optodrive.device.config_file import load_config
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.pipeline import plan_sequence
from optodrive.planning.scheduler import periodic_pulses
from optodrive.planning.scheduler.periodic_pulses import (
    limit_pulse_width,
)

DISPLAY = DISPLAYS["display-437"]
SAMPLES = 400


def plan_trains(*trains, frames=(), display=DISPLAY, policy="trim"):
    return plan_sequence(display, FrameSequence(tuple(frames), tuple(trains)), *display.build_cold_state(), policy)


def simulate_cycles(result, train, display=DISPLAY):
    """Simulate peak and trough of each cycle on a cold display, µm, [cycles] each."""
    plan = result.plan
    pulses = np.column_stack([plan.start_s, plan.width_s, plan.power_w, plan.pixel])
    starts_s = train.pulse_starts_s() + result.lead_in_s
    t_s = np.linspace(starts_s[0], starts_s[-1] + train.period_s, SAMPLES * len(starts_s) + 1)
    height_um = display.build_cold_heat().simulate_traces(pulses, [train.pixel], t_s).displacement_m[:, 0] * 1e6
    each = np.array([height_um[k * SAMPLES : (k + 1) * SAMPLES + 1] for k in range(len(starts_s))])
    return each.max(axis=1), each.min(axis=1)


def plan_refused(*trains):
    with pytest.raises(InputError) as caught:
        plan_trains(*trains)
    assert "\n" not in str(caught.value)
    return caught.value.code, str(caught.value)


def test_without_a_peak_to_peak_value_pulses_are_as_short_as_possible():
    train = HeightTrain(17, 0.0, 1.0, 0.04, 200e-6)
    plan = plan_trains(train).plan
    assert plan.width_s[0] > plan.width_s[1]
    assert plan.width_s[-1] == plan.width_s[-2]
    assert plan.power_w[-1] > 0.95 * DISPLAY.config.laser.max_power_w
    wide = plan_trains(replace(train, peak_to_peak_m=50e-6)).plan
    assert wide.energy_j[5:].sum() > 1.2 * plan.energy_j[5:].sum()


@pytest.mark.parametrize(("period_s", "peak_to_peak_um"), [(0.005, None), (0.005, 2.5), (0.01, None), (0.01, 2.0)])
def test_no_pulse_is_omitted_while_the_membrane_still_rises_at_the_next_pulse(period_s, peak_to_peak_um):
    train = HeightTrain(17, 0.0, 0.5, period_s, 100e-6, None if peak_to_peak_um is None else peak_to_peak_um * 1e-6)
    result = plan_trains(train)
    peaks_um, troughs_um = simulate_cycles(result, train)
    assert np.count_nonzero(np.isfinite(result.plan.target_m)) == len(peaks_um)  # a lead period has no target
    assert peaks_um[3:] == pytest.approx(np.full(len(peaks_um) - 3, 100.0), rel=0.01)
    if peak_to_peak_um is not None:
        assert (peaks_um - troughs_um)[10:] == pytest.approx(np.full(len(peaks_um) - 10, peak_to_peak_um), rel=0.03)


def test_planned_for_the_peak_such_cycles_omit_every_other_pulse(monkeypatch):
    monkeypatch.setattr(periodic_pulses, "EARLY_PEAK_FRACTION", np.inf)
    train = HeightTrain(17, 0.0, 0.5, 0.01, 100e-6, 2e-6)
    peaks_um, troughs_um = simulate_cycles(plan_trains(train), train)
    assert (peaks_um - troughs_um)[10:].min() > 4.0


def test_a_pulse_never_exceeds_its_slot():
    """Only one slot of many is short, so the train is not refused. The pulse in that slot is short as well."""
    tall = HeightTrain(17, 0.0, 0.4, 0.04, 300e-6)
    other = PulseTrain(300, 0.205, 0.001, 0.002, 0.001, 1.0)
    result = plan_trains(tall, other)
    plan = result.plan
    assert result.train_lateness_max_s < 1e-9
    (short,) = np.flatnonzero(np.isclose(plan.start_s - result.lead_in_s, 0.2))
    assert plan.width_s[short] <= 0.005
    assert result.predicted_m[short] < 0.8 * 300e-6
    assert result.predicted_m[short + 2 :] == pytest.approx(300e-6, rel=0.01)


def test_the_next_pulse_compensates_for_a_trimmed_one():
    caps = DISPLAY.budget.caps._replace(pulse_energy_j=0.012)
    capped = replace(DISPLAY, budget=DISPLAY.budget._replace(caps=caps))
    train = HeightTrain(17, 0.0, 0.4, 0.04, 200e-6)
    plan = plan_trains(train, display=capped).plan
    assert plan.reason[0] == "pulse_energy"
    heat = DISPLAY.build_cold_heat()
    drive = limit_pulse_width(DISPLAY.scan_head.drive, 39_500)
    for row in range(len(plan)):
        periods, duty = heat.solve_pulse(17, plan.start_s[row], 200e-6, drive)
        requested_j = plan.energy_j[row] + plan.trimmed_j[row]
        assert requested_j == pytest.approx(periods * drive.period_s * duty * drive.max_power_w, rel=1e-6)
        heat.apply_pulse(17, plan.start_s[row], plan.width_s[row], plan.power_w[row])


def test_under_delay_a_train_by_height_is_delayed_and_reaches_its_peaks():
    caps = DISPLAY.budget.caps._replace(touch_k=2.5)
    capped = replace(DISPLAY, budget=DISPLAY.budget._replace(caps=caps))
    result = plan_trains(HeightTrain(200, 0.0, 1.0, 0.04, 300e-6), display=capped, policy="delay")
    assert result.delays
    assert not result.plan.trimmed_j.any()
    assert result.predicted_m == pytest.approx(np.full(len(result.plan), 300e-6), rel=0.01)


def test_frames_fill_the_gaps_and_share_a_pixel_with_a_train():
    target_m = np.zeros(len(DISPLAY.layout))
    target_m[[17, 30, 31, 32]] = 60e-6
    train = HeightTrain(17, 0.0, 0.4, 0.1, 80e-6)
    result = plan_trains(train, frames=[TactileFrame("f", 0.0, 0.4, target_m)])
    plan = result.plan
    assert result.train_lateness_max_s < 1e-9
    assert len(plan) + len(result.skipped) == 8
    of_frame = (plan.source == 0) & (plan.pixel != 17)
    assert result.predicted_m[of_frame] == pytest.approx(np.full(3, 60e-6), rel=0.01)
    assert result.predicted_m[plan.source == 1] == pytest.approx(80e-6, rel=0.01)


def test_an_unreachable_height_is_refused_with_the_maximum():
    code, message = plan_refused(HeightTrain(17, 0.0, 1.0, 0.04, 5e-3))
    assert code == "target_unreachable"
    assert message.startswith("trains[0].target_um: got 5000.0, expected at most ")
    max_um = float(message.split("at most ")[1].split()[0])
    train = HeightTrain(17, 0.0, 0.08, 0.04, (max_um - 1) * 1e-6)
    plan_trains(train)
    assert plan_refused(replace(train, target_m=(max_um + 1) * 1e-6))[0] == "target_unreachable"


@pytest.mark.parametrize(
    ("peak_to_peak_um", "word", "kind"), [(199.0, "at most", "shortest"), (0.01, "at least", "longest")]
)
def test_an_unreachable_peak_to_peak_value_is_refused_with_the_bound(peak_to_peak_um, word, kind):
    train = HeightTrain(17, 0.0, 1.0, 0.04, 200e-6, peak_to_peak_um * 1e-6)
    code, message = plan_refused(train)
    assert code == "bad_train"
    assert f"{word} " in message
    assert kind in message
    bound_um = float(message.split(f"{word} ")[1].split()[0])
    plan_trains(replace(train, peak_to_peak_m=bound_um * (0.999 if word == "at most" else 1.001) * 1e-6))


def test_starts_too_close_for_a_move_are_refused():
    trains = HeightTrain(17, 0.0, 1.0, 0.04, 50e-6), HeightTrain(300, 0.0005, 1.0, 0.04, 50e-6)
    code, message = plan_refused(*trains)
    assert code == "overlapping_trains"
    assert "trains[0].period_s: got 0.04" in message


MODEL = """format = "optodrive-parameters"
version = 1
name = "slow diode, warm bridges, leaking gas"
base = "surroundings"
planner_terms = {terms}
claims = "for tests"

[terms.laser_turn_on.time]
value = 1.5e-3
unit = "s"
source = "for tests"

[terms.bridge_conductivity.exponent]
value = 0.4
unit = "1"
source = "for tests"

[terms.gas_leak.rate]
value = 4.0
unit = "1/s"
source = "for tests"
"""


@pytest.mark.parametrize(
    ("period_s", "peak_to_peak_um", "terms"),
    [
        (0.04, 60.0, '["laser_turn_on", "bridge_conductivity"]'),
        (0.01, 8.0, '["laser_turn_on", "bridge_conductivity"]'),
        (0.01, None, '["laser_turn_on", "gas_leak"]'),
    ],
)
def test_cycles_planned_with_terms(period_s, peak_to_peak_um, terms, tmp_path):
    path = tmp_path / "model.toml"
    path.write_text(MODEL.replace("{terms}", terms))
    config = load_config("display-16")
    model = config.pixel_model.model_copy(update={"parameters": str(path)})
    display = DisplayModel.from_config(config.model_copy(update={"pixel_model": model}))
    train = HeightTrain(
        5, 0.0, 12 * period_s, period_s, 100e-6, None if peak_to_peak_um is None else peak_to_peak_um * 1e-6
    )
    peaks_um, troughs_um = simulate_cycles(plan_trains(train, display=display), train, display)
    assert peaks_um[4:] == pytest.approx(np.full(8, 100.0), rel=0.03)
    if peak_to_peak_um is not None:
        assert (peaks_um - troughs_um)[6:] == pytest.approx(np.full(6, peak_to_peak_um), rel=0.03)
