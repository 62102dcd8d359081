"""The reader of a pixel's recordings, on a sensor with scripted answers."""

import numpy as np
import pytest

from optodrive.core.clock import ManualClock
from optodrive.core.errors import InputError, LinkError, RefusedError
from optodrive.lab.commissioning.sensor import LATE_MAX_S, SensorReader, SpotSensorClient


class Board:
    """Only time passes on it."""

    def __init__(self, clock):
        self.clock = clock

    def step(self):
        self.clock.sleep(0.002)

    def wait(self, duration_s):
        self.clock.sleep(duration_s)


class Wire:
    """A sensor that answers each request from a table, else by the request's word and none."""

    name = "a wire"

    def __init__(self, answers):
        self.answers, self.requests, self.pending = answers, [], b""

    def open(self):
        """Nothing is to be opened."""

    def write(self, data):
        request = data.decode().strip()
        self.requests.append(request)
        self.pending = (self.answers.get(request) or f"{request.split()[0]} none").encode() + b"\n"

    def read(self, timeout_s):
        data, self.pending = self.pending, b""
        return data


def build_reader(answers):
    clock = ManualClock(1.0)
    wire, board = Wire(answers), Board(clock)
    return SensorReader(board, SpotSensorClient(wire), clock), wire, clock


def test_it_reads_every_signal_line_by_line():
    names = "signals absorber_temperature_K displacement_m"
    lines = {"samples 0 0": "samples 293 294", "samples 0 2": "samples 295", "samples 1 0": "samples 0 1e-6 2e-6"}
    reader, wire, _ = build_reader({"signals": names, "record 7 3 500": "record 3", **lines})
    reader.open(records_pixels=True)
    reader.begin_recording(7, 3, 500)
    values = reader.read_recording(3)
    assert values["absorber_temperature_K"] == pytest.approx(np.array([293.0, 294.0, 295.0]))
    assert values["displacement_m"] == pytest.approx(np.array([0.0, 1e-6, 2e-6]))
    assert wire.requests[-4:] == ["record 7 3 500", "samples 0 0", "samples 0 2", "samples 1 0"]


def test_a_sensor_of_spots_is_refused_by_name():
    reader, _, _ = build_reader({})
    with pytest.raises(InputError, match=r"sensor.port: got 'a wire', expected a sensor that records signals"):
        reader.open(records_pixels=True)


def test_no_light_too_many_samples_and_a_refusal_end_it():
    names = {"signals": "signals force_N", "record 0 2 1": "record 2"}
    reader, _, clock = build_reader(names)
    reader.open(records_pixels=True)
    reader.begin_recording(0, 2, 1)
    began_s = clock.now_s()
    with pytest.raises(RefusedError, match="recorded no light"):
        reader.read_recording(2)
    assert clock.now_s() - began_s == pytest.approx(LATE_MAX_S, abs=0.2)
    reader, _, _ = build_reader(names | {"samples 0 0": "samples 1 2 3"})
    reader.open(records_pixels=True)
    with pytest.raises(LinkError, match="3 samples, expected 2"):
        reader.read_recording(2)
    with pytest.raises(LinkError, match="expected 'record 5'"):
        reader.begin_recording(0, 5, 1)
