"""Fingertips in synthetic pictures of hands over a display."""

import numpy as np
import pytest

from optodrive.tracking.fingertips import FingertipDetector, find_view, load_marks
from rendered_hand import ABOVE, BELOW, PITCH_M, SIZE, random_hand, render, take_picture, write_marks

BACKGROUNDS, PICTURES = 5, 60
SAME_M = 0.008
"""Distance within which a fingertip is taken for the true one."""


@pytest.fixture(scope="module", params=[ABOVE, BELOW], ids=["above", "below"])
def camera(request):
    return request.param


@pytest.fixture(scope="module")
def detector(camera, tmp_path_factory):
    random = np.random.default_rng(21)
    pictures = [render(camera, [], random) for _ in range(BACKGROUNDS)]
    marks = load_marks(write_marks(tmp_path_factory.mktemp("marks") / "marks.toml"))
    return FingertipDetector(find_view(pictures[0], marks, "camera"), pictures)


def match(found_m, true_m):
    """Pair each true fingertip with the nearest one that is found and not taken. Return the distances."""
    left, errors_m = list(found_m), []
    for place_m in true_m:
        distances_m = [np.hypot(*(found - place_m)) for found in left]
        if distances_m and min(distances_m) < SAME_M:
            errors_m.append(min(distances_m))
            left.pop(int(np.argmin(distances_m)))
    return errors_m


def test_pads_are_found_within_a_pitch_in_95_of_100(camera, detector, request):
    random = np.random.default_rng(22)
    errors_m, true_count, found_count = [], 0, 0
    for number in range(PICTURES):
        # Hands from the reader's side, and a quarter of them from anywhere.
        fingers = random_hand(random, count=2 if number % 3 else 1, turned=0.6 if number % 4 else np.pi)
        found_m = detector.find(take_picture(camera, fingers, random))
        errors_m += match(found_m, [np.array(finger.pad_m) for finger in fingers])
        true_count, found_count = true_count + len(fingers), found_count + len(found_m)
    missed, false = true_count - len(errors_m), found_count - len(errors_m)
    median_m, p95_m = np.quantile(errors_m, [0.5, 0.95])
    print(f"{request.node.name}: {true_count} fingertips, {missed} missed, {false} false,", end=" ")
    print(f"{1e3 * median_m:.2f} mm median, {1e3 * p95_m:.2f} mm p95")
    assert p95_m <= PITCH_M
    assert missed <= 0.03 * true_count
    assert false <= 0.06 * true_count


def test_a_display_without_hands_has_none_in_other_light(camera, detector):
    random = np.random.default_rng(23)
    for exposure in (0.6, 0.9, 1.1):
        assert detector.find(render(camera, [], random, exposure=exposure)).shape == (0, 2)


def test_spots_of_the_beam_are_no_fingertips(camera, detector):
    random = np.random.default_rng(24)
    picture = render(camera, [], random)
    places_m = np.column_stack([random.uniform(-0.07, 0.07, (30, 2)), np.zeros(30)])
    for x, y in np.rint(camera.project(places_m)).astype(int).tolist():
        picture[y - 2 : y + 3, x - 2 : x + 3] = 255
    assert len(detector.find(picture)) == 0


def test_a_covered_camera_sees_none(detector):
    for level in (0, 128, 255):
        assert len(detector.find(np.full(SIZE[::-1], level, dtype=np.uint8))) == 0
