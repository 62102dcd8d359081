import numpy as np
import pytest

from optodrive.device.config import build_pixel_layout
from optodrive.device.config_file import load_config
from optodrive.link.simulator.true_geometry import CENTRE_CODE, GroundTruthGeometry

CONFIG = load_config()
LAYOUT = build_pixel_layout(CONFIG.display)
CODE_M = 2.0 * CONFIG.scanner.focal_length_m * CONFIG.scanner.rad_per_code
X_CODE, Y_CODE = CENTRE_CODE + LAYOUT.x_m / CODE_M, CENTRE_CODE + LAYOUT.y_m / CODE_M


@pytest.mark.parametrize("name", ["display-1", "display-16", "display-437", "display-1511"])
def test_an_uncorrected_beam_misses_by_half_a_millimetre_to_three(name):
    config = load_config(name)
    layout = build_pixel_layout(config.display)
    code_m = 2.0 * config.scanner.focal_length_m * config.scanner.rad_per_code
    for seed in range(20):
        x_m, y_m = GroundTruthGeometry.sample(seed, config).position_m(
            CENTRE_CODE + layout.x_m / code_m, CENTRE_CODE + layout.y_m / code_m
        )
        assert 0.5e-3 <= np.hypot(x_m - layout.x_m, y_m - layout.y_m).max() <= 3e-3


def test_a_seed_is_a_geometry():
    once, again, other = (GroundTruthGeometry.sample(seed, CONFIG).position_m(X_CODE, Y_CODE) for seed in (3, 3, 4))
    assert np.array_equal(once, again)
    assert np.abs(np.subtract(once, other)).max() > 1e-4


def test_positive_codes_lead_right_and_up_by_what_the_configuration_says():
    for seed in range(10):
        truth = GroundTruthGeometry.sample(seed, CONFIG)
        x_m, y_m = truth.position_m(
            CENTRE_CODE + np.array([-2000, 2000, 0, 0]), CENTRE_CODE + np.array([0, 0, -2000, 2000])
        )
        assert x_m[1] - x_m[0] == pytest.approx(4000 * CODE_M, rel=0.03)
        assert y_m[3] - y_m[2] == pytest.approx(4000 * CODE_M, rel=0.03)


def test_any_shape_and_rows_of_a_batch_are_what_they_are_alone():
    truth = GroundTruthGeometry.sample(1, CONFIG)
    x_m, y_m = truth.position_m(X_CODE[:6].reshape(2, 3), Y_CODE[:6].reshape(2, 3))
    assert x_m.shape == y_m.shape == (2, 3)
    assert truth.position_m(X_CODE[4], Y_CODE[4]) == pytest.approx((x_m[1, 1], y_m[1, 1]), abs=1e-15)


def test_what_no_part_explains_is_a_few_tens_of_micrometres():
    for seed in range(20):
        truth = GroundTruthGeometry.sample(seed, CONFIG)
        deviation_m = truth._deviation_m(np.array(truth.mirror_angles_rad(X_CODE, Y_CODE)))
        assert 5e-6 < np.abs(deviation_m).max() <= 40e-6
