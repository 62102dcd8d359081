"""Transport over two bulk endpoints of a USB device, with pyusb."""

from contextlib import suppress
from typing import Any, Self

import usb.core
import usb.util

from optodrive.core.errors import MISSING, InputError, LinkError
from optodrive.link.transport.base import PortSettings, TransportKind, guard_opening, guard_port
from optodrive.link.transport.usb_device import find_device, timeout_ms

WRITE_TIMEOUT_S = 0.5
READ_BYTES = 4096
"""Read size. It is a multiple of every packet size, so that no packet is truncated."""
STALE_READS_MAX = 64
"""Maximum number of reads that discard bytes of a previous session."""


class UsbBulk:
    """Transport that claims the first interface with a bulk endpoint in each direction.

    backend: of pyusb, None for libusb
    """

    def __init__(self, vendor_id: int, product_id: int, serial_number: str = "", backend: Any = None) -> None:
        self.name = f"usb {vendor_id:04x}:{product_id:04x}" + (f" {serial_number}" if serial_number else "")
        self._ids = vendor_id, product_id, serial_number
        self._backend = backend
        self._device: Any = None
        self._in: Any = None
        self._out: Any = None

    @classmethod
    def from_settings(cls, port: PortSettings) -> Self:
        """Build the transport of an address. Raise InputError if it names no device."""
        if port.vendor_id is None or port.product_id is None:
            raise InputError("board.vendor_id, board.product_id", MISSING, "both, for transport 'usb'")
        return cls(port.vendor_id, port.product_id, port.serial_number)

    def open(self) -> None:
        """Claim the device.

        Raise InputError if there is none or access is denied, LinkError if it is in use.
        """
        with guard_opening(self.name, "board"):
            self._device = find_device(*self._ids, backend=self._backend)
            try:
                self._claim()
            except Exception:
                self.close()
                raise

    def _claim(self) -> None:
        for interface in self._device.get_active_configuration():
            endpoints = {
                usb.util.endpoint_direction(endpoint.bEndpointAddress): endpoint
                for endpoint in interface
                if usb.util.endpoint_type(endpoint.bmAttributes) == usb.util.ENDPOINT_TYPE_BULK
            }
            if len(endpoints) == 2:
                self._in, self._out = endpoints[usb.util.ENDPOINT_IN], endpoints[usb.util.ENDPOINT_OUT]
                usb.util.claim_interface(self._device, interface.bInterfaceNumber)
                if interface.bAlternateSetting:  # a device with a single setting may reject the request
                    self._device.set_interface_altsetting(interface.bInterfaceNumber, interface.bAlternateSetting)
                self._drain()
                return
        raise InputError("board", self.name, "a device with a bulk endpoint in each direction", "no_port")

    def _drain(self) -> None:
        with suppress(usb.core.USBTimeoutError):
            for _ in range(STALE_READS_MAX):
                self._in.read(READ_BYTES, timeout_ms(0.0))

    def read(self, timeout_s: float) -> bytes:
        """Return the bytes that have arrived. Wait at most timeout_s, rounded to a millisecond, for the first."""
        self._require_open()
        with guard_port(self.name):
            try:
                return bytes(self._in.read(READ_BYTES, timeout_ms(timeout_s)))
            except usb.core.USBTimeoutError:
                return b""

    def write(self, data: bytes) -> None:
        """Write all of data. Raise LinkError if the device does not accept it within half a second."""
        self._require_open()
        with guard_port(self.name):
            written_bytes = self._out.write(data, timeout_ms(WRITE_TIMEOUT_S)) if data else 0
        if written_bytes != len(data):
            raise LinkError(f"link to {self.name} lost: it accepted {written_bytes} of {len(data)} bytes")

    def _require_open(self) -> None:
        if self._device is None:
            raise LinkError(f"{self.name} is not open")

    def fileno(self) -> int | None:
        """Return None: libusb has no descriptor that reports received bytes."""
        return None

    def describe_fault(self) -> str:
        """Return an empty text: the errors of a USB device state its faults."""
        return ""

    def close(self) -> None:
        """Release the device. The board does not notice and turns the gate off when its lease expires."""
        device, self._device = self._device, None
        if device is not None:
            with suppress(Exception):  # releasing an unplugged device fails
                usb.util.dispose_resources(device)

    def release(self) -> None:
        """Release the device."""
        self.close()


TRANSPORT = TransportKind("usb", UsbBulk.from_settings)
