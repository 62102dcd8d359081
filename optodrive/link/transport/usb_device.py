"""Lookup of USB devices with pyusb."""

import errno
from contextlib import suppress
from typing import Any

import usb.core

from optodrive.core.errors import InputError
from optodrive.link.transport.base import guard_opening


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
