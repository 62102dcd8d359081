"""A device on USB by its ids, through pyusb, with pyusb's complaints in this package's words."""

import errno
from typing import Any

import usb.core

from optodrive.core.errors import InputError, LinkError

PERMISSION_ERRNOS = (errno.EACCES, errno.EPERM)


def find_device(vendor_id: int, product_id: int, serial_number: str = "", backend: Any = None) -> Any:
    """The only device with these ids, a `usb.core.Device`; InputError where there is none, or more than one.

    backend: pyusb's, None for the libusb that is installed.
    """
    ids = f"{vendor_id:04x}:{product_id:04x}"
    try:
        devices = list(usb.core.find(find_all=True, backend=backend, idVendor=vendor_id, idProduct=product_id))
        if serial_number:
            devices = [device for device in devices if _serial_number(device) == serial_number]
    except usb.core.NoBackendError:
        raise InputError("board.transport", "usb", "libusb 1.0 on this machine (libusb-1.0-0)", "no_port") from None
    except usb.core.USBError as error:
        raise build_open_error(ids, error) from None
    description = f"{ids} {serial_number}".rstrip()
    if not devices:
        raise InputError("board", description, "a USB device that is plugged in", "no_port")
    if len(devices) > 1:
        raise InputError(
            "board", f"{len(devices)} times {description}", "one such USB device, or its serial_number", "no_port"
        )
    return devices[0]


def _serial_number(device: Any) -> str | None:
    """The device's serial number; USBError (EACCES) where it may not be asked, which pyusb calls a ValueError."""
    try:
        serial_number: str | None = device.serial_number
    except ValueError as error:
        raise usb.core.USBError(str(error), errno=errno.EACCES) from None
    return serial_number


def build_open_error(name: str, error: Exception) -> InputError | LinkError:
    """Why a device could not be opened."""
    if getattr(error, "errno", None) in PERMISSION_ERRNOS:
        return InputError("board", name, "permission to open it (a udev rule for its ids?)", "no_port")
    return LinkError(f"{name} cannot be opened: {error}; does another program hold it?")


def build_lost_error(name: str, error: Exception) -> LinkError:
    """A link that failed while in use."""
    detail = "; it is gone: unplugged, or without power" if getattr(error, "errno", None) == errno.ENODEV else ""
    return LinkError(f"link to {name} lost: {error}{detail}")


def timeout_ms(timeout_s: float) -> int:
    """A time-out as libusb takes it, where 0 would mean for ever."""
    return max(1, round(timeout_s * 1e3))
