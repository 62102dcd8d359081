"""Map from rendered grids to the display, for cameras not used for tuning."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from optodrive.core.errors import InputError
from optodrive.lab.calibration.picture_plane import find_grid, fit_plane, grid_corners_m, orient_to_marks
from optodrive.lab.calibration.pictures import GridSection, OriginSection
from rendered import CAMERA, FIRST_M, GRID, SIZE, TILTED, TURN_RAD, Camera, corners_m, grid_light, marks_px, taken

DOTS = GRID | {"kind": "circles"}
WIDE_ANGLE = Camera(off_m=(0.03, 0.05), away_m=0.21, focal_px=2700.0, middle_px=(790.0, 607.0), k1=-0.2, k2=0.06)
UPSIDE_DOWN = replace(CAMERA, roll_rad=np.pi + 0.1)
PORTRAIT = replace(CAMERA, roll_rad=0.5 * np.pi, focal_px=4400.0)
PLACES_M = np.random.default_rng(5).uniform(-36e-3, 36e-3, (500, 2))


def section(grid):
    return GridSection(**grid, pictures=("grid.png",))


def origin(camera=CAMERA):
    marks = tuple((float(x), float(y)) for x, y in marks_px(camera=camera))
    return OriginSection(marks_px=marks, first_corner_m=FIRST_M, turn_rad=TURN_RAD)


def find_rendered_grid(camera, grid, seed, noise=2.0):
    picture = taken(180.0 * grid_light(camera, grid), np.random.default_rng(seed), noise)
    return find_grid(Path("grid.png"), picture, section(grid))


def fit_rendered_plane(cameras, grid=GRID, noise=2.0):
    views = [find_rendered_grid(camera, grid, seed, noise) for seed, camera in enumerate(cameras)]
    views[0] = orient_to_marks("it", views[0], origin(cameras[0]))
    return fit_plane(views, grid_corners_m(section(grid), origin()), grid["pitch_m"], SIZE)


def position_errors_m(plane, camera):
    return np.hypot(*(plane.position_m(camera.pixel(PLACES_M)) - PLACES_M).T)


def test_the_grid_is_placed_by_first_corner_and_rotation():
    assert np.allclose(grid_corners_m(section(GRID), origin()), corners_m(), rtol=0.0, atol=1e-12)


@pytest.mark.parametrize(
    ("cameras", "grid"),
    [
        pytest.param((CAMERA,), GRID, marks=pytest.mark.slow),
        ((CAMERA,), DOTS),
        ((WIDE_ANGLE,), GRID),
        pytest.param((UPSIDE_DOWN,), GRID, marks=pytest.mark.slow),
        pytest.param((PORTRAIT,), GRID, marks=pytest.mark.slow),
    ],
    ids=["chessboard", "dots", "wide lens", "upside down", "upright"],
)
def test_one_picture_of_the_grid_is_enough_for_5_um(cameras, grid):
    plane = fit_rendered_plane(cameras, grid)
    off = position_errors_m(plane, cameras[0])
    assert np.sqrt((off**2).mean()) < 5e-6
    assert off.max() < 15e-6
    assert plane.residual_px < 0.05


@pytest.mark.slow
def test_several_views_calibrate_the_camera():
    plane = fit_rendered_plane((CAMERA, *TILTED))
    assert plane.camera is not None
    matrix, _ = plane.camera
    assert matrix[0, 0] == pytest.approx(CAMERA.focal_px, rel=0.01)
    assert np.sqrt((position_errors_m(plane, CAMERA) ** 2).mean()) < 5e-6


def test_the_stated_sigma_matches_the_effect_of_corner_noise():
    """Corners are moved at random by a known amount, many times."""
    random, exact = np.random.default_rng(3), CAMERA.pixel(corners_m().reshape(-1, 2))
    off, stated = [], []
    for _ in range(30):
        moved = (exact + random.normal(0.0, 0.2, exact.shape)).reshape(*corners_m().shape)
        plane = fit_plane([moved], corners_m(), GRID["pitch_m"], SIZE)
        off.append(plane.position_m(CAMERA.pixel(PLACES_M)) - PLACES_M)
        stated.append(plane.sigma_m(CAMERA.pixel(PLACES_M)))
        assert 0.17 < plane.residual_px < 0.23
    assert 0.7 < np.sqrt(np.mean(np.square(off))) / np.sqrt(np.mean(np.square(stated))) < 1.4


@pytest.mark.slow
def test_a_homography_without_distortion_would_miss():
    """Mutant: a homography alone."""
    exact = CAMERA.pixel(corners_m().reshape(-1, 2))
    straight = np.column_stack([exact, np.ones(len(exact))])
    places = corners_m().reshape(-1, 2)
    rows = [np.r_[p, 0, 0, 0, -x * p] for p, (x, _) in zip(straight, places, strict=True)]
    rows += [np.r_[0, 0, 0, p, -y * p] for p, (_, y) in zip(straight, places, strict=True)]
    matrix = np.linalg.svd(np.array(rows) / [*[1e3, 1e3, 1.0] * 2, 1e3, 1e3, 1.0])[2][-1]
    matrix = (matrix / [*[1e3, 1e3, 1.0] * 2, 1e3, 1e3, 1.0]).reshape(3, 3)
    through = np.column_stack([CAMERA.pixel(PLACES_M), np.ones(len(PLACES_M))]) @ matrix.T
    assert np.hypot(*(through[:, :2] / through[:, 2:] - PLACES_M).T).max() > 50e-6


@pytest.mark.parametrize("turn", range(4))
def test_marks_orient_the_grid_from_any_detected_order(turn):
    exact = CAMERA.pixel(corners_m().reshape(-1, 2)).reshape(*corners_m().shape)
    given = exact[:: 1 - 2 * (turn & 1), :: 1 - (turn & 2)]
    assert np.array_equal(orient_to_marks("it", given, origin()), exact)


def test_marks_along_a_column_are_named():
    exact = CAMERA.pixel(corners_m().reshape(-1, 2)).reshape(*corners_m().shape)
    first, right, down = marks_px()
    along_column = (right, right + down - first, first)
    marks = tuple((float(x), float(y)) for x, y in along_column)
    with pytest.raises(InputError, match="a first row of 10 and 13 rows"):
        orient_to_marks("it", exact, origin().model_copy(update={"marks_px": marks}))
