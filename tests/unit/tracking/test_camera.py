"""Fingertips from a video, and their numbers."""

from types import SimpleNamespace

import numpy as np
import pytest

from optodrive.core.errors import InputError, LinkError
from optodrive.tracking.camera import (
    BACKGROUND_PICTURES,
    LIFTED_S,
    MISSED_MAX_S,
    Camera,
    FingerNumbers,
    follow_fingertips,
)
from optodrive.tracking.fingertips import load_marks
from rendered_hand import ABOVE, PITCH_M, SIZE, Finger, render, write_marks, write_video

RATE_HZ = 30.0


@pytest.fixture
def marks(tmp_path):
    return load_marks(write_marks(tmp_path / "marks.toml"))


def test_a_video_of_a_hand_gives_places_times_and_lasting_numbers(marks, tmp_path):
    random = np.random.default_rng(5)
    hands = [[Finger((-0.03 + 3e-3 * k, 0.01)), Finger((-0.01 + 3e-3 * k, 0.012))] for k in range(6)]
    pictures = [render(ABOVE, [], random) for _ in range(BACKGROUND_PICTURES)]
    pictures += [render(ABOVE, hand, random) for hand in hands]
    with Camera(str(write_video(tmp_path / "hand.avi", pictures, RATE_HZ))) as camera:
        assert not camera.is_live
        *reports, last = follow_fingertips(camera, marks)
    assert last == (pytest.approx(reports[-1].at_s + LIFTED_S), ())
    times_s = [(BACKGROUND_PICTURES + k) / RATE_HZ for k in range(6)]
    assert [report.at_s for report in reports] == pytest.approx(times_s, abs=1e-6)
    for report, hand in zip(reports, hands, strict=True):
        by_x = sorted(report.places, key=lambda place: place.x_m)
        assert [place.number for place in by_x] == [
            place.number for place in sorted(reports[0].places, key=lambda p: p.x_m)
        ]
        for place, finger in zip(by_x, hand, strict=True):
            assert np.hypot(place.x_m - finger.pad_m[0], place.y_m - finger.pad_m[1]) <= PITCH_M


def test_a_video_that_is_too_short_or_without_marks_is_refused(marks, tmp_path):
    blank = [np.full(SIZE[::-1], 90, dtype=np.uint8)] * (BACKGROUND_PICTURES + 1)
    for count, message in ((BACKGROUND_PICTURES - 1, "got 14 pictures"), (BACKGROUND_PICTURES + 1, "marks: got none")):
        path = write_video(tmp_path / f"{count}.avi", blank[:count])
        with Camera(str(path)) as camera, pytest.raises(InputError, match=message):
            list(follow_fingertips(camera, marks))


@pytest.mark.parametrize("source", ["9", "none.avi", "text.avi", "/dev/null"])
def test_a_source_without_pictures_is_refused_in_one_line(source, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "text.avi").write_text("no video")
    with pytest.raises(InputError, match="expected a camera or a video"):
        Camera(source)
    assert capfd.readouterr() == ("", "")


def test_numbers_follow_the_nearest():
    numbers = FingerNumbers()
    assert numbers.assign(0.0, np.array([[0.0, 0.0], [0.018, 0.0]])) == [0, 1]
    assert numbers.assign(0.03, np.array([[0.021, 0.0], [0.003, 0.0]])) == [1, 0]
    assert numbers.assign(0.06, np.array([[0.012, 0.0], [0.03, 0.0]])) == [0, 1]
    assert numbers.assign(0.09, np.array([[0.1, 0.0]])) == [2]


def test_a_finger_that_is_missed_for_a_moment_keeps_its_number():
    numbers, place_m = FingerNumbers(), np.array([[0.0, 0.0]])
    numbers.assign(0.0, place_m)
    assert numbers.assign(0.05, np.zeros((0, 2))) == []
    assert numbers.assign(0.09, place_m) == [0]
    assert numbers.assign(0.09 + 1.01 * MISSED_MAX_S, place_m) == [1]


def test_a_picture_that_opencv_fails_to_read_is_the_end_of_the_camera(tmp_path):
    blank = [np.full(SIZE[::-1], 90, dtype=np.uint8)] * 3
    with Camera(str(write_video(tmp_path / "three.avi", blank, RATE_HZ))) as camera:
        capture, camera.is_live = camera._capture, True

        def fail():
            raise camera._cv2.error("V4L2: select() failed")

        camera._capture = SimpleNamespace(read=fail, release=capture.release)
        with pytest.raises(LinkError, match="the camera is gone"):
            list(camera.read_pictures())
