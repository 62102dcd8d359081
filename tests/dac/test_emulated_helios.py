"""Facts about the DAC, checked on the emulated one through pyusb, without this package's driver."""

import struct

import pytest
import usb.core
import usb.util

from dac.emulated_helios import EmulatedHelios
from optodrive.core.clock import ManualClock


class Raw:
    """pyusb device, claimed and enabled, with commands by number."""

    def __init__(self, enable=True):
        self.clock = ManualClock()
        self.emulated = EmulatedHelios(self.clock)
        self.board = self.emulated.device
        self.usb = usb.core.find(idVendor=0x1209, idProduct=0xE500, backend=self.emulated)
        if enable:
            usb.util.claim_interface(self.usb, 0)
            self.usb.set_interface_altsetting(0, 1)

    def say(self, *command):
        self.usb.write(0x06, bytes(command), 32)

    def ask(self, *command):
        self.say(*command)
        return bytes(self.usb.read(0x83, 32, 32))

    def frame(self, points, rate=10_000, flags=2, timeout=100):
        body = b"".join(
            bytes([x >> 4, (x & 15) << 4 | y >> 8, y & 255, level, level, level, level]) for x, y, level in points
        )
        self.usb.write(0x02, body + struct.pack("<HHB", rate, len(points), flags), timeout)

    def wait(self, duration_s):
        self.emulated.pass_time(duration_s)


def emission(count, x=100, y=200, level=9):
    return [(x, y, level)] * count


def test_an_answer_nobody_reads_keeps_the_next_from_coming():
    raw = Raw()
    raw.say(3, 0)
    assert raw.ask(4, 0) == b"\x83\x01"


def test_two_buffers_and_no_more():
    raw = Raw()
    raw.frame(emission(500))
    assert raw.ask(3, 0) == b"\x83\x01"  # one plays, the next may come
    raw.frame(emission(500, level=8))
    assert raw.ask(3, 0) == b"\x83\x00"  # one waits
    began_s = raw.clock.now_s()
    with pytest.raises(usb.core.USBTimeoutError):
        raw.frame(emission(500, level=7), timeout=5)
    assert raw.clock.now_s() == pytest.approx(began_s + 0.005)
    raw.wait(0.05)
    assert raw.ask(3, 0) == b"\x83\x01"
    raw.wait(0.1)
    assert [stretch[4] for stretch in raw.board.light()] == [9, 8]
    first, second = raw.board.light()
    assert second[0] == pytest.approx(first[1])  # without a gap


@pytest.mark.parametrize("count", [45, 109, 45 + 64 * 30])
def test_a_whole_number_of_packets_stalls(count):
    raw = Raw()
    assert (7 * count + 5) % 64 == 0
    raw.frame(emission(count))
    raw.wait(1.0)
    assert not raw.board.light()
    raw.frame(emission(10))  # ends the transfer, which now fits no frame
    raw.wait(1.0)
    assert not raw.board.light()
    assert raw.ask(3, 0) == b"\x83\x01"  # polling takes bulk transfers up again
    raw.frame(emission(10))
    raw.wait(1.0)
    assert len(raw.board.light()) == 1


def test_a_frame_that_contradicts_itself_is_dropped_until_the_next_poll():
    raw = Raw()
    raw.usb.write(0x02, bytes(70) + struct.pack("<HHB", 1000, 11, 2), 100)
    with pytest.raises(usb.core.USBTimeoutError):
        raw.frame(emission(10))
    raw.ask(3, 0)
    raw.frame(emission(10))
    raw.wait(1.0)
    assert len(raw.board.light()) == 1


def test_stop_blanks_at_once_drops_frames_for_a_while_and_leaves_the_shutter():
    raw = Raw()
    raw.say(2, 1)
    raw.frame(emission(500))
    raw.wait(0.01)
    assert any(raw.board.colour)
    raw.say(1, 0)
    assert not any(raw.board.colour)
    stopped_s = raw.clock.now_s()
    assert raw.board.shutter
    raw.frame(emission(500))
    raw.wait(0.05)
    assert not any(raw.board.colour)
    raw.wait(0.1 - (raw.clock.now_s() - stopped_s) + 1e-4)
    assert raw.board.position == (0x800, 0x800)
    raw.frame(emission(500))
    raw.wait(0.01)
    assert any(raw.board.colour)
