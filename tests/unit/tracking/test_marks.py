"""The display's marks in pictures."""

from dataclasses import replace

import numpy as np
import pytest

from optodrive.core.errors import InputError
from optodrive.tracking.fingertips import find_view, load_marks, project
from rendered_hand import ABOVE, BELOW, MARKS, SIDE_M, SIZE, render, write_marks

GRID = np.array([[x, y] for x in (-0.07, 0.0, 0.07) for y in (-0.07, 0.0, 0.07)])


@pytest.mark.parametrize("camera", [ABOVE, BELOW, replace(ABOVE, at_m=(0.2, 0.1, 0.45))])
def test_the_map_is_that_of_the_camera(camera, tmp_path):
    picture = render(camera, [], np.random.default_rng(3))
    view = find_view(picture, load_marks(write_marks(tmp_path / "marks.toml")), "camera")
    true_px = camera.project(np.column_stack([GRID, np.zeros(len(GRID))]))
    error_m = project(np.linalg.inv(view.homography), true_px) - GRID
    assert np.abs(error_m).max() < 5e-4
    assert np.abs(project(view.homography, GRID) - true_px).max() < 1.5


def test_pictures_without_the_marks_are_refused(tmp_path):
    marks = load_marks(write_marks(tmp_path / "marks.toml"))
    with pytest.raises(InputError, match="camera: marks: got none, expected 4 of the marks 7, 3, 11, 0 in a picture"):
        find_view(np.zeros(SIZE[::-1], dtype=np.uint8), marks, "camera")
    picture = render(ABOVE, [], np.random.default_rng(3))
    x, y = ABOVE.project([[*MARKS[11], 0.0]])[0].astype(int)
    picture[y - 5 : y + 60, x - 5 : x + 5] = 90
    with pytest.raises(InputError, match="camera: marks: got 7, 3, 0, expected 4 of") as refused:
        find_view(picture, marks, "camera")
    assert refused.value.code == "marks_missing"


@pytest.mark.parametrize(
    ("change", "side_m"),
    [
        ({3: MARKS[7], 7: MARKS[3]}, SIDE_M),
        ({11: (0.094, 0.05)}, SIDE_M),
        ({}, 0.9 * 0.8 * SIDE_M),
    ],
)
def test_marks_that_are_elsewhere_than_stated_are_refused(change, side_m, tmp_path):
    marks = load_marks(write_marks(tmp_path / "marks.toml", MARKS | change, side_m))
    with pytest.raises(InputError, match="are the marks where"):
        find_view(render(ABOVE, [], np.random.default_rng(3)), marks, "camera")


def test_four_of_five_marks_suffice(tmp_path):
    marks = load_marks(write_marks(tmp_path / "marks.toml", MARKS | {40: (0.0, 0.2)}))
    view = find_view(render(ABOVE, [], np.random.default_rng(3)), marks, "camera")
    assert view.marks_m.shape == (5, 2)


@pytest.mark.parametrize(
    ("marks", "side_m", "message"),
    [
        (dict(list(MARKS.items())[:3]), SIDE_M, "marks: got"),
        ({number: (0.01 * number, 0.02) for number in range(4)}, SIDE_M, "marks: got marks on one line"),
        (MARKS | {50: (0.0, 0.0)}, SIDE_M, "marks.4.id: got 50"),
        (MARKS, 16.0, "side_m: got 16.0"),
        (MARKS | {7: (94.0, 0.0)}, SIDE_M, "marks[0].x_m: got 94.0"),
    ],
)
def test_a_wrong_file_is_refused_by_its_key(marks, side_m, message, tmp_path):
    with pytest.raises(InputError) as refused:
        load_marks(write_marks(tmp_path / "marks.toml", marks, side_m))
    assert message in str(refused.value)


def test_a_file_of_another_version_and_a_mark_twice_are_refused(tmp_path):
    path = write_marks(tmp_path / "marks.toml")
    text = path.read_text()
    for old, new, message in (("version = 1", "version = 2", "version: got 2"), ("id = 3", "id = 7", "each id once")):
        path.write_text(text.replace(old, new))
        with pytest.raises(InputError, match=message):
            load_marks(path)
