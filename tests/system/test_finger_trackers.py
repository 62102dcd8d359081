"""Trackers of fingertips: a recorded film brings light under the fingers, and wrong input gets one line."""

import os
import re
import signal
import subprocess

import numpy as np
import pytest

from forked_process import OPTODRIVE, start_process
from rig import TOKEN, running, wait_for
from test_standing_frames import LEAD, PLACES, compute_lead, count_pulses, send_page, show
from touch_film import SimulatedFilm

PAGE = tuple(range(50, 400))
CORNERS = (0, 18, 417, 397)


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
    done = subprocess.run([OPTODRIVE, *map(str, arguments)], env=environment, capture_output=True, text=True)
    assert done.returncode == status, done
    return done


def test_a_recorded_film_brings_light_under_the_fingers_and_under_no_others(rig, calibration, tmp_path):
    board, daemon = rig
    daemon.arm()
    film = SimulatedFilm(seed=9)
    fingers = {"index": lambda _: PLACES[120], "middle": lambda _: PLACES[325]}
    end_s = film.move(0.0, 1.0, fingers)
    lost = len(film.events)
    end_s = film.move(end_s, 0.1, fingers)
    film.events[lost : len(film.events) - 2] = [(end_s - 0.1, 0, 3, 0)]  # the kernel's buffer overflows
    film.restate(end_s)
    film.move(end_s, 1.0, {"middle": fingers["middle"]})
    recording = film.write(tmp_path / "hand.evemu")
    environment = {**os.environ, "OPTODRIVE_TOKEN": TOKEN, "OPTODRIVE_URL": daemon.url}
    with show(daemon) as stream:
        send_page(stream, PAGE)
        arguments = [OPTODRIVE, "fingers", "--film", recording, "--calibration", calibration, "--repeat"]
        with start_process(arguments, env=environment) as command:
            for pixel in (120, 325):
                wait_for(lambda pixel=pixel: compute_lead_of_hand(board, pixel) >= LEAD, "more light under a finger")
            command.send_signal(signal.SIGINT)
            assert command.wait() == 130
        since = len(board.of("pulse"))
        wait_for(lambda: min(count_pulses(board, since)[pixel] for pixel in PAGE) >= 1, "the whole page")


def compute_lead_of_hand(board, pixel):
    """Return how many more pulses a dot has than any that is far from both fingers."""
    near = [
        other for other in PAGE if min(np.hypot(*np.subtract(PLACES[other], PLACES[f])) for f in (120, 325)) < 0.015
    ]
    return compute_lead(board, pixel, sorted(set(PAGE) - set(near)))


def test_a_recording_that_ends_says_so(rig, calibration, tmp_path):
    film = SimulatedFilm()
    film.touch(0.0, PLACES[120])
    done = run("fingers", "--film", film.write(tmp_path / "hand.evemu"), "--calibration", calibration, url=rig[1].url)
    assert re.fullmatch(r"\d+ reports of fingertips in \S+ s\n", done.stdout)
    assert int(done.stdout.split()[0]) > 40


REFUSALS = {
    "no source": ([], "FILE.csv or --film: missing, expected one source of fingertips"),
    "two sources": (["hand.csv", "--film", "x"], "FILE.csv or --film: got both"),
    "no film": (["--film", "/dev/input/event99", "--calibration", "film.toml"], "No such file or directory"),
    "another device": (["--film", "/dev/null", "--calibration", "film.toml"], "expected a multitouch film"),
    "no calibration": (["--film", "x"], "--calibration: missing, expected film.toml, an output of"),
    "lost calibration": (["--film", "hand.evemu", "--calibration", "none.toml"], "none.toml: got 'No such file"),
    "recorded twice": (["--film", "hand.evemu", "--calibration", "film.toml", "--record", "y"], "--record: got 'y'"),
    "no film to calibrate": (["hand.csv", "--calibration", "film.toml"], "--calibration: got 'film.toml'"),
    "device repeated": (["--film", "/dev/null", "--calibration", "film.toml", "--repeat"], "--repeat: got a device"),
}


@pytest.mark.parametrize("case", REFUSALS)
def test_wrong_options_get_one_line(case, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    film = SimulatedFilm()
    film.touch(0.0, PLACES[120])
    film.write(tmp_path / "hand.evemu")
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
