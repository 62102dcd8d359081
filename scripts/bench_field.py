"""The calibrated field: error on hidden geometries, and duration of conversions."""

import subprocess
import tempfile
from pathlib import Path

import numpy as np
from measuring import measure_median_cpu_s, measure_times_s

from optodrive.core.numeric_tables import write_columns
from optodrive.device.config import build_pixel_layout
from optodrive.device.config_file import load_config
from optodrive.lab.calibration.field_fit import fit_field
from optodrive.lab.calibration.field_output import write_field
from optodrive.lab.calibration.spots import FieldPrior, MeasuredSpots
from optodrive.link.simulator.true_geometry import CENTRE_CODE, GroundTruthGeometry

GEOMETRIES, POINTS = 10, 1_000_000
NOISE_M, OUTLIER_SHARE = 10e-6, 0.02


class HiddenGeometryLab:
    """Hidden geometries of the default display."""

    def __init__(self):
        self.config = load_config()
        self.prior = FieldPrior.from_config(self.config)
        self.half_m = float(np.abs(build_pixel_layout(self.config.display).x_m).max())
        self.code_m = 2.0 * self.config.scanner.focal_length_m * self.config.scanner.rad_per_code

    def fit_spots(self, seed, side):
        """Fit a grid of spots with noise and outliers. Return the ground truth and the fit."""
        truth, random = GroundTruthGeometry.sample(seed, self.config), np.random.default_rng([seed, side])
        axis_codes = np.rint(CENTRE_CODE + np.linspace(-self.half_m, self.half_m, side) / self.code_m)
        codes = np.stack(np.meshgrid(axis_codes, axis_codes), axis=-1).reshape(-1, 2)
        positions = np.column_stack(truth.position_m(*codes.T)) + NOISE_M * random.standard_normal(codes.shape)
        is_outlier = random.random(len(codes)) < OUTLIER_SHARE
        positions[is_outlier] = random.uniform(-self.half_m, self.half_m, (int(is_outlier.sum()), 2))
        return truth, fit_field(MeasuredSpots.from_table(np.column_stack([codes, positions])), self.prior)

    def sample_positions(self, count):
        """Sample positions uniformly on the display's square, [2, count], m."""
        return np.random.default_rng(5).uniform(-self.half_m, self.half_m, (2, count))

    def measure_errors(self, side):
        """Return for each geometry the rms and maximum error, µm, and the fraction of axis errors within two sigma."""
        out, targets = [], self.sample_positions(3000)
        for seed in range(GEOMETRIES):
            truth, fit = self.fit_spots(seed, side)
            codes = fit.field.codes(*targets)
            error_m = np.array(truth.position_m(*codes)) - targets
            covered = float((np.abs(error_m) <= 2.0 * fit.field.sigma_m(*codes)).mean())
            length_um = 1e6 * np.hypot(*error_m)
            out.append((float(np.sqrt((length_um**2).mean())), float(length_um.max()), covered))
        return np.array(out)


def measure_command_s(*arguments):
    """Return the wall time of a command, s."""
    command = ["optodrive", "field", *arguments]
    return measure_times_s(lambda: subprocess.run(command, check=True, stdout=subprocess.DEVNULL), 1)


def measure():
    lab = HiddenGeometryLab()
    for side in (17, 5, 3):
        rms_um, max_um, covered = lab.measure_errors(side).T
        spots = f"{side**2} spots"
        yield f"{spots}: rms position error, median of {GEOMETRIES} hidden geometries", np.median(rms_um), "µm"
        yield f"{spots}: rms position error, worst geometry", rms_um.max(), "µm"
        yield f"{spots}: maximum position error", max_um.max(), "µm"
        yield f"{spots}: fraction within two sigma", covered.mean(), "1"
    _, fit = lab.fit_spots(0, 17)
    field, targets = fit.field, lab.sample_positions(POINTS)
    codes = field.codes(*targets)
    yield "1,000,000 positions to codes", measure_median_cpu_s(lambda: field.codes(*targets)), "s CPU"
    yield "1,000,000 codes to positions", measure_median_cpu_s(lambda: field.position_m(*codes)), "s CPU"
    round_trip = np.abs(np.subtract(field.codes(*field.position_m(*codes)), codes)).max()
    yield "round trip to metres and back, maximum error", round_trip, "codes"
    with tempfile.TemporaryDirectory() as name:
        points, coded, back = (f"{name}/{file}.csv" for file in ("points", "codes", "back"))
        write_field(Path(name) / "field.toml", fit)
        write_columns(Path(points), ("x_m", "y_m"), targets.T, ("%.9f", "%.9f"))
        common = ["--calibration", f"{name}/field.toml", "--points"]
        there_s = measure_command_s(*common, points, "--out", coded)
        yield "optodrive field, 1,000,000 lines to codes, whole command", there_s, "s"
        back_s = measure_command_s(*common, coded, "--inverse", "--out", back)
        yield "optodrive field --inverse, 1,000,000 lines, whole command", back_s, "s"
