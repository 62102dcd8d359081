"""Trackers of fingertips: a recorded film brings light under the fingers, and wrong input gets one line."""

import os
import re
import signal

import numpy as np
import pytest

from forked_process import OPTODRIVE, run_process, start_process
from optodrive.tracking.camera import BACKGROUND_PICTURES
from rendered_hand import ABOVE, SIZE, Finger, render, write_marks, write_video
from rig import TOKEN, running, wait_for
from test_standing_frames import LEAD, PLACES, compute_lead, count_pulses, send_page, show
from touch_film import SimulatedFilm

PAGE = tuple(range(50, 400, 2))  # two fingers touch no more dots than the beam refreshes in time
CORNERS = (0, 18, 417, 397)


FINGERS = (120, 324)
FAR = [
    pixel
    for pixel in PAGE
    if pixel in FINGERS or min(np.hypot(*np.subtract(PLACES[pixel], PLACES[finger])) for finger in FINGERS) > 0.015
]


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    with running(tmp_path_factory.mktemp("trackers")) as rig:
        yield rig


@pytest.fixture(scope="module")
def calibration(tmp_path_factory):
    """Touch the corners, and let the command fit the film's place."""
    folder = tmp_path_factory.mktemp("film")
    film, random, end_s = SimulatedFilm(), np.random.default_rng(4), 0.0
    for pixel in CORNERS:
        end_s = film.touch(end_s, np.array(PLACES[pixel]) + 5e-4 * random.standard_normal(2))
    film.write(folder / "touches.evemu")
    done = run("calibrate", "film", folder / "touches.evemu", "--out", folder / "film.toml")
    assert re.search(r"^touches          4, 0\.\d+ mm from their pixels", done.stdout), done
    assert done.stderr.count("touch pixel") == 4
    return folder / "film.toml"


def run(*arguments, url="http://127.0.0.1:9", status=0):
    environment = {**os.environ, "OPTODRIVE_TOKEN": TOKEN, "OPTODRIVE_URL": url}
    done = run_process([OPTODRIVE, *map(str, arguments)], env=environment, capture_output=True, text=True)
    assert done.returncode == status, done
    return done


def follow_both(board, daemon, end, *source):
    """Report fingertips from a source until both fingers have more light, and end that by a signal."""
    environment = {**os.environ, "OPTODRIVE_TOKEN": TOKEN, "OPTODRIVE_URL": daemon.url}
    with start_process([OPTODRIVE, "fingers", *source, "--repeat"], env=environment) as command:
        for finger, other in (FINGERS, FINGERS[::-1]):
            far = [pixel for pixel in FAR if pixel != other]
            wait_for(lambda f=finger, far=far: compute_lead(board, f, far) >= LEAD, "more light under a finger")
        command.send_signal(end)
        assert command.wait() == 130


def test_a_recorded_film_brings_light_under_the_fingers_and_under_no_others(rig, calibration, tmp_path):
    board, daemon = rig
    daemon.arm()
    film = SimulatedFilm(seed=9)
    fingers = {"index": lambda _: PLACES[120], "middle": lambda _: PLACES[324]}
    end_s = film.move(0.0, 1.0, fingers)
    lost = len(film.events)
    end_s = film.move(end_s, 0.1, fingers)
    film.events[lost : len(film.events) - 2] = [(end_s - 0.1, 0, 3, 0)]  # the kernel's buffer overflows
    film.restate(end_s)
    film.move(end_s, 0.2, {"middle": fingers["middle"]})
    recording = film.write(tmp_path / "hand.evemu")
    with show(daemon) as stream:
        send_page(stream, PAGE)
        follow_both(board, daemon, signal.SIGINT, "--film", recording, "--calibration", calibration)
        since = len(board.of("pulse"))
        wait_for(lambda: min(count_pulses(board, since)[pixel] for pixel in PAGE) >= 1, "the whole page")


def test_a_recording_that_ends_says_so(rig, calibration, tmp_path):
    film = SimulatedFilm()
    film.touch(0.0, PLACES[120])
    done = run("fingers", "--film", film.write(tmp_path / "hand.evemu"), "--calibration", calibration, url=rig[1].url)
    assert re.fullmatch(r"\d+ reports of fingertips in \S+ s\n", done.stdout)
    assert int(done.stdout.split()[0]) > 40


def test_a_video_of_a_hand_brings_light_under_its_fingers(rig, tmp_path):
    board, daemon = rig
    daemon.call("POST", "/v1/disarm")
    daemon.arm()
    board.forget()
    random = np.random.default_rng(6)
    pictures = [render(ABOVE, [], random) for _ in range(BACKGROUND_PICTURES)]
    pictures += [render(ABOVE, [Finger(PLACES[120]), Finger(PLACES[324])], random) for _ in range(4)] * 10
    video, marks = write_video(tmp_path / "hand.avi", pictures), write_marks(tmp_path / "marks.toml")
    with show(daemon) as stream:
        send_page(stream, PAGE)
        follow_both(board, daemon, signal.SIGTERM, "--camera", video, "--marks", marks)


def test_a_video_without_marks_gets_one_line(rig, tmp_path):
    video = write_video(tmp_path / "blank.avi", [np.full(SIZE[::-1], 90, dtype=np.uint8)] * 16)
    arguments = ["--camera", video, "--marks", write_marks(tmp_path / "marks.toml")]
    error = run("fingers", *arguments, url=rig[1].url, status=2).stderr
    assert error == f"optodrive: {video}: marks: got none, expected 4 of the marks 7, 3, 11, 0 in a picture\n"


REFUSALS = {
    "no source": ([], "FILE.csv, --film or --camera: missing, expected one source of fingertips"),
    "two sources": (["hand.csv", "--film", "x"], "FILE.csv, --film or --camera: got FILE.csv and --film"),
    "no film": (["--film", "/dev/input/event99", "--calibration", "film.toml"], "No such file or directory"),
    "another device": (["--film", "/dev/null", "--calibration", "film.toml"], "expected a multitouch film"),
    "no calibration": (["--film", "x"], "--calibration: missing, expected film.toml, an output of"),
    "lost calibration": (["--film", "hand.evemu", "--calibration", "none.toml"], "none.toml: got 'No such file"),
    "recorded twice": (["--film", "hand.evemu", "--calibration", "film.toml", "--record", "y"], "--record: got 'y'"),
    "no film to calibrate": (["hand.csv", "--calibration", "film.toml"], "--calibration: got 'film.toml'"),
    "no camera": (["--camera", "9", "--marks", "marks.toml"], "/dev/video9: got no such file, expected a camera"),
    "no marks": (["--camera", "9"], "--marks: missing, expected marks.toml"),
    "marks for a film": (["hand.csv", "--marks", "marks.toml"], "--marks: got 'marks.toml', expected --camera with it"),
    "no video": (["--camera", "hand.evemu", "--marks", "marks.toml"], "hand.evemu: got no pictures"),
    "device repeated": (["--film", "/dev/null", "--calibration", "film.toml", "--repeat"], "--repeat: got a device"),
}


@pytest.mark.parametrize("case", REFUSALS)
def test_wrong_options_get_one_line(case, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    film = SimulatedFilm()
    film.touch(0.0, PLACES[120])
    film.write(tmp_path / "hand.evemu")
    write_marks(tmp_path / "marks.toml")
    arguments, message = REFUSALS[case]
    error = run("fingers", *arguments, status=2).stderr
    assert message in error
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--pixels", "0,18,9999"], "--pixels: got '0,18,9999', expected pixels from 0 to 436"),
        (["--pixels", "0,18,18"], "each pixel once"),
        (["--pixels", "0"], "touches: got 1, expected at least 3"),
        (["--pixels", "0,18,436"], "got 1 touches, expected 3, one at each pixel"),
    ],
)
def test_touches_that_do_not_suffice_get_one_line(arguments, message, tmp_path):
    film = SimulatedFilm()
    film.touch(0.0, PLACES[0])
    recording = film.write(tmp_path / "touches.evemu")
    error = run("calibrate", "film", recording, "--out", tmp_path / "film.toml", *arguments, status=2).stderr
    assert message in error.splitlines()[-1]
    assert not (tmp_path / "film.toml").exists()
