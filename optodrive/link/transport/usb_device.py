"""Lookup of USB devices with pyusb, and translation of pyusb's errors."""

import errno
from typing import Any

import usb.core

from optodrive.core.errors import InputError, LinkError

PERMISSION_ERRNOS = (errno.EACCES, errno.EPERM)


def find_device(vendor_id: int, product_id: int, serial_number: str = "", backend: Any = None) -> Any:
    """Return the only device with these ids, a `usb.core.Device`.

    Raise InputError if there is none or more than one. backend: of pyusb, None for the installed libusb
    """
    ids = f"{vendor_id:04x}:{product_id:04x}"
    try:
        devices = list(usb.core.find(find_all=True, backend=backend, idVendor=vendor_id, idProduct=product_id))
        if serial_number:
            devices = [device for device in devices if _read_serial_number(device) == serial_number]
    except usb.core.NoBackendError:
        raise InputError("board.transport", "usb", "libusb 1.0 on this machine (libusb-1.0-0)", "no_port") from None
    except usb.core.USBError as error:
        raise build_open_error(ids, error) from None
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


def build_open_error(name: str, error: Exception) -> InputError | LinkError:
    """Return the error for a device that could not be opened."""
    if getattr(error, "errno", None) in PERMISSION_ERRNOS:
        return InputError("board", name, "permission to open it (a udev rule for its ids?)", "no_port")
    return LinkError(f"{name} cannot be opened: {error}; is it in use by another program?")


def build_lost_error(name: str, error: Exception) -> LinkError:
    """Return the error for a link that failed while open."""
    detail = "; it is missing: unplugged, or without power" if getattr(error, "errno", None) == errno.ENODEV else ""
    return LinkError(f"link to {name} lost: {error}{detail}")


def timeout_ms(timeout_s: float) -> int:
    """Return a timeout for libusb, for which 0 would mean infinite."""
    return max(1, round(timeout_s * 1e3))
