"""Position outputs of the simulated mirrors: a rehearsal of `calibrate servo` identifies the configured servo."""

import numpy as np
import pytest

from displays import DISPLAYS
from optodrive.core.types.measurements import Measurement, Run, Signal
from optodrive.lab.servo_identification.identify import identify
from optodrive.lab.servo_identification.records import extract_trace
from optodrive.link.simulator.galvos import CENTRE_CODE, measure_position_outputs

CONFIG = DISPLAYS["display-16"].config
SIZES_CODES = (8000, 1500, 300)


def rehearse(seed, codes):
    random = np.random.default_rng(seed)
    at_s = np.concatenate([[0.0], 0.1 + np.cumsum(random.uniform(0.015, 0.016, 24))])
    places = (np.arange(25) % 2 * codes - codes // 2) * CONFIG.scanner.rad_per_code
    commands = np.column_stack([at_s, places, places])
    t_s, x_rad, y_rad = measure_position_outputs(CONFIG, commands, at_s[-1] + 0.015, seed).T.copy()
    signals = {"mirror_x_rad": Signal(0, t_s, x_rad), "mirror_y_rad": Signal(0, t_s, y_rad)}
    return Run(f"size{seed}", 293.0, np.zeros((0, 4)), signals, {}, commands)


def test_the_mirrors_rest_at_the_first_command_and_reach_the_next():
    commands = np.array([[0.0, 0.01, -0.02], [0.005, 0.03, -0.02]])
    t_s, x_rad, y_rad = measure_position_outputs(CONFIG, commands, 0.02, 1).T
    assert np.diff(t_s) == pytest.approx(20e-6)
    code_rad = CONFIG.scanner.rad_per_code
    assert np.abs(x_rad[t_s < 0.005] - 0.01).max() < 6e-5 + code_rad
    assert np.abs(x_rad[t_s > 0.018] - 0.03).max() < 6e-5 + code_rad
    assert np.abs(y_rad + 0.02).max() < 6e-5 + code_rad
    assert CENTRE_CODE == 32768


@pytest.mark.slow
def test_the_configured_servo_is_identified_from_a_rehearsal():
    measurement = Measurement(tuple(rehearse(seed, codes) for seed, codes in enumerate(SIZES_CODES)))
    scanner = CONFIG.scanner
    servo = identify("rehearsal", extract_trace("rehearsal", measurement, 0), scanner.slew_rad_per_s).servo
    found, configured = (
        (servo.frequency, servo.damping, servo.delay),
        (scanner.bandwidth_hz, scanner.damping, scanner.delay_s),
    )
    assert found == pytest.approx(configured, rel=0.01)
