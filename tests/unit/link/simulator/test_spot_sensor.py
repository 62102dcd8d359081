"""The simulated spot sensor: detection, timing, noise and outliers."""

import numpy as np
import pytest

from displays import DISPLAYS
from optodrive.link.simulator.galvos import CENTRE_CODE, SimulatedGalvos
from optodrive.link.simulator.simulated_optics import FIELD_MARGIN_M, PULSE_MEMORY_US, SimulatedSpotSensor
from optodrive.link.simulator.true_geometry import GroundTruthGeometry

CONFIG = DISPLAYS["display-437"].config
TRUTH = GroundTruthGeometry.sample(5, CONFIG)
CODES = (CENTRE_CODE + 9000, CENTRE_CODE - 4000)
SETTLED_US = 100_000


def build_sensor(noise_m=10e-6, outlier_share=0.0, outputs=True):
    mirrors = SimulatedGalvos(CONFIG, seed=1)
    mirrors.move_to(*CODES, 0)
    return SimulatedSpotSensor(CONFIG, TRUTH, mirrors, noise_m, outlier_share, outputs, seed=2), mirrors


def emit_pulse(sensor, at_us=SETTLED_US, energy_j=1e-4):
    sensor.record_pulse(at_us, at_us + 20_000, energy_j)
    return sensor.answer("spot", at_us + 20_000)


def numbers(line):
    word, *rest = line.split()
    assert word == "spot"
    return np.array([float(each) for each in rest])


def test_it_sees_where_the_truth_says_with_its_noise():
    sensor, _ = build_sensor()
    lines = np.array([numbers(emit_pulse(sensor, SETTLED_US + 30_000 * k)) for k in range(400)])
    landed_um = 1e6 * np.array(TRUTH.position_m(*CODES))
    assert lines[:, :2].mean(axis=0) == pytest.approx(landed_um, abs=2.0)
    assert lines[:, :2].std(axis=0) == pytest.approx([10.0, 10.0], rel=0.15)
    assert np.all(lines[:, 2] == 10.0)


def test_no_spot_without_light_and_none_twice():
    sensor, _ = build_sensor(outlier_share=1.0)
    assert sensor.answer("spot", 0) == "spot none"
    assert emit_pulse(sensor) != "spot none"
    assert sensor.answer("spot", SETTLED_US + 20_001) == "spot none"
    sensor.record_pulse(SETTLED_US, SETTLED_US + 1000, 1e-4)
    assert sensor.answer("spot", SETTLED_US + 1000 + PULSE_MEMORY_US + 1) == "spot none"


def test_too_little_light_a_cover_and_a_spot_outside_are_none():
    sensor, mirrors = build_sensor()
    assert emit_pulse(sensor, energy_j=1e-6) == "spot none"
    mirrors.move_to(65535, CENTRE_CODE, SETTLED_US)
    assert emit_pulse(sensor, 2 * SETTLED_US) == "spot none"
    mirrors.move_to(*CODES, 3 * SETTLED_US)
    sensor.blind = True
    assert emit_pulse(sensor, 4 * SETTLED_US) == "spot none"


def test_false_detections_lie_anywhere_and_are_as_many_as_asked():
    sensor, _ = build_sensor(outlier_share=0.2)
    lines = np.array([numbers(emit_pulse(sensor, SETTLED_US + 30_000 * k))[:2] for k in range(1000)])
    away = np.hypot(*(lines - 1e6 * np.array(TRUTH.position_m(*CODES))).T) > 100.0
    assert away.mean() == pytest.approx(0.2, abs=0.04)
    half_um = 1e6 * (36e-3 + FIELD_MARGIN_M)
    assert np.abs(lines[away]).max() < half_um + 100.0
    assert np.abs(lines[away]).mean() == pytest.approx(half_um / 2, rel=0.15)


def test_mirrors_and_words_it_does_not_know():
    sensor, _ = build_sensor()
    word, x_rad, _ = sensor.answer("mirrors", SETTLED_US).split()
    assert word == "mirrors"
    assert float(x_rad) == pytest.approx(9000 * CONFIG.scanner.rad_per_code, abs=1e-4)
    assert build_sensor(outputs=False)[0].answer("mirrors", 0) == "mirrors none"
    assert sensor.answer("spots", 0).startswith("error")
