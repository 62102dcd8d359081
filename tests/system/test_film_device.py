"""A film at the Linux input layer: python-evdev's own reader on an emulated kernel."""

import re
import subprocess
import time
from contextlib import contextmanager

import numpy as np
import pytest

from emulated_film import FilmDevice
from forked_process import OPTODRIVE, run_process
from optodrive.tracking.contacts import decode_contacts
from optodrive.tracking.film import FilmRecording
from rig import TOKEN, running, wait_for
from test_standing_frames import LEAD, PLACES, compute_lead, send_page, show
from touch_film import SimulatedFilm

pytest.importorskip("evdev", reason="evdev is built from its source on this processor")
CORNERS = (0, 18, 417, 397)
PAGE = tuple(range(50, 400))


@pytest.fixture
def device(tmp_path):
    with FilmDevice(tmp_path) as device:
        yield device


@contextmanager
def start(device, *arguments, **environment):
    command = [OPTODRIVE, *map(str, arguments)]
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, env={**device.environment, **environment}, **options) as process:
        try:
            yield process
        except BaseException:
            process.kill()
            raise


def calibrate(device, folder):
    """Touch the corners when the command asks for them. Return its output."""
    arguments = ["calibrate", "film", device.path, "--out", folder / "film.toml", "--record", folder / "touches.evemu"]
    with start(device, *arguments) as command:
        for number, pixel in enumerate(CORNERS):
            assert command.stderr.readline().startswith(f"touch pixel {pixel},")
            if number == 0:
                wait_for(lambda: device.clock == time.CLOCK_MONOTONIC, "the reader")
            device.touch({number: PLACES[pixel]})
            # The lifting of the second finger is lost, but for the state that the kernel keeps.
            device.touch({}, after_s=0.3, is_dropped=number == 1)
        out, errors = command.communicate()
        assert command.returncode == 0, errors
    return out


def test_touches_at_a_device_calibrate_it_and_are_recorded(device, tmp_path):
    assert re.search(r"touches          4, 0\.0\d+ mm from their pixels", calibrate(device, tmp_path))
    recording = FilmRecording(tmp_path / "touches.evemu")
    assert recording.axes.name == "Emulated film"
    reports = list(decode_contacts(recording.events))
    numbers = [report.contacts[0].number for report in reports if report.contacts]
    assert list(dict.fromkeys(numbers)) == [65530, 65531, 65532, 65533]
    assert {len(report.contacts) for report in reports} == {0, 1}
    path, again = tmp_path / "touches.evemu", tmp_path / "again.toml"
    run_process([OPTODRIVE, "calibrate", "film", path, "--out", again], check=True, capture_output=True)
    first, second = ((tmp_path / name).read_text().split("x_m = ")[1] for name in ("film.toml", "again.toml"))
    values = [np.array(re.findall(r"-?\d\.\d+e[+-]\d+", text), dtype=float) for text in (first, second)]
    assert np.abs(values[0] - values[1]).max() < 2e-4


def test_a_finger_that_rests_since_before_the_begin_gets_light_and_unplugging_ends_the_command(device, tmp_path):
    calibrate(device, tmp_path)
    device.touch({"resting": PLACES[120]}, is_sent=False)  # only the kernel's state tells of it
    with running(tmp_path) as (board, daemon):
        daemon.arm()
        arguments = ["fingers", "--film", device.path, "--calibration", tmp_path / "film.toml"]
        with (
            show(daemon) as stream,
            start(device, *arguments, OPTODRIVE_TOKEN=TOKEN, OPTODRIVE_URL=daemon.url) as command,
        ):
            send_page(stream, PAGE)
            wait_for(lambda: compute_lead(board, 120, PAGE) >= LEAD, "more light under the finger")
            device.unplug()
            out, errors = command.communicate()
            assert (command.returncode, out) == (1, "")
            assert re.fullmatch(r"optodrive: /dev/pts/\d+: the film is gone: .+\n", errors)


def test_a_device_without_slots_is_refused_by_its_name(tmp_path):
    with FilmDevice(tmp_path, SimulatedFilm(), has_slots=False) as device:
        with start(device, "calibrate", "film", device.path, "--out", tmp_path / "film.toml") as command:
            _, errors = command.communicate()
        assert command.returncode == 2
        assert errors == (
            f"optodrive: {device.path}: got 'Emulated film', which has no slots, "
            "expected a multitouch film, as `python -m evdev.evtest` lists them\n"
        )
