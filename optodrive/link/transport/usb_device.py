"""Lookup of USB devices with pyusb."""

import errno
from typing import Any

import usb.core

from optodrive.core.errors import InputError
from optodrive.link.transport.base import guard_opening


def find_device(vendor_id: int, product_id: int, serial_number: str = "", backend: Any = None) -> Any:
    """Return the only device with these ids, a `usb.core.Device`.

    Raise InputError if there is none or more than one. backend: of pyusb, None for the installed libusb
    """
    ids = f"{vendor_id:04x}:{product_id:04x}"
    with guard_opening(ids, "board"):
        try:
            devices = list(usb.core.find(find_all=True, backend=backend, idVendor=vendor_id, idProduct=product_id))
        except usb.core.NoBackendError:
            raise InputError("board.transport", "usb", "libusb 1.0 on this machine (libusb-1.0-0)", "no_port") from None
        if serial_number:
            devices = [device for device in devices if _read_serial_number(device) == serial_number]
    description = f"{ids} {serial_number}".rstrip()
    if not devices:
        raise InputError("board", description, "a connected USB device", "no_port")
    if len(devices) > 1:
        raise InputError(
            "board", f"{len(devices)} times {description}", "one such USB device, or its serial_number", "no_port"
        )
    return devices[0]


def _read_serial_number(device: Any) -> str | None:
    """Return the serial number. Raise USBError (EACCES) without permission, where pyusb raises ValueError."""
    try:
        serial_number: str | None = device.serial_number
    except ValueError as error:
        raise usb.core.USBError(str(error), errno=errno.EACCES) from None
    return serial_number


def timeout_ms(timeout_s: float) -> int:
    """Return a timeout for libusb, for which 0 would mean infinite."""
    return max(1, round(timeout_s * 1e3))
