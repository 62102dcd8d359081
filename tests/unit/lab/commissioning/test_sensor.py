"""The client of the spot sensor."""

import pytest

from optodrive.core.errors import LinkError
from optodrive.lab.commissioning.sensor import SHOWN_MAX, SpotSensorClient


class Wire:
    """A transport with scripted input in pieces."""

    name = "a wire"

    def __init__(self, *pieces):
        self.pieces, self.written = list(pieces), b""

    def read(self, timeout_s):
        return self.pieces.pop(0) if self.pieces else b""

    def write(self, data):
        self.written += data


def test_a_line_comes_in_pieces_and_what_lay_there_is_dropped():
    wire = Wire(b"spot 1 2 3\nspo", b"", b"spot 4", b" 5 6\n")
    sensor = SpotSensorClient(wire)
    sensor.send_request("spot")
    assert wire.written == b"spot\n"
    assert sensor.poll_answer() is None
    assert sensor.poll_answer() is None
    line = sensor.poll_answer()
    assert line == "spot 4 5 6"
    assert sensor.parse_spot(line) == pytest.approx((4e-6, 5e-6, 6e-6))


def test_none_is_an_answer():
    sensor = SpotSensorClient(Wire())
    assert sensor.parse_spot("spot none") is None
    assert sensor.parse_mirrors_rad("mirrors none") is None
    assert sensor.parse_mirrors_rad("mirrors -0.1 0.2") == (-0.1, 0.2)


@pytest.mark.parametrize(
    "line", ["", "spot", "spot 1 2", "spot 1 2 x", "spot 1 nan 3", "mirrors 1 2", "error no", "\ufffd"]
)
def test_what_is_no_answer_is_named(line):
    with pytest.raises(LinkError, match=r"a wire: received .*expected 'spot' and 3 numbers"):
        SpotSensorClient(Wire()).parse_spot(line)


def test_a_flood_without_a_line_ends():
    sensor = SpotSensorClient(Wire(b"", *[b"x" * 800] * 3))
    sensor.send_request("spot")
    assert sensor.poll_answer() is None
    with pytest.raises(LinkError, match="expected a line") as caught:
        sensor.poll_answer()
    assert len(str(caught.value)) < 2 * SHOWN_MAX + 100


def test_signals_of_a_pixel_and_their_samples():
    sensor = SpotSensorClient(Wire())
    assert sensor.parse_signals("signals displacement_m force_N") == ("displacement_m", "force_N")
    assert sensor.parse_signals("signals none") == ()
    assert sensor.parse_signals("error unknown request") == ()  # a sensor of spots, older than this request
    assert sensor.parse_samples("samples none") is None
    assert sensor.parse_samples("samples 1e-06 -2") == [1e-6, -2.0]
    sensor.parse_granted("record 400", 400)


@pytest.mark.parametrize("line", ["", "signals height", "signals mirror_x_rad", "spot none"])
def test_signals_that_no_pixel_has_are_named(line):
    with pytest.raises(LinkError, match=r"expected 'signals' and some of absorber_temperature_K, displacement_m"):
        SpotSensorClient(Wire()).parse_signals(line)


@pytest.mark.parametrize("line", ["samples", "samples 1 nan", "spot 1 2", "error out of range"])
def test_samples_that_are_no_numbers_are_named(line):
    with pytest.raises(LinkError, match=r"expected 'samples' and \d+ numbers"):
        SpotSensorClient(Wire()).parse_samples(line)
