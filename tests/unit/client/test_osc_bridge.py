"""OSC packets as the specification prints them, the heights they set, the port's senders, and the bridge's rates."""

import json
import socket
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from optodrive.client.osc import OscBridge, OscHeights, Place, UdpPort, parse_place, parse_sender
from optodrive.client.osc_packets import OscMessage, build_message, parse_packet
from optodrive.client.stream import ResultBuffer
from optodrive.core.errors import InputError

OSCILLATOR = bytes.fromhex("2f6f7363696c6c61746f722f342f6672657175656e6379002c66000043dc0000")
FOO = bytes.fromhex("2f666f6f000000002c69697366660000000003e8ffffffff68656c6c6f0000003f9df3b640b5b22d")
"""The two examples of the OSC 1.0 specification."""


def text(value):
    return value.encode() + bytes(4 - len(value) % 4)


def bundle(*packets):
    return b"#bundle\0" + struct.pack(">Q", 1) + b"".join(struct.pack(">i", len(each)) + each for each in packets)


def test_the_examples_of_the_specification_are_read():
    assert parse_packet(OSCILLATOR) == [OscMessage("/oscillator/4/frequency", (440.0,))]
    (foo,) = parse_packet(FOO)
    assert foo.address == "/foo"
    assert foo.arguments[:3] == (1000, -1, "hello")
    assert foo.arguments[3:] == pytest.approx((1.234, 5.678))


def test_every_tag_is_read_and_bundles_nest():
    values = struct.pack(">qd", 2**40, 0.25) + struct.pack(">i", 5) + b"abcde\0\0\0"
    all_tags = text("/a") + text(",hdbTFN") + values
    assert parse_packet(all_tags) == [OscMessage("/a", (2**40, 0.25, b"abcde", 1.0, 0.0, None))]
    without = parse_packet(text("/b"))
    nested = parse_packet(bundle(OSCILLATOR, bundle(text("/b"), FOO)))
    assert without == [OscMessage("/b", ())]
    assert [each.address for each in nested] == ["/oscillator/4/frequency", "/b", "/foo"]
    assert parse_packet(bundle()) == []


@given(st.integers(-(2**31), 2**31 - 1), st.floats(width=32, allow_nan=False), st.text("abc/", max_size=9))
def test_a_message_that_is_built_is_read(number, value, name):
    assert parse_packet(build_message("/" + name, number, value)) == [OscMessage("/" + name, (number, value))]


def nest(depth):
    packet = OSCILLATOR
    for _ in range(depth):
        packet = bundle(packet)
    return packet


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"pixel\0\0\0",
        b"/pixel",
        text("/p") + b"if\0\0",
        text("/p") + text(",i"),
        text("/p") + text(",x") + bytes(4),
        text("/p") + text(",b") + struct.pack(">i", 99),
        text("/p") + text(",b") + struct.pack(">i", -1),
        bundle(OSCILLATOR)[:-4],
        bundle(OSCILLATOR) + struct.pack(">i", 0),
        b"#bundle\0" + bytes(8) + b"\1",
        nest(9),
        "/é".encode() + bytes(4),
    ],
)
def test_a_damaged_packet_is_refused_in_a_line(data):
    with pytest.raises(InputError) as refused:
        parse_packet(data)
    assert refused.value.code == "bad_osc"
    assert "\n" not in str(refused.value)


@given(st.one_of(st.binary(max_size=60), st.binary(max_size=40).map(lambda end: bundle(OSCILLATOR) + end)))
def test_no_bytes_raise_anything_else(data):
    try:
        parse_packet(data)
    except InputError:
        return


def set_heights(*messages, scale_um=1.0):
    heights = OscHeights(5, scale_um)
    for address, *arguments in messages:
        heights.apply(OscMessage(address, tuple(arguments)))
    return heights.heights_um.tolist()


def test_messages_set_heights_that_stay():
    assert set_heights(("/pixel", 1, 50.0, 3, 20), ("/pixel/4", 7.5)) == [0, 50, 0, 20, 7.5]
    assert set_heights(("/heights", 1, 2, 3, 4, 5.5), ("/pixel/0", 0)) == [0, 2, 3, 4, 5.5]
    assert set_heights(("/heights", 1, 2, 3, 4, 5.5), ("/clear",)) == [0] * 5
    assert set_heights(("/pixel/2", 0.5), scale_um=200.0) == [0, 0, 100, 0, 0]


@pytest.mark.parametrize(
    ("message", "says"),
    [
        (("/pixel", 5, 10.0), "/pixel: got 5, expected a pixel as an integer, 0…4"),
        (("/pixel", 1.0, 10.0), "/pixel: got 1.0, expected a pixel as an integer"),
        (("/pixel", 1, 10.0, 2), "/pixel: got 3 arguments, expected pixel and height"),
        (("/pixel", 1, -1.0), "/pixel: got -1.0, expected a height in µm, 0 to 1000"),
        (("/pixel", 1, float("nan")), "got nan, expected a height in µm"),
        (("/pixel", 1, 1e9), "expected a height in µm, 0 to 1000"),
        (("/pixel", 1, "high"), "got 'high', expected a height in µm"),
        (("/pixel/x", 1.0), "got 'x', expected a pixel"),
        (("/pixel/1",), "/pixel/1: got 0 arguments, expected one height"),
        (("/heights", 1.0, 2.0), "/heights: got 2 heights, expected one for each of 5 pixels"),
        (("/hights", 1.0), "OSC address: got '/hights', expected a known one, nearest is '/heights'"),
    ],
)
def test_a_wrong_message_is_refused_and_changes_nothing(message, says):
    heights = OscHeights(5, 1.0)
    heights.apply(OscMessage("/heights", (1, 2, 3, 4, 5)))
    with pytest.raises(InputError) as refused:
        heights.apply(OscMessage(message[0], message[1:]))
    assert says in str(refused.value)
    assert heights.heights_um.tolist() == [1, 2, 3, 4, 5]


def test_a_port_is_of_this_computer_or_names_its_senders():
    with pytest.raises(InputError, match=r"--listen: got '0.0.0.0:0', expected --from with the addresses"):
        UdpPort(Place("0.0.0.0", 0), [])
    port = UdpPort(Place("127.0.0.1", 0), [])
    try:
        with pytest.raises(InputError, match="a free port of this computer"):
            UdpPort(port.place, [])
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as source:
            for packet in (b"one", b"two"):
                source.sendto(packet, port.place)
            assert port.receive(5.0) == [b"one", b"two"]
        assert port.receive(0.0) == []
    finally:
        port.close()


def test_packets_of_others_are_refused():
    port = UdpPort(Place("127.0.0.1", 0), ["192.0.2.7"])
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as source:
            source.sendto(b"one", port.place)
            assert port.receive(5.0) == []
        assert port.refused == 1
    finally:
        port.close()


@pytest.mark.parametrize("wrong", ["9000", "localhost:9000", "127.0.0.1", "127.0.0.1:99999", "127.0.0.1:x", ":9000"])
def test_a_place_is_an_address_and_a_port(wrong):
    assert parse_place("127.0.0.1:9000", "--listen") == ("127.0.0.1", 9000)
    assert parse_place("[::1]:9000", "--listen") == ("::1", 9000)
    with pytest.raises(InputError, match="an address and a port such as"):
        parse_place(wrong, "--listen")


def test_a_sender_is_an_address():
    assert parse_sender("192.0.2.7") == "192.0.2.7"
    with pytest.raises(InputError, match="--from: got 'lab', expected an address such as"):
        parse_sender("lab")


class LateDisplay:
    """A display in virtual time that takes a frame as long as it draws one, and then the newest: its stream and port.

    The answers are messages of the daemon, read by the client's own buffer.
    """

    def __init__(self, beam_s):
        self.now_s, self._beam_s = 0.0, beam_s
        self._free_s, self._waiting, self._number = 0.0, None, 0
        self._buffer, self.drawn, self.packets, self.replies = ResultBuffer(), [], [], []

    @property
    def counts(self):
        return self._buffer.counts

    def send(self, heights_um):
        number, self._number = self._number, self._number + 1
        if self._waiting is not None:
            self._answer(self._waiting[0], status="superseded", superseded_by=number)
        self._waiting = number, float(heights_um[0])
        self.draw()
        return number

    def draw(self):
        if self._waiting is not None and self.now_s >= self._free_s:
            self._free_s = self.now_s + self._beam_s
            self.drawn.append((self.now_s, self._waiting[1]))
            self._answer(self._waiting[0], status="done", planned=1, executed=1)
            self._waiting = None

    def _answer(self, number, **members):
        self._buffer.add(json.dumps({"frame": number, **members}))

    def results(self):
        return self._buffer.drain()

    def receive(self, wait_s):
        packets, self.packets = self.packets, []
        return packets

    def send_packet(self, data, place):
        self.replies.append(parse_packet(data)[0])


class ReplyPort:
    def __init__(self, display):
        self.receive, self.send = display.receive, display.send_packet


REPLY = Place("127.0.0.1", 1)


def bridge(display, reply=REPLY, **options):
    lines = []
    heights = OscHeights(3, 1.0)
    made = OscBridge(
        ReplyPort(display),
        display,
        heights,
        lambda: lines.append("stopped"),
        lines.append,
        reply=reply,
        now_s=lambda: display.now_s,
        **options,
    )
    return made, lines


def stream(display, made, rate_hz, seconds, begin=0):
    """Let a source send /pixel/0 with a sawtooth at a rate, in virtual time."""
    start_s = display.now_s
    for number in range(round(rate_hz * seconds)):
        display.now_s = start_s + number / rate_hz
        display.draw()
        display.packets.append(build_message("/pixel/0", float((begin + number) % 1000)))
        made.step()


@pytest.mark.parametrize(
    ("beam_s", "seconds"), [(0.004, 20), (0.03, 20), pytest.param(0.03, 3600, marks=pytest.mark.slow)]
)
def test_at_90_hz_the_newest_frame_is_drawn_and_the_rate_shown_is_reported(beam_s, seconds):
    display = LateDisplay(beam_s)
    made, lines = bridge(display)
    stream(display, made, 90.0, seconds)
    drawn = np.array(display.drawn)
    ages = np.round(drawn[:, 0] * 90.0) - drawn[:, 1]  # frames between the newest and the one that is drawn
    assert set(np.unique(ages % 1000)) <= {0.0, 1.0}
    expected_hz = min(90.0, 1 / (np.ceil(beam_s * 90.0 - 1e-9) / 90.0))
    shown = np.array([each.arguments for each in display.replies])
    assert len(shown) == pytest.approx(seconds, abs=1 + seconds / 90)
    assert shown[:, 0] == pytest.approx(90.0, abs=1.0)
    assert shown[:, 1] == pytest.approx(expected_hz, abs=1.5)
    assert display.counts.shown == len(drawn) == pytest.approx(expected_hz * seconds, rel=0.01)
    assert display.counts.shown + display.counts.superseded + (display._waiting is not None) == 90 * seconds
    assert lines == []


def test_packets_that_wait_become_one_frame_of_the_newest_heights():
    display = LateDisplay(0.0)
    made, _ = bridge(display)
    display.packets = [build_message("/pixel/0", value) for value in (1.0, 2.0, 9.0)]
    made.step()
    assert display.drawn == [(0.0, 9.0)]


def test_heights_that_stand_are_cleared_when_the_source_is_silent():
    for stands in (True, False):
        display = LateDisplay(0.0)
        made, lines = bridge(display, stands=stands)
        stream(display, made, 10.0, 1.0, begin=1)
        for _ in range(40):
            display.now_s += 0.1
            made.step()
        assert (display.drawn[-1][1] == 0.0) == stands
        assert lines == ["no packet for 2 s: all heights are cleared"] * stands


def test_mistakes_are_told_once_and_stop_stops():
    display = LateDisplay(0.0)
    made, lines = bridge(display, reply=None)
    for _ in range(3):
        display.packets = [b"garbage\0"]
        made.step()
    display.packets = [build_message("/pixel/0", 5.0), build_message("/stop")]
    made.step()
    assert len(lines) == 3
    assert lines[1:] == ["stop: the board is disarmed", "stopped"]
    assert display.drawn[-1][1] == 0.0
    display.now_s = 10.0
    made.step()
    assert lines[-1].startswith("0.4 frames/s sent, 0.4 shown; in all 4 sent, 4 shown, 0 superseded, 0 refused")
