"""`optodrive calibrate camera`, from rendered pictures to a field. Tuned on seeds from 1000, tested on others."""

import json
import shutil
import sys

import cv2
import numpy as np
import pytest
from pages import read_output
from shown_output import find_difference

from hidden_field import CONFIG, PRIOR, field_errors_m, grid_codes
from optodrive.cli.main import run
from optodrive.device.calibrated_field import load_field
from optodrive.lab.calibration.field_fit import fit_field
from optodrive.lab.calibration.spots import MeasuredSpots, read_spots
from optodrive.link.simulator.true_geometry import GroundTruthGeometry
from rendered import GRID, PIXEL_M, describe, grid_light, marks_px, save, spot_light, taken

TRUTH = GroundTruthGeometry.sample(4, CONFIG)
CODES = grid_codes(5)
PLACES = np.column_stack(TRUTH.position_m(*CODES.T))
OUTLIER = 7
"""Index of the spot whose picture shows another position."""
PEAKS = (180.0, 700.0, 60.0)
AMBIENT_LIGHT = 20.0


def spot_picture(place_m, peak, random, share=0.0):
    """Render a spot and a distant reflection that has a share of its light."""
    light = AMBIENT_LIGHT + peak * spot_light(place_m)
    reflection = np.add(place_m, (0.012 if place_m[0] < 0 else -0.012, random.uniform(-5e-3, 5e-3)))
    return taken(light + share * peak * spot_light(reflection), random)


@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    """A folder of pictures: every third spot saturated, every third faint, every second with a reflection."""
    at, random = tmp_path_factory.mktemp("pictures"), np.random.default_rng(11)
    save(at / "grid.png", taken(180.0 * grid_light(), random))
    save(at / "dark.png", taken(np.full((1200, 1600), AMBIENT_LIGHT), random))
    rows = ["file,x_code,y_code"]
    for index, (codes, place) in enumerate(zip(CODES, PLACES, strict=True)):
        position_m = np.add(place, (2e-3, 0.0)) if index == OUTLIER else place
        name = f"spot_{codes[0]:.0f}_{codes[1]:.0f}.png"
        save(at / name, spot_picture(position_m, PEAKS[index % 3], random, 0.3 * (index % 2)))
        rows.append(f"{name},{codes[0]:.0f},{codes[1]:.0f}")
    (at / "pictures.csv").write_text("\n".join(rows) + "\n")
    describe(at)
    return at


@pytest.fixture
def folder(shared, tmp_path):
    """A copy of the shared folder that a test may change."""
    at = tmp_path / "pictures"
    shutil.copytree(shared, at, copy_function=lambda a, b: (tmp_path / "pictures" / b).hardlink_to(a))
    for name in ("pictures.toml", "pictures.csv"):
        text = (at / name).read_text()
        (at / name).unlink()
        (at / name).write_text(text)
    return at


def replace_picture(folder, name, picture):
    (folder / name).unlink()
    save(folder / name, picture)


def test_spots_within_10_um_and_a_field_as_good_as_from_a_file_of_spots(shared, capsys, tmp_path):
    assert PIXEL_M <= 0.1e-3
    assert run(["calibrate", "camera", str(shared), "--out", f"{tmp_path}/field.toml", "--json"]) == 0
    stats = json.loads(capsys.readouterr().out)
    spots = read_spots(shared / "spots.csv")
    true = np.arange(len(CODES)) != OUTLIER
    off = (np.column_stack([spots.x_m, spots.y_m]) - PLACES)[true]
    assert np.sqrt((off**2).sum(axis=1).mean()) < 10e-6
    assert stats["pixel_um"] < 100
    assert stats["outlier_pictures"] == [f"spot_{CODES[OUTLIER][0]:.0f}_{CODES[OUTLIER][1]:.0f}.png"]
    assert len(stats["saturated_pictures"]) == 8
    assert stats["outside_pictures"] == []
    assert stats["spots_file"] == f"{shared}/spots.csv"
    missed, _ = field_errors_m(TRUTH, load_field(tmp_path / "field.toml"))
    noisy = np.random.default_rng(12).normal(PLACES, 10e-6)
    by_file, _ = field_errors_m(
        TRUTH, fit_field(MeasuredSpots.from_table(np.column_stack([CODES, noisy])), PRIOR).field
    )
    assert np.sqrt((missed**2).mean()) < np.sqrt((by_file**2).mean())


@pytest.mark.slow
def test_what_it_wrote_gives_the_same_field_by_spots(shared, tmp_path, capsys):
    assert run(["calibrate", "camera", str(shared), "--out", f"{tmp_path}/a.toml"]) == 0
    output = capsys.readouterr().out
    shown = read_output("docs/how-to/calibrate-by-camera.md", "optodrive calibrate camera")
    assert find_difference(shown, output) == ""
    assert f"outlier pictures spot_{CODES[OUTLIER][0]:.0f}_{CODES[OUTLIER][1]:.0f}.png\n" in output
    assert run(["calibrate", "field", f"{shared}/spots.csv", "--out", f"{tmp_path}/b.toml"]) == 0
    a, b = (load_field(tmp_path / name).position_m(*CODES.T) for name in ("a.toml", "b.toml"))
    assert np.allclose(a, b, rtol=0.0, atol=1e-8)


@pytest.mark.slow
def test_codes_from_names_and_no_dark_picture_give_the_same_spots(shared, folder):
    describe(folder, dark=None, spots='pictures = "spot_*.png"')
    assert run(["calibrate", "camera", str(folder)]) == 0
    spots = read_spots(folder / "spots.csv")
    order = np.lexsort((CODES[:, 1], CODES[:, 0]))
    by_name = np.lexsort((spots.y_code, spots.x_code))
    off = np.column_stack([spots.x_m, spots.y_m])[by_name] - PLACES[order]
    assert np.sqrt((np.delete(off, np.flatnonzero(order == OUTLIER), axis=0) ** 2).sum(axis=1).mean()) < 10e-6


def test_a_spot_outside_the_grid_is_warned_of(folder, capsys):
    """pictures.toml describes only the upper rows of the grid, so that a spot lies outside it."""
    small = GRID | {"rows": 7}
    replace_picture(folder, "grid.png", taken(180.0 * grid_light(grid=small), np.random.default_rng(13)))
    describe(folder, small)
    rows = (folder / "pictures.csv").read_text().splitlines(keepends=True)
    (folder / "pictures.csv").write_text("".join(rows[:7]))
    assert run(["calibrate", "camera", str(folder)]) == 0
    output = capsys.readouterr().out
    name = f"spot_{CODES[0][0]:.0f}_{CODES[0][1]:.0f}.png"
    assert f"warning          {name}" in output
    assert "outside the grid" in output


def remove_grid(folder):
    replace_picture(folder, "grid.png", np.full((1200, 1600), 90, np.uint8))


def flip_grid(folder):
    replace_picture(folder, "grid.png", cv2.imread(f"{folder}/grid.png", 0)[:, ::-1])
    describe(folder, marks=[1599.0, 0.0] + marks_px() * [-1.0, 1.0])


def remove_spot(folder):
    replace_picture(folder, "spot_32768_32768.png", cv2.imread(f"{folder}/dark.png", 0))
    write_row("spot_32768_32768.png,32768,32768\n")(folder)


def two_equal_spots(folder):
    picture = spot_picture(np.array([0.0, 0.0]), 150.0, np.random.default_rng(1), 0.95)
    replace_picture(folder, "spot_32768_32768.png", picture)
    write_row("spot_32768_32768.png,32768,32768\n")(folder)


def resize_dark_picture(folder):
    replace_picture(folder, "dark.png", np.zeros((600, 800), np.uint8))


def corrupt_picture(folder):
    (folder / "grid.png").unlink()
    (folder / "grid.png").write_text("none")


def write_row(text):
    return lambda folder: (folder / "pictures.csv").write_text("file,x_code,y_code\n" + text)


WRONG = {
    "no grid": (
        remove_grid,
        "grid.png: got 'no such grid in the picture', expected a chessboard of 10 rows × 13 columns",
    ),
    "fewer corners": (lambda f: describe(f, GRID | {"rows": 8}, marks=marks_px()), "grid.png: corners: got '10 × 13'"),
    "squares counted": (
        lambda f: describe(f, GRID | {"rows": 11, "columns": 14}, marks=marks_px()),
        "grid.png: corners: got '10 × 13', expected 11 rows × 14 columns: inner corners, one fewer than squares",
    ),
    "flipped": (flip_grid, "mirrored in the picture"),
    "marks anywhere": (lambda f: describe(f, marks=np.add(marks_px(), (0, 900))), "origin.marks_px"),
    "marks twice": (lambda f: describe(f, marks=marks_px()[[0, 1, 1]]), "three corners of the grid"),
    "millimetres": (lambda f: describe(f, GRID | {"pitch_m": 7.5}, marks=marks_px()), "this value is likely in mm"),
    "another pitch": (lambda f: describe(f, GRID | {"pitch_m": 5e-3}, marks=marks_px()), "× the commanded ones"),
    "no spot": (remove_spot, "spot_32768_32768.png: got 'nothing brighter than"),
    "alike": (two_equal_spots, "spot_32768_32768.png: got 'two similar spots, at"),
    "other size": (resize_dark_picture, "dark.png: got '800 × 600 pixels', expected 1600 × 1200, as grid.png"),
    "no picture": (corrupt_picture, "grid.png: got 'no picture'"),
    "missing": (write_row("none.png,1,2\n"), "pictures.csv: row 2: file: got 'none.png', expected a picture in"),
    "missing grid": (lambda f: describe(f, views=("none.png",)), "grid.pictures: got 'none.png'"),
    "metres": (write_row("grid.png,-0.01,2\n"), "row 2: x_code: got -0.01, expected a code, 0 to 65535"),
    "columns": (write_row("grid.png,1\n"), "row 2: got 2 cells, 'grid.png,1'"),
    "head": (lambda f: (f / "pictures.csv").write_text("a,b\n"), "first line"),
    "names": (lambda f: describe(f, spots='pictures = "grid.png"'), "a name that ends with both codes"),
    "both": (lambda f: describe(f, spots='table = "a"\npictures = "b"'), "exactly one of table and pictures"),
    "two views": (lambda f: describe(f, views=("grid.png",) * 2), "grid.pictures: got 2, expected 1, or at least 3"),
    "own table": (lambda f: describe(f, spots='table = "spots.csv"'), "a name other than spots.csv"),
    "kind": (lambda f: describe(f, GRID | {"kind": "hexagons"}, marks=marks_px()), "grid.kind: got 'hexagons'"),
    "no description": (lambda f: (f / "pictures.toml").unlink(), "pictures.toml: got 'No such file or directory'"),
    "no OpenCV": (None, "expected the extra: pip install 'optodrive[camera]'"),
}


@pytest.mark.parametrize(
    "case", [pytest.param(case, marks=pytest.mark.slow) if k % 6 != 3 else case for k, case in enumerate(sorted(WRONG))]
)
def test_what_is_wrong_is_named_in_one_line(folder, capsys, monkeypatch, case):
    spoil, named = WRONG[case]
    if spoil is None:
        monkeypatch.setitem(sys.modules, "cv2", None)
    else:
        spoil(folder)
    assert run(["calibrate", "camera", str(folder), "--out", f"{folder}/field.toml"]) == 2
    captured = capsys.readouterr()
    assert named in captured.err
    assert captured.err.count("\n") == 1
    assert captured.out == ""
    assert not (folder / "field.toml").exists()


def test_a_folder_that_does_not_exist_is_refused(shared, capsys):
    assert run(["calibrate", "camera", f"{shared}/none"]) == 2
    assert "a folder with pictures.toml" in capsys.readouterr().err
