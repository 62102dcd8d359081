"""Facts about the DAC, checked on the emulated one through pyusb, without this package's driver."""

import struct

import pytest
import usb.core
import usb.util

from dac.emulated_helios import BYTES_PER_S, CLOCK_HZ, EmulatedHelios
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


def test_descriptors_and_endpoints():
    raw = Raw(enable=False)
    interface = usb.util.find_descriptor(raw.usb[0], bInterfaceNumber=0, bAlternateSetting=1)
    assert {(e.bEndpointAddress, e.bmAttributes, e.wMaxPacketSize) for e in interface} == {
        (0x83, 3, 32), (0x06, 3, 32), (0x02, 2, 64),
    }  # fmt: skip
    assert raw.usb.speed == usb.util.SPEED_FULL
    with pytest.raises(ValueError, match="Invalid endpoint"):  # alternate setting 0 has none
        raw.say(3, 0)


def test_questions_and_their_answers():
    raw = Raw()
    assert raw.ask(3, 0) == b"\x83\x01"
    assert raw.ask(4, 0) == b"\x84" + (6).to_bytes(4, "little")
    assert raw.ask(5, 0)[:8] == b"\x85Helios "
    raw.say(7, 11)
    assert raw.board.host_version == 11
    raw.say(6, *b"mine\0")
    assert raw.ask(5, 0)[:6] == b"\x85mine\0"
    raw.say(2, 1)
    assert raw.board.shutter
    raw.say(2, 0)
    assert not raw.board.shutter
    assert not raw.board.erased
    raw.say(0xDE, 0)
    assert raw.board.erased


def test_an_answer_nobody_reads_keeps_the_next_from_coming():
    raw = Raw()
    raw.say(3, 0)
    assert raw.ask(4, 0) == b"\x83\x01"


@pytest.mark.parametrize("rate", [7, 20_000, 33_333, 40_000, 65_535])
def test_the_rate_is_rounded_to_the_clock(rate):
    raw = Raw()
    raw.frame([*emission(3), (100, 200, 0)], rate)
    raw.wait(1.0)
    (stretch,) = raw.board.light()
    assert stretch[1] - stretch[0] == pytest.approx(3 * (112_000_000 // rate + 1) / CLOCK_HZ, abs=1e-9)


@pytest.mark.parametrize(("rate", "taken"), [(0, 7), (6, 7)])
def test_a_rate_out_of_range_is_clamped(rate, taken):
    raw = Raw()
    raw.frame(emission(2), rate)
    assert raw.board.ticks == 112_000_000 // taken + 1


def test_points_are_codes_of_twelve_bits_and_channels_of_eight():
    raw = Raw()
    raw.frame([(4095, 0, 255), (0, 4095, 1), (2748, 291, 0)])
    raw.wait(1.0)
    assert [stretch[2:] for stretch in raw.board.light()] == [(4095, 0, 255), (0, 4095, 1)]
    assert raw.board.position == (2748, 291)


def test_played_once_it_ends_dark_and_stays_where_it_was():
    raw = Raw()
    raw.frame(emission(50))
    raw.wait(1.0)
    ((begin, end, *_),) = raw.board.light()
    assert end - begin == pytest.approx(50 * 11_201 / CLOCK_HZ)
    assert raw.board.position == (100, 200)
    assert not raw.board.playing


def test_without_play_once_the_last_frame_repeats_for_ever():
    raw = Raw()
    raw.frame(emission(50), rate=1000, flags=0)
    raw.wait(60.0)
    assert raw.board.colour == (9, 9, 9, 9)


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


def test_start_at_once_cuts_what_plays():
    raw = Raw()
    raw.frame(emission(500))
    raw.wait(0.01)
    raw.frame(emission(5, level=7), flags=3)
    raw.wait(1.0)
    first, second = raw.board.light()
    assert first[1] - first[0] < 0.02
    assert second[4] == 7


def test_a_full_frame_takes_as_long_as_full_speed_allows():
    raw = Raw()
    began_s = raw.clock.now_s()
    raw.frame(emission(4094))
    assert raw.clock.now_s() - began_s == pytest.approx((4094 * 7 + 5) / BYTES_PER_S)
    full_s = (4095 * 7 + 5) / BYTES_PER_S
    assert full_s == pytest.approx(23.6e-3, rel=2e-3)


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


def test_an_alternate_setting_without_endpoints_stops_it():
    raw = Raw()
    raw.frame(emission(500))
    raw.wait(0.01)
    raw.usb.set_interface_altsetting(0, 0)
    assert not any(raw.board.colour)


def test_unplugged_it_has_no_power():
    raw = Raw()
    raw.say(2, 1)
    raw.frame(emission(500))
    raw.emulated.unplugged_at_s = raw.clock.now_s() + 0.01
    with pytest.raises(usb.core.USBError, match="No such device"):
        raw.frame(emission(4000), timeout=100)
    assert not any(raw.board.colour)
    assert not raw.board.shutter
    assert raw.board.dark_from_s() == pytest.approx(raw.emulated.unplugged_at_s)


def test_faults_on_order():
    raw = Raw()
    raw.emulated.busy = 1
    assert raw.ask(3, 0) == b"\x83\x00"
    raw.emulated.garbage.append(b"\x99")
    assert raw.ask(3, 0) == b"\x99"
    raw.emulated.deaf = 1
    with pytest.raises(usb.core.USBTimeoutError):
        raw.ask(3, 0)
