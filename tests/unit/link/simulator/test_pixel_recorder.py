"""The simulated recorder of pixels: trigger, times, residual heat, and where the beam lands."""

import numpy as np
import pytest

from displays import DISPLAYS
from optodrive.link.simulator.galvos import CENTRE_CODE, SimulatedGalvos
from optodrive.link.simulator.simulated_optics import (
    PRE_LIGHT_US,
    SAMPLES_MAX,
    SAMPLES_PER_LINE,
    SimulatedPixelRecorder,
)
from optodrive.link.simulator.true_geometry import GroundTruthGeometry

DISPLAY = DISPLAYS["display-437"]
TRUTH = GroundTruthGeometry.sample(5, DISPLAY.config)
PIXEL = 218
"""The pixel in the middle."""
STEP_US, COUNT = 500, 200
ON_US, OFF_US, POWER_W = 1_000_000, 1_040_000, 2.0
LINE_MAX = 1024


def build_recorder(offset_m=0.0):
    """Return a recorder with mirrors that point at the middle pixel, or beside it along x."""
    x_m, y_m = DISPLAY.layout.x_m[PIXEL] + offset_m, DISPLAY.layout.y_m[PIXEL]
    code_m = 2.0 * DISPLAY.config.scanner.focal_length_m * DISPLAY.config.scanner.rad_per_code
    code = np.array([CENTRE_CODE, CENTRE_CODE], dtype=float)
    for _ in range(20):  # the truth inverted: a few steps of its linear part
        landed_m = np.array(TRUTH.position_m(*code)).ravel()
        code += (np.array([x_m, y_m]) - landed_m) / code_m
    mirrors = SimulatedGalvos(DISPLAY.config, seed=1)
    mirrors.move_to(*np.rint(code).astype(int).tolist(), 0)
    return SimulatedPixelRecorder(DISPLAY.config, TRUTH, mirrors, DISPLAY.build_cold_heat(), seed=2)


def read(recorder, signal, now_us=2_000_000):
    """Return all samples of a signal."""
    values = []
    while len(values) < COUNT:
        line = recorder.answer(f"samples {signal} {len(values)}", now_us)
        assert len(line) < LINE_MAX
        values += [float(word) for word in line.split()[1:]]
    return np.array(values)


def test_it_records_from_before_the_light_on():
    recorder = build_recorder()
    assert recorder.answer("signals", 0) == "signals absorber_temperature_K displacement_m"
    assert recorder.answer(f"record {PIXEL} {COUNT} {STEP_US}", 500_000) == f"record {COUNT}"
    assert recorder.answer("samples 0 0", 600_000) == "samples none"
    recorder.record_pulse(ON_US, OFF_US, POWER_W)
    last_us = ON_US - PRE_LIGHT_US + COUNT * STEP_US
    assert recorder.answer("samples 0 0", last_us - 1) == "samples none"
    assert len(recorder.answer("samples 0 0", last_us).split()) == 1 + SAMPLES_PER_LINE
    ambient_k = DISPLAY.ambient_k
    temperature_k, displacement_m = read(recorder, 0), read(recorder, 1)
    t_us = -PRE_LIGHT_US + STEP_US * np.arange(COUNT)
    assert np.abs(temperature_k[t_us <= 0] - ambient_k).max() < 5.0
    pulses = np.array([[0.0, 0.04, POWER_W, PIXEL]])
    expected = DISPLAY.build_cold_heat().simulate_traces(pulses, [PIXEL], t_us[t_us >= 0] * 1e-6)
    assert temperature_k[t_us >= 0] - ambient_k == pytest.approx(expected.absorber_k[:, 0], abs=5.0)
    assert displacement_m[t_us >= 0] == pytest.approx(expected.displacement_m[:, 0], abs=1.5e-6)


def test_a_second_recording_begins_with_what_the_first_pulse_left():
    recorder = build_recorder()
    recorder.record_pulse(ON_US, OFF_US, POWER_W)
    recorder.answer(f"record {PIXEL} {COUNT} {STEP_US}", OFF_US)
    recorder.record_pulse(OFF_US + 21_000, OFF_US + 25_000, POWER_W)
    assert read(recorder, 0)[0] > DISPLAY.ambient_k + 50.0


def test_light_beside_the_absorber_heats_nothing():
    recorder = build_recorder(offset_m=DISPLAY.config.display.absorber_width_m)
    recorder.answer(f"record {PIXEL} {COUNT} {STEP_US}", 0)
    recorder.record_pulse(ON_US, OFF_US, POWER_W)
    assert np.abs(read(recorder, 0) - DISPLAY.ambient_k).max() < 5.0


@pytest.mark.parametrize(
    "request_line",
    [
        "record 437 10 10",
        "record -1 10 10",
        f"record 0 {SAMPLES_MAX + 1} 10",
        "record 0 10 0",
        "record 0 x 1",
        "record 0 10",
        "samples 0 0",
        "samples",
    ],
)
def test_what_it_cannot_do_is_an_error(request_line):
    assert build_recorder().answer(request_line, 0).startswith("error")
