"""`optodrive calibrate field` and `optodrive field`, run as commands."""

import json

import numpy as np
import pytest

from hidden_field import CONFIG, HALF_M, grid_codes, measure_spots
from optodrive.cli.main import run
from optodrive.device.calibrated_field import load_field
from optodrive.lab.calibration.field_output import (
    NODE_SPACING_CODES,
    NODES_PER_SIDE,
    compute_corrections,
    read_correction_grid,
)
from optodrive.lab.calibration.spots import MeasuredSpots, write_spots
from optodrive.link.simulator.true_geometry import GroundTruthGeometry

TRUTH = GroundTruthGeometry.sample(4, CONFIG)
SPOTS, IS_OUTLIER = measure_spots(TRUTH, grid_codes(17), np.random.default_rng(2))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with spots.csv and the field.toml fitted to it."""
    at = tmp_path_factory.mktemp("calibrated")
    write_spots(at / "spots.csv", SPOTS, CONFIG.name)
    assert run(["calibrate", "field", f"{at}/spots.csv", "--out", f"{at}/field.toml"]) == 0
    return at


def test_json_gives_residual_sigma_and_outliers(folder, capsys):
    assert IS_OUTLIER.any()
    assert run(["calibrate", "field", f"{folder}/spots.csv", "--json"]) == 0
    stats = json.loads(capsys.readouterr().out)
    assert stats["outlier_rows"] == np.flatnonzero(IS_OUTLIER).tolist()
    assert 12 < stats["residual_rms_um"] < 16
    assert stats["residual_max_um"] < 60
    assert np.shape(stats["sigma_um"]) == (3, 3)
    assert stats["sigma_um"][1][1] < stats["sigma_um"][0][0] < 10


def test_text_names_the_outliers_by_line(folder, capsys):
    assert run(["calibrate", "field", f"{folder}/spots.csv"]) == 0
    output = capsys.readouterr().out
    lines = (folder / "spots.csv").read_text().splitlines()
    named = [int(word) for word in output.splitlines()[1].replace(",", " ").split()[2:]]
    assert named == (np.flatnonzero(IS_OUTLIER) + 3).tolist()
    for line in named:
        x_code, y_code, x_m, y_m = map(float, lines[line - 1].split(","))
        assert np.hypot(*np.subtract(TRUTH.position_m(x_code, y_code), (x_m, y_m))) > 1e-4


def test_the_report_stands_alone(folder):
    arguments = ["calibrate", "field", f"{folder}/spots.csv", "--report", f"{folder}/report.html"]
    assert run(arguments) == 0
    html = (folder / "report.html").read_text()
    assert html.count("<svg") == 2
    assert html.count("<title>row ") == IS_OUTLIER.sum()
    assert not any(word in html for word in ("http", "src=", "<script", "url("))


def test_codes_lead_to_within_the_figures_and_back_within_a_tenth_of_a_code(folder, capsys):
    targets = np.random.default_rng(0).uniform(-HALF_M, HALF_M, (500, 2))
    rows = "".join(f"{x:.12f},{y:.12f}\n" for x, y in targets)
    (folder / "points.csv").write_text("x_m,y_m\n" + rows)
    there = ["field", "--calibration", f"{folder}/field.toml", "--points", f"{folder}/points.csv"]
    assert run([*there, "--out", f"{folder}/codes.csv", "--json"]) == 0
    done = json.loads(capsys.readouterr().out)
    assert done["points"] == 500
    assert done["outside"] == 0
    codes = np.loadtxt(folder / "codes.csv", delimiter=",", skiprows=1)
    landed = np.column_stack(TRUTH.position_m(codes[:, 0], codes[:, 1]))
    assert np.hypot(*(landed - targets).T).max() < 25e-6
    back = ["field", "--calibration", f"{folder}/field.toml", "--points", f"{folder}/codes.csv", "--inverse"]
    assert run([*back, "--out", f"{folder}/back.csv"]) == 0
    again = np.loadtxt(folder / "back.csv", delimiter=",", skiprows=1)
    code_m = 2.0 * CONFIG.scanner.focal_length_m * CONFIG.scanner.rad_per_code
    assert np.abs(again - targets).max() < 0.1 * code_m


def test_a_grid_there_and_back_within_a_code(folder):
    assert run(["field", "--calibration", f"{folder}/field.toml", "--export", f"{folder}/grid.cor"]) == 0
    scale, moved = read_correction_grid(folder / "grid.cor")
    field = load_field(folder / "field.toml")
    assert np.array_equal(moved, compute_corrections(field))
    assert scale == pytest.approx(1e-3 / (2.0 * CONFIG.scanner.focal_length_m * CONFIG.scanner.rad_per_code))
    assert run(["field", "--import", f"{folder}/grid.cor", "--out", f"{folder}/again.toml"]) == 0
    targets = np.random.default_rng(1).uniform(-HALF_M, HALF_M, (2, 500))
    assert np.abs(np.subtract(load_field(folder / "again.toml").codes(*targets), field.codes(*targets))).max() < 1.0
    assert np.abs(np.subtract(interpolate_grid(scale, moved, *targets), field.codes(*targets))).max() < 1.0


def interpolate_grid(scale, moved, x_m, y_m):
    """Return codes by bilinear interpolation of the grid."""
    codes = np.array([x_m, y_m]) * 1e3 * scale + 32768
    column, row = np.minimum((codes / NODE_SPACING_CODES).astype(int), NODES_PER_SIDE - 2)
    x, y = codes / NODE_SPACING_CODES - [column, row]
    low = moved[row, column].T * (1 - x) + moved[row, column + 1].T * x
    high = moved[row + 1, column].T * (1 - x) + moved[row + 1, column + 1].T * x
    return codes + low * (1 - y) + high * y


@pytest.mark.parametrize(
    ("spoil", "named"),
    [
        (lambda raw: raw[:-8], "size: got 68120, expected 68128 bytes"),
        (lambda raw: b"JCZ_COR_2_1" + raw[11:], "LMC1COR_1.0"),
        (lambda raw: raw[:368] + bytes(8) + raw[376:], "codes per millimetre: got 0.0"),
        (lambda raw: raw[:528] + raw[528:560] * 2112 + raw[-16:], "from which the best field deviates"),
    ],
)
def test_a_grid_that_is_none_is_refused(folder, capsys, spoil, named):
    run(["field", "--calibration", f"{folder}/field.toml", "--export", f"{folder}/whole.cor"])
    (folder / "spoilt.cor").write_bytes(spoil((folder / "whole.cor").read_bytes()))
    capsys.readouterr()
    assert run(["field", "--import", f"{folder}/spoilt.cor", "--out", f"{folder}/none.toml"]) == 2
    output = capsys.readouterr().err
    assert named in output
    assert output.count("\n") == 1
    assert not (folder / "none.toml").exists()


WRONG = {
    "mirrored": ([], lambda t: t * [1, 1, -1, 1], "x mirrored"),
    "inches": ([], lambda t: t / [1, 1, 0.0254, 0.0254], "inches"),
    "still": ([], lambda t: np.column_stack([t[:, :2], 0.0 * t[:, 2:]]), "measured at one place"),
    "few": ([], lambda t: t[:4], "at least 6"),
    "half false": ([], lambda t: np.vstack([t[:40], t[40:100, [0, 1, 3, 2]]]), "x_m, y_m"),
    "other display": (["--config", "display-9999"], lambda t: t, "--config"),
}


@pytest.mark.parametrize("case", sorted(WRONG))
def test_wrong_spots_end_with_one_line_and_status_2(tmp_path, capsys, case):
    options, spoil, named = WRONG[case]
    write_spots(tmp_path / "spots.csv", MeasuredSpots.from_table(spoil(SPOTS.to_table())), CONFIG.name)
    arguments = ["calibrate", "field", f"{tmp_path}/spots.csv", "--out", f"{tmp_path}/field.toml", *options]
    assert run(arguments) == 2
    captured = capsys.readouterr()
    assert named in captured.err
    assert captured.err.count("\n") == 1
    assert captured.out == ""
    assert not (tmp_path / "field.toml").exists()


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("x_m,y_m\n0.01,0\n0.2,0\n", "row 3: got '0.2, 0 m', expected a position that a code reaches"),
        ("x_code,y_code\n1,2\n", "first line"),
        ("x_m,y_m\n0.01,0,0\n", "row 2"),
        ("x_m,y_m\n0.01,inf\n", "row 2: y_m: got inf"),
    ],
)
def test_wrong_points_end_with_one_line_and_status_2(folder, capsys, text, named):
    (folder / "wrong.csv").write_text(text)
    arguments = ["field", "--calibration", f"{folder}/field.toml", "--points", f"{folder}/wrong.csv"]
    assert run([*arguments, "--out", f"{folder}/none.csv"]) == 2
    assert named in capsys.readouterr().err
    assert not (folder / "none.csv").exists()


def test_places_where_nothing_was_calibrated_are_counted(folder, capsys):
    (folder / "far.csv").write_text("x_m,y_m\n0.0,0.0\n0.06,0.0\n")
    arguments = ["field", "--calibration", f"{folder}/field.toml", "--points", f"{folder}/far.csv"]
    assert run([*arguments, "--out", f"{folder}/far-codes.csv"]) == 0
    assert "1 points lie outside the calibrated region" in capsys.readouterr().out


@pytest.mark.parametrize("command", ["plan", "simulate"])
def test_plan_and_simulate_take_a_field(folder, capsys, command):
    (folder / "frames.json").write_text(
        '{"frames": [{"show_at_s": 0.0, "duration_s": 0.5, "target_um": {"0": 20, "200": 20}}]}'
    )
    assert run([command, f"{folder}/frames.json", "--field", f"{folder}/field.toml", "--json"]) == 0
    capsys.readouterr()
    assert run([command, f"{folder}/frames.json", "--field", f"{folder}/nowhere.toml"]) == 2
    assert "nowhere.toml" in capsys.readouterr().err
    large = ["--config", "display-1511", "--field", f"{folder}/field.toml"]
    assert run([command, f"{folder}/frames.json", *large]) == 2
    assert "pixel 0 of display-1511 at" in capsys.readouterr().err
