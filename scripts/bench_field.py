"""The calibrated field: how far off it is on hidden geometries, and how long conversions take."""

import statistics
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np

from optodrive.core.numeric_tables import write_columns
from optodrive.device.config import load_config, pixel_layout
from optodrive.lab.calibration.field_fit import fit_field
from optodrive.lab.calibration.field_prior import Prior
from optodrive.lab.calibration.field_writer import write_field
from optodrive.lab.calibration.spots import Spots
from optodrive.link.simulator.true_geometry import CENTRE_CODE, Truth

GEOMETRIES, POINTS, RUNS = 10, 1_000_000, 7
NOISE_M, FALSE = 10e-6, 0.02


class Lab:
    """Hidden geometries of the default display."""

    def __init__(self):
        self.config = load_config()
        self.prior = Prior.of(self.config)
        self.half_m = float(np.abs(pixel_layout(self.config.display).x_m).max())
        self.code_m = 2.0 * self.config.scanner.focal_length_m * self.config.scanner.code_rad

    def fit(self, seed, side):
        """A grid of spots with noise and false detections, fitted."""
        truth, random = Truth.drawn(seed, self.config), np.random.default_rng([seed, side])
        at = np.rint(CENTRE_CODE + np.linspace(-self.half_m, self.half_m, side) / self.code_m)
        codes = np.stack(np.meshgrid(at, at), axis=-1).reshape(-1, 2)
        places = np.column_stack(truth.position_m(*codes.T)) + NOISE_M * random.standard_normal(codes.shape)
        false = random.random(len(codes)) < FALSE
        places[false] = random.uniform(-self.half_m, self.half_m, (int(false.sum()), 2))
        return truth, fit_field(Spots.of(np.column_stack([codes, places])), self.prior)

    def anywhere(self, count):
        """Places on the display's square, [2, count]."""
        return np.random.default_rng(5).uniform(-self.half_m, self.half_m, (2, count))

    def errors(self, side):
        """Of each geometry: rms and largest length of the miss, µm; and the share within two stated sigmas, by axis."""
        out, wanted = [], self.anywhere(3000)
        for seed in range(GEOMETRIES):
            truth, fit = self.fit(seed, side)
            codes = fit.field.codes(*wanted)
            miss = np.array(truth.position_m(*codes)) - wanted
            covered = float((np.abs(miss) <= 2.0 * fit.field.sigma_m(*codes)).mean())
            length_um = 1e6 * np.hypot(*miss)
            out.append((float(np.sqrt((length_um**2).mean())), float(length_um.max()), covered))
        return np.array(out)


def median_cpu_s(work):
    times = []
    for _ in range(RUNS):
        begin_s = time.process_time()
        work()
        times.append(time.process_time() - begin_s)
    return statistics.median(times)


def command_s(*arguments):
    begin_s = time.perf_counter()
    subprocess.run(["optodrive", *arguments], check=True, stdout=subprocess.DEVNULL)
    return time.perf_counter() - begin_s


def bench_field():
    lab, rows = Lab(), []
    for side in (17, 5, 3):
        rms_um, most_um, covered = lab.errors(side).T
        rows.append(
            (f"{side**2} spots: miss, rms length, median of {GEOMETRIES} hidden geometries", np.median(rms_um), "µm")
        )
        rows.append((f"{side**2} spots: the same, the worst geometry", rms_um.max(), "µm"))
        rows.append((f"{side**2} spots: the largest miss of all", most_um.max(), "µm"))
        rows.append((f"{side**2} spots: within two stated sigmas", covered.mean(), "1"))
    _, fit = lab.fit(0, 17)
    field, wanted = fit.field, lab.anywhere(POINTS)
    codes = field.codes(*wanted)
    rows.append(("a million places to codes", median_cpu_s(lambda: field.codes(*wanted)), "s CPU"))
    rows.append(("a million codes to places", median_cpu_s(lambda: field.position_m(*codes)), "s CPU"))
    back = np.abs(np.subtract(field.codes(*field.position_m(*codes)), codes)).max()
    rows.append(("to metres and back, the most", float(back), "codes"))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_field(folder / "field.toml", fit)
        write_columns(folder / "points.csv", ("x_m", "y_m"), wanted.T, ("%.9f", "%.9f"))
        common = ["field", "--calibration", f"{folder}/field.toml", "--points"]
        there_s = command_s(*common, f"{folder}/points.csv", "--out", f"{folder}/codes.csv")
        back_s = command_s(*common, f"{folder}/codes.csv", "--inverse", "--out", f"{folder}/back.csv")
    rows.append(("optodrive field, a million lines to codes, the whole command", there_s, "s"))
    rows.append(("optodrive field --inverse, a million lines, the whole command", back_s, "s"))
    return rows
