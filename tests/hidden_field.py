"""Spots of hidden geometries, and the error of a field fitted to them over the whole display."""

import numpy as np

from optodrive.device.config import Config, build_pixel_layout
from optodrive.device.config_file import load_config
from optodrive.lab.calibration.field_fit import fit_field
from optodrive.lab.calibration.field_output import write_field
from optodrive.lab.calibration.spots import FieldPrior, MeasuredSpots
from optodrive.link.simulator.true_geometry import CENTRE_CODE, GroundTruthGeometry

CONFIG = load_config()
LAYOUT = build_pixel_layout(CONFIG.display)
PRIOR = FieldPrior.from_config(CONFIG)
HALF_M = float(np.abs(LAYOUT.x_m).max())
CODE_M = 2.0 * CONFIG.scanner.focal_length_m * CONFIG.scanner.rad_per_code
NOISE_M = 10e-6


def grid_codes(side):
    """Return a square grid over the display, uncorrected codes, [side², 2]."""
    at = np.rint(CENTRE_CODE + np.linspace(-HALF_M, HALF_M, side) / CODE_M)
    return np.stack(np.meshgrid(at, at), axis=-1).reshape(-1, 2)


def random_codes(random, count):
    """Return random codes over the display, [count, 2]."""
    return np.rint(CENTRE_CODE + random.uniform(-HALF_M, HALF_M, (count, 2)) / CODE_M)


def measure_spots(truth, codes, random, outlier_fraction=0.02, noise_m=NOISE_M):
    """Return spots as a sensor measures them, and which are outliers, distributed over the display."""
    places = np.column_stack(truth.position_m(codes[:, 0], codes[:, 1]))
    places = places + noise_m * random.standard_normal(places.shape)
    is_outlier = random.random(len(codes)) < outlier_fraction
    places[is_outlier] = random.uniform(-HALF_M, HALF_M, (int(is_outlier.sum()), 2))
    return MeasuredSpots.from_table(np.column_stack([codes, places])), is_outlier


def field_errors_m(truth: GroundTruthGeometry, field, count=1500):
    """Return the beam's error at random targets over the display's square, [2, count], and their codes."""
    target_m = np.random.default_rng(99).uniform(-HALF_M, HALF_M, (2, count))
    codes = field.codes(*target_m)
    return np.array(truth.position_m(*codes)) - target_m, codes


def calibrate_hidden_field(path, seed=0, side=17):
    """Calibrate a hidden geometry as a user would and write its field. Return the geometry and the configuration."""
    truth = GroundTruthGeometry.sample(seed, CONFIG)
    spots, _ = measure_spots(truth, grid_codes(side), np.random.default_rng([seed, side]))
    write_field(path, fit_field(spots, PRIOR))
    return truth, config_with_field(path)


def config_with_field(path, config=CONFIG, **scanner):
    """Return the configuration with a field."""
    table = config.model_dump()
    table["scanner"] |= {"field": str(path)} | scanner
    return Config.model_validate(table)
