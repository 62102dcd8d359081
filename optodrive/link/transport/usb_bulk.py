"""Transport over two bulk endpoints of a USB device, with pyusb."""

import errno
from contextlib import suppress
from typing import Any, Self

import usb.core
import usb.util

from optodrive.core.errors import MISSING, InputError, LinkError
from optodrive.link.transport.base import PortSettings, TransportKind, guard_opening, guard_port


def list_devices(vendor_id: int, product_id: int, serial_number: str = "", backend: Any = None) -> list[Any]:
    """Return all devices with these ids, as `usb.core.Device`. Raise InputError if there is none.

    serial_number: '' for any; backend: of pyusb, None for the installed libusb
    """
    ids = f"{vendor_id:04x}:{product_id:04x}"
    with guard_opening(ids, "board"):
        try:
            devices = list(usb.core.find(find_all=True, backend=backend, idVendor=vendor_id, idProduct=product_id))
        except usb.core.NoBackendError:
            raise InputError("board.transport", "usb", "libusb 1.0 on this machine (libusb-1.0-0)", "no_port") from None
        found = [device for device in devices if not serial_number or read_serial_number(device) == serial_number]
    if devices and not found:
        others = ", ".join(describe_device(device) for device in devices)
        raise InputError("board.serial_number", serial_number, f"that of a connected {ids}: {others}", "no_port")
    if not devices:
        raise InputError("board", f"{ids} {serial_number}".rstrip(), "a connected USB device", "no_port")
    return found


def find_device(vendor_id: int, product_id: int, serial_number: str = "", backend: Any = None) -> Any:
    """Return the only device with these ids, a `usb.core.Device`.

    Raise InputError if there is none or more than one. backend: of pyusb, None for the installed libusb
    """
    devices = list_devices(vendor_id, product_id, serial_number, backend)
    if len(devices) > 1:
        description = f"{len(devices)} times {vendor_id:04x}:{product_id:04x} {serial_number}".rstrip()
        listed = ", ".join(describe_device(device) for device in devices)
        raise InputError("board", description, f"one such USB device, or its serial_number: {listed}", "no_port")
    return devices[0]


def describe_device(device: Any) -> str:
    """Return where a device is connected, and its serial number."""
    with suppress(usb.core.USBError):
        if (serial_number := read_serial_number(device)) is not None:
            return f"bus {device.bus} device {device.address}, serial_number {serial_number!r}"
    return f"bus {device.bus} device {device.address}, without serial_number"


def read_serial_number(device: Any) -> str | None:
    """Return the serial number. Raise USBError (EACCES) without permission, where pyusb raises ValueError."""
    try:
        serial_number: str | None = device.serial_number
    except ValueError as error:
        raise usb.core.USBError(str(error), errno=errno.EACCES) from None
    return serial_number


def timeout_ms(timeout_s: float) -> int:
    """Return a timeout for libusb, for which 0 would mean infinite."""
    return max(1, round(timeout_s * 1e3))


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
