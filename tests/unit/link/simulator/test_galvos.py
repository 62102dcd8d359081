"""The simulated galvos against a numerical integration of the servo."""

import numpy as np
import pytest

from displays import DISPLAYS
from optodrive.device.gate_timing import build_servo
from optodrive.device.servo import STEPS_PER_TIME_CONSTANT, simulate_servo
from optodrive.link.simulator.galvos import CENTRE_CODE, SimulatedGalvos

CONFIG = DISPLAYS["display-437"].config


def test_a_move_follows_the_servo():
    mirrors = SimulatedGalvos(CONFIG, seed=0)
    mirrors.move_to(CENTRE_CODE + 12_000, CENTRE_CODE - 500, 1000)
    # The integration advances the servo's target in whole steps; the closed form is continuous.
    scanner = CONFIG.scanner
    step_rad = scanner.slew_rad_per_s * 2.0 / (STEPS_PER_TIME_CONSTANT * 2.0 * np.pi * scanner.bandwidth_hz)
    t_us = np.arange(900, 12_000, 37)
    stood = np.array([mirrors.angles_rad(at) for at in t_us.tolist()])
    for axis, codes in enumerate((12_000, -500)):
        commands = np.array([0.0, codes * CONFIG.scanner.rad_per_code])
        servo = simulate_servo(np.array([0.0, 1e-3]), commands, t_us * 1e-6, build_servo(CONFIG.scanner))
        assert np.abs(stood[:, axis] - servo).max() < step_rad
        assert np.abs(stood[-50:, axis] - commands[1]).max() < 1e-9


def test_many_moves_end_where_they_were_sent():
    mirrors, random = SimulatedGalvos(CONFIG, seed=0), np.random.default_rng(3)
    for k in range(200):
        x, y = random.integers(0, 65536, 2).tolist()
        mirrors.move_to(x, y, 20_000 * k)
        assert mirrors.codes(20_000 * (k + 1)) == pytest.approx((x, y), abs=0.02)


def test_a_stuck_mirror_stands_and_outputs_tell_it():
    mirrors = SimulatedGalvos(CONFIG, seed=0)
    mirrors.move_to(CENTRE_CODE + 1000, CENTRE_CODE + 1000, 0)
    mirrors.stick(0, 50_000)
    mirrors.move_to(CENTRE_CODE - 5000, CENTRE_CODE - 5000, 60_000)
    assert mirrors.codes(100_000) == pytest.approx((CENTRE_CODE + 1000, CENTRE_CODE - 5000), abs=0.1)
    mirrors.readback_inverted = True
    x_rad, y_rad = mirrors.position_output_rad(100_000)
    assert x_rad == pytest.approx(-1000 * CONFIG.scanner.rad_per_code, abs=1e-4)
    assert y_rad == pytest.approx(5000 * CONFIG.scanner.rad_per_code, abs=1e-4)
