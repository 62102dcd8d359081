"""The light of fingers in the telemetry, against a judge that knows the true fingers and reads the board's log."""

import json
import threading
import time

import numpy as np
import pytest

from finger_judge import measure_light, read_pulses, read_zero_s
from optodrive.daemon.engine.telemetry_events import WINDOW_S
from optodrive.device.config_file import load_config
from optodrive.planning.display_model import DisplayModel
from rig import running, wait_for
from test_standing_frames import send_page, show, socket
from test_telemetry import Reader

PERIOD_S, AGE_S, RADIUS_M = 0.01, 0.02, 0.004
EVENTS = 100
PAGE = tuple(range(0, 437, 2))


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    with running(tmp_path_factory.mktemp("light")) as rig:
        yield rig


@pytest.fixture(scope="module")
def display():
    return DisplayModel.from_config(load_config())


class Tracker:
    """Reports fingers, whose places are functions of the host's time, in a thread until the end."""

    def __init__(self, daemon, fingers):
        self._daemon, self._fingers = daemon, fingers
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._report)

    def _report(self):
        with socket(self._daemon, "/v1/fingers") as link:
            while not self._ended.wait(PERIOD_S):
                seen_s = time.monotonic() - AGE_S
                places = [(number, *find_place(seen_s)) for number, find_place in self._fingers.items()]
                members = [{"number": n, "x_m": x_m, "y_m": y_m, "radius_m": RADIUS_M} for n, x_m, y_m in places]
                link.send(json.dumps({"fingers": members, "age_s": time.monotonic() - seen_s}))

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *details):
        self._ended.set()
        self._thread.join()


def rest(at_s):
    return 0.012, -0.008


def read_along(at_s):
    """A finger that reads line after line at 3 cm/s, to and fro."""
    phase = (0.03 * at_s / 0.04) % 2.0
    return 0.04 * min(phase, 2.0 - phase) - 0.02, 0.01


FINGERS = {1: rest, 2: read_along}


def find_light(event, number):
    return next((finger for finger in event["fingers"] if finger["number"] == number and finger["dots"]), None)


def list_judged(reader):
    """Return the events in which both fingers have dots."""
    return [event for event in reader.of("fingers") if all(find_light(event, number) for number in FINGERS)]


@pytest.mark.slow  # the windows of telemetry and judge end at times that a stall of the computer moves apart
def test_the_light_in_the_telemetry_is_that_of_the_board_s_log(rig, display):
    board, daemon = rig
    daemon.arm()
    reader = Reader(daemon)
    with show(daemon) as stream, Tracker(daemon, FINGERS):
        send_page(stream, PAGE)
        wait_for(lambda: len(list_judged(reader)) > 2 * EVENTS, "the light of both fingers")
    wait_for(lambda: reader.last("page")["height"] == "", "the end of the page")
    reader.close()
    pulses, zero_s = read_pulses(board, display), read_zero_s(board)
    target_m = np.zeros(len(display.layout))
    target_m[list(PAGE)] = 50e-6
    for number, find_place in FINGERS.items():
        pairs = []
        for event in list_judged(reader)[-EVENTS:]:
            end_s = zero_s + event["board_s"]
            place = find_place(end_s)
            true = measure_light(pulses, display, target_m, place, end_s, WINDOW_S, RADIUS_M)
            light = find_light(event, number)
            if true is not None:
                pairs.append((true.rate_hz, light["rate_hz"], true.height_share, light["height_share"]))
        true_hz, rate_hz, true_share, share = np.mean(pairs, axis=0)
        assert rate_hz == pytest.approx(true_hz, rel=0.1)
        assert share == pytest.approx(true_share, abs=0.05)
