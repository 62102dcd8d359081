"""pyusb backend that connects bulk endpoints to a simulated board core, in virtual time."""

import errno
from types import SimpleNamespace

import usb.backend
import usb.core

PASSAGE_S = 1e-4
PACKET_BYTES = 64
BULK_OUT, BULK_IN = 0x01, 0x82
STRINGS = {0: b"\x04\x03\x09\x04"}


class UsbBridge(usb.backend.IBackend):
    """Backend with one device per serial number. Interface 0 has no bulk endpoints, interface 1 is the core's."""

    def __init__(self, core, clock, serials=("A1",), ids=(0x1209, 0x0001), one_way=False):
        self.core, self.clock, self.serials, self.ids, self.one_way = core, clock, serials, ids, one_way
        self.plugged = True
        self.open_errno = self.claim_errno = None
        self.claimed = set()
        self.waiting = b""
        self.stalled = False

    def _check(self):
        if not self.plugged:
            raise usb.core.USBError("No such device (it may have been disconnected)", errno=errno.ENODEV)

    def _now_us(self):
        return round(self.clock.now_s() * 1e6)

    def unplug(self):
        self.plugged = False
        self.core.on_link_lost(self._now_us())

    # --- descriptors ---

    def enumerate_devices(self):
        return range(len(self.serials)) if self.plugged else ()

    def get_device_descriptor(self, dev):
        return SimpleNamespace(
            bLength=18, bDescriptorType=1, bcdUSB=0x0200, bDeviceClass=0, bDeviceSubClass=0, bDeviceProtocol=0,
            bMaxPacketSize0=64, idVendor=self.ids[0], idProduct=self.ids[1], bcdDevice=1, iManufacturer=0, iProduct=0,
            iSerialNumber=3, bNumConfigurations=1, address=dev + 1, bus=1, port_number=1, port_numbers=(1,), speed=2,
        )  # fmt: skip

    def get_configuration_descriptor(self, dev, config):
        return SimpleNamespace(
            bLength=9, bDescriptorType=2, wTotalLength=0, bNumInterfaces=2, bConfigurationValue=1, iConfiguration=0,
            bmAttributes=0x80, bMaxPower=50, extra_descriptors=[],
        )  # fmt: skip

    def get_interface_descriptor(self, dev, intf, alt, config):
        if intf > 1 or alt:
            raise IndexError
        return SimpleNamespace(
            bLength=9, bDescriptorType=4, bInterfaceNumber=intf, bAlternateSetting=0, bNumEndpoints=(1, 2)[intf],
            bInterfaceClass=255, bInterfaceSubClass=0, bInterfaceProtocol=0, iInterface=0, extra_descriptors=[],
        )  # fmt: skip

    def get_endpoint_descriptor(self, dev, ep, intf, alt, config):
        address = 0x83 if intf == 0 else (BULK_OUT, BULK_OUT + 2 if self.one_way else BULK_IN)[ep]
        return SimpleNamespace(
            bLength=7, bDescriptorType=5, bEndpointAddress=address, bmAttributes=3 if intf == 0 else 2,
            wMaxPacketSize=PACKET_BYTES, bInterval=1, bRefresh=0, bSynchAddress=0, extra_descriptors=[],
        )  # fmt: skip

    def ctrl_transfer(self, handle, kind, request, value, index, data, timeout):
        self._check()
        serial = self.serials[handle].encode("utf-16-le")
        text = STRINGS.get(value & 255, bytes([len(serial) + 2, 3]) + serial)[: len(data)]
        for place, byte in enumerate(text):
            data[place] = byte
        return len(text)

    # --- the device as a whole ---

    def open_device(self, dev):
        if self.open_errno:
            raise usb.core.USBError("Access denied", errno=self.open_errno)
        return dev

    def close_device(self, handle):
        self._check()

    def get_configuration(self, handle):
        return 1

    def set_interface_altsetting(self, handle, intf, alt):
        self._check()

    def claim_interface(self, handle, intf):
        if self.claim_errno:
            raise usb.core.USBError("Resource busy", errno=self.claim_errno)
        self.claimed.add((handle, intf))

    def release_interface(self, handle, intf):
        self._check()
        self.claimed.discard((handle, intf))

    # --- transfers ---

    def bulk_write(self, handle, ep, intf, data, timeout):
        self._check()
        assert (ep, timeout > 0) == (BULK_OUT, True)
        if self.stalled:
            self.clock.sleep(timeout * 1e-3)
            raise usb.core.USBTimeoutError("Operation timed out", errno=errno.ETIMEDOUT)
        data = bytes(data)
        for first in range(0, len(data), PACKET_BYTES):
            self.core.receive(data[first : first + PACKET_BYTES], self._now_us())
        return len(data)

    def bulk_read(self, handle, ep, intf, buff, timeout):
        self._check()
        assert (ep, timeout > 0, len(buff) % PACKET_BYTES) == (BULK_IN, True, 0)
        self.clock.sleep(PASSAGE_S)
        self._advance()
        if not self.waiting:
            self.clock.sleep(timeout * 1e-3)
            self._advance()
        if not self.waiting:
            raise usb.core.USBTimeoutError("Operation timed out", errno=errno.ETIMEDOUT)
        data, self.waiting = self.waiting[: len(buff)], self.waiting[len(buff) :]
        for place, byte in enumerate(data):
            buff[place] = byte
        return len(data)

    def _advance(self):
        self.core.advance(self._now_us())
        self.waiting += self.core.bytes_to_send()
