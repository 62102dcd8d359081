"""Emulated Helios DAC as a pyusb backend, in virtual time, for the real pyusb and the real driver.

It is written from the published firmware, independently of the driver, and parses frames with its own code.
"""

import errno
from collections import deque
from dataclasses import dataclass
from types import SimpleNamespace

import usb.backend
import usb.core

CLOCK_HZ = 112_000_000
BYTES_PER_S = 64 * 19 * 1000
"""Full-speed bulk transfers: at most 19 packets of 64 bytes per 1 ms frame."""
COMMAND_S = 1e-3
"""Interrupt endpoints are served once per 1 ms frame."""
STOP_WINDOW = CLOCK_HZ // 10
FRAME_BYTES_MAX = 4096 * 7 + 5
INT_OUT, INT_IN, BULK_OUT = 0x06, 0x83, 0x02
CENTRE = (0x800, 0x800)


class HostDeadError(BaseException):
    """The host was killed. None of its actions reach the DAC."""


@dataclass(frozen=True)
class Output:
    """State of the outputs from at_s on: codes, channels, shutter and power."""

    at_s: float
    x: int
    y: int
    colour: tuple[int, int, int, int]
    shutter: bool
    powered: bool


class Device:
    """The DAC without USB. It receives data by method calls. Time is in ticks of its clock."""

    def __init__(self, name="Helios 1163021877", version=6):
        self.name, self.version = name, version
        self.now = 0
        self.connected = self.playing = self.erased = False
        self.powered = True
        self.shutter = False
        self.host_version = 4
        self.frame, self.at, self.repeat = b"", 0, False
        self.queued = None
        self.ticks, self.due = 5601, None
        self.stop_until = None
        self.armed = False
        self.partial = b""
        self.answer = None
        self.position, self.colour = CENTRE, (0, 0, 0, 0)
        self.log, self._shown = [], None
        self.frames_played = 0
        self.starved = 0
        self._note()

    def _note(self):
        shown = *self.position, self.colour, self.shutter, self.powered
        if shown != self._shown:
            self._shown = shown
            self.log.append(Output(self.now / CLOCK_HZ, *shown))

    # --- time ---

    def advance(self, now):
        while True:
            due = min((at for at in (self.due, self.stop_until) if at is not None), default=None)
            if due is None or due > now:
                break
            self.now = max(self.now, due)
            if due == self.stop_until:
                self._stop_over()
            else:
                self._point()
        self.now = max(self.now, now)

    def next_due(self):
        return min((at for at in (self.due, self.stop_until) if at is not None), default=None)

    def _point(self):
        self.due += self.ticks
        if self.at >= len(self.frame):
            if self.queued is not None:
                self.frame, self.repeat, rate = self.queued
                self.queued, self.at = None, 0
                self.frames_played += 1
                self._speed(rate)
                self.armed = True
            elif self.repeat:
                self.at = 0
            else:
                self.starved += 1
                self._blank()
                return
        p = self.frame[self.at : self.at + 7]
        self.position = (p[0] << 4 | p[1] >> 4, (p[1] & 15) << 8 | p[2])
        self.colour = tuple(p[3:7])
        self.at += 7
        self._note()

    def _speed(self, rate):
        self.ticks = CLOCK_HZ // max(7, min(65_535, rate)) + 1
        self.due = self.now + self.ticks

    def _blank(self):
        self.playing, self.due, self.at = False, None, 0
        self.queued = None
        self.armed = True
        self.colour = (0, 0, 0, 0)
        self._note()

    def _stop(self):
        self._blank()
        self.stop_until = self.now + STOP_WINDOW

    def _stop_over(self):
        self.stop_until = None
        self._blank()
        self.position = CENTRE
        self._note()

    # --- USB ---

    def enable(self, connected):
        self.partial = b""
        if connected:
            self.connected = True
            self._blank()
        else:
            self.connected = False
            self._stop()

    def unplug(self):
        """Cut the bus power, which ends all emission."""
        self.powered = self.connected = self.playing = self.shutter = False
        self.due = self.stop_until = None
        self.colour = (0, 0, 0, 0)
        self._note()

    def command(self, data):
        code, value = data[0], data[1] if len(data) > 1 else 0
        if code == 0x01:
            self._stop()
        elif code == 0x02:
            self.shutter = value != 0
            self._note()
        elif code == 0x03:
            if self.queued is None:
                self.armed = True
            self._answer(bytes([0x83, self.queued is None]))
        elif code == 0x04:
            self._answer(b"\x84" + self.version.to_bytes(4, "little"))
        elif code == 0x05:
            self._answer((b"\x85" + self.name.encode()).ljust(32, b"\0"))
        elif code == 0x06:
            self.name = data[1:].split(b"\0")[0].decode()
        elif code == 0x07:
            self.host_version = value
        elif code == 0xDE:
            self.erased = True
            self._blank()

    def _answer(self, data):
        if self.answer is None:  # during a pending transfer a new answer is lost
            self.answer = data

    def packet(self, data):
        """Receive one packet of a bulk transfer. A short packet or a full buffer ends the transfer."""
        self.partial += data
        if len(data) == 64 and len(self.partial) < FRAME_BYTES_MAX:
            return
        transfer, self.partial = self.partial, b""
        self.armed = False
        if self.stop_until is not None or len(transfer) < 5 or len(transfer) > FRAME_BYTES_MAX:
            return
        rate, count, flags = int.from_bytes(transfer[-5:-3], "little"), transfer[-3] | transfer[-2] << 8, transfer[-1]
        if count * 7 != len(transfer) - 5:
            return
        frame, repeat = transfer[:-5], not flags & 2
        if not self.playing:
            self.frame, self.repeat, self.at = frame, repeat, 0
            self.playing = True
            self.queued = None
            self.frames_played += 1
            self._speed(rate)
            self.armed = True
        else:
            self.queued = frame, repeat, rate

    # --- emission ---

    def light(self):
        """Return (from_s, to_s, x, y, level) of each emission, regardless of the shutter. The last may end now."""
        stretches = []
        for output, after in zip(self.log, [*self.log[1:], None], strict=True):
            if any(output.colour):
                until_s = after.at_s if after else self.now / CLOCK_HZ
                stretches.append((output.at_s, until_s, output.x, output.y, max(output.colour)))
        return stretches

    def dark_from_s(self):
        """Return the end of the last emission, 0 without any."""
        return max((until_s for _, until_s, *_ in self.light()), default=0.0)


class EmulatedHelios(usb.backend.IBackend):
    """pyusb backend with an emulated DAC. clock: a ManualClock that transfers advance.

    Attributes inject faults:
    deaf, busy: number of answers to lose, and of "not ready" answers
    garbage: answers to return instead
    refused: number of commands to refuse
    dies_at_s, unplugged_at_s: time at which the host is killed, and at which the cable is unplugged
    """

    def __init__(self, clock, others=(), **device):
        self.clock = clock
        self.device = Device(**device)
        self.others = others
        self.deaf = self.busy = 0
        self.refused = 0
        self.garbage = deque()
        self.dies_at_s = self.unplugged_at_s = float("inf")
        self.claimed = False
        self.alternate = 0
        self.commands = []
        self.transfers = []
        self.open_errno = None

    # --- time and faults ---

    def _now(self):
        """Advance the DAC to the clock. Raise the injected failure of host or cable."""
        now_s = self.clock.now_s()
        if now_s >= self.unplugged_at_s and self.device.powered:
            self.device.advance(round(self.unplugged_at_s * CLOCK_HZ))
            self.device.unplug()
        self.device.advance(round(now_s * CLOCK_HZ))
        if now_s >= self.dies_at_s:
            raise HostDeadError
        if not self.device.powered:
            raise usb.core.USBError("No such device (it may have been disconnected)", errno=errno.ENODEV)

    def pass_time(self, duration_s):
        """Let time pass without calls of the host."""
        self.dies_at_s, dies_at_s = float("inf"), self.dies_at_s
        self.clock.sleep(duration_s)
        try:
            self._now()
        except usb.core.USBError:
            pass
        finally:
            self.dies_at_s = dies_at_s

    def _spend(self, duration_s):
        self.clock.sleep(duration_s)
        self._now()

    # --- descriptors ---

    def enumerate_devices(self):
        try:
            self._now()
        except usb.core.USBError:
            return []
        return ["helios", *self.others]

    def get_device_descriptor(self, dev):
        ids = (0x1209, 0xE500) if str(dev).startswith("helios") else dev
        return SimpleNamespace(
            bLength=18, bDescriptorType=1, bcdUSB=0x0200, bDeviceClass=0, bDeviceSubClass=0, bDeviceProtocol=0,
            bMaxPacketSize0=64, idVendor=ids[0], idProduct=ids[1], bcdDevice=0x0200, iManufacturer=0, iProduct=0,
            iSerialNumber=0, bNumConfigurations=1, address=7, bus=1, port_number=1, port_numbers=(1,), speed=2,
        )  # fmt: skip

    def get_configuration_descriptor(self, dev, config):
        if config:
            raise IndexError
        return SimpleNamespace(
            bLength=9, bDescriptorType=2, wTotalLength=0, bNumInterfaces=1, bConfigurationValue=1, iConfiguration=0,
            bmAttributes=0x80, bMaxPower=75, extra_descriptors=[],
        )  # fmt: skip

    def get_interface_descriptor(self, dev, intf, alt, config):
        if intf or alt > 1:
            raise IndexError
        return SimpleNamespace(
            bLength=9, bDescriptorType=4, bInterfaceNumber=0, bAlternateSetting=alt, bNumEndpoints=3 if alt else 0,
            bInterfaceClass=255, bInterfaceSubClass=255, bInterfaceProtocol=255, iInterface=0, extra_descriptors=[],
        )  # fmt: skip

    def get_endpoint_descriptor(self, dev, ep, intf, alt, config):
        address, kind, size = ((INT_IN, 3, 32), (INT_OUT, 3, 32), (BULK_OUT, 2, 64))[ep]
        return SimpleNamespace(
            bLength=7, bDescriptorType=5, bEndpointAddress=address, bmAttributes=kind, wMaxPacketSize=size,
            bInterval=1, bRefresh=0, bSynchAddress=0, extra_descriptors=[],
        )  # fmt: skip

    # --- the device as a whole ---

    def open_device(self, dev):
        self._now()
        if self.open_errno:
            raise usb.core.USBError("Access denied (insufficient permissions)", errno=self.open_errno)
        return dev

    def close_device(self, handle):
        self._now()

    def get_configuration(self, handle):
        return 1

    def claim_interface(self, handle, intf):
        self._now()
        self.claimed = True

    def release_interface(self, handle, intf):
        self._now()
        self.claimed = False

    def set_interface_altsetting(self, handle, intf, alt):
        self._now()
        assert self.claimed
        self.alternate = alt
        self.device.enable(alt == 1)

    # --- transfers ---

    def _endpoint(self, endpoint, expected):
        self._now()
        assert endpoint == expected
        if not (self.claimed and self.alternate == 1):
            raise usb.core.USBError("Input/Output Error", errno=errno.EIO)

    def intr_write(self, handle, ep, intf, data, timeout):
        self._endpoint(ep, INT_OUT)
        assert timeout > 0
        if self.refused:
            self.refused -= 1
            self._spend(timeout * 1e-3)
            raise usb.core.USBTimeoutError("Operation timed out", errno=errno.ETIMEDOUT)
        self._spend(COMMAND_S)
        self.commands.append(bytes(data))
        self.device.command(bytes(data))
        return len(data)

    def intr_read(self, handle, ep, intf, buff, timeout):
        self._endpoint(ep, INT_IN)
        assert timeout > 0
        answer = self.device.answer
        if answer is None or self.deaf:
            self.deaf = max(0, self.deaf - (answer is not None))
            self._spend(timeout * 1e-3)
            raise usb.core.USBTimeoutError("Operation timed out", errno=errno.ETIMEDOUT)
        self._spend(COMMAND_S)
        self.device.answer = None
        if self.busy and answer[0] == 0x83:
            self.busy -= 1
            answer = b"\x83\x00"
        if self.garbage:
            answer = self.garbage.popleft()
        for place, byte in enumerate(answer):
            buff[place] = byte
        return len(answer)

    def bulk_write(self, handle, ep, intf, data, timeout):
        self._endpoint(ep, BULK_OUT)
        assert timeout > 0
        give_up_s = self.clock.now_s() + timeout * 1e-3
        data, done = bytes(data), 0
        while done < len(data):
            while not self.device.armed:
                if self.clock.now_s() >= give_up_s:
                    if done:
                        return done
                    raise usb.core.USBTimeoutError("Operation timed out", errno=errno.ETIMEDOUT)
                due = self.device.next_due()
                step_s = give_up_s - self.clock.now_s()
                if due is not None:
                    step_s = min(step_s, max(1e-6, due / CLOCK_HZ - self.clock.now_s()))
                self._spend(step_s)
            packet = data[done : done + 64]
            self._spend(len(packet) / BYTES_PER_S)
            self.device.packet(packet)
            done += len(packet)
        self.transfers.append(data)
        return len(data)
