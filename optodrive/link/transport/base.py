"""Interface of all transports, to real and simulated boards alike, and the meaning of their errors.

A port fails in many ways: `termios.error` is no OSError, pyserial and pyusb have errors of their own, and a thread may
not start. An exception that leaves a transport would end the process that serves all boards. So every method runs
within `guard_port`, or `guard_opening`, and raises nothing but errors of this package.
"""

import errno
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

from optodrive.core.errors import InputError, LinkError, OptodriveError, escape_unprintable


@dataclass(frozen=True)
class PortSettings:
    """Address of a board, of the fields of these names in its section of the configuration.

    transport: name of a transport; port: serial device; baud: its bit rate, 1/s
    vendor_id, product_id, serial_number: of a USB device; an empty serial number accepts the only device of its kind
    own_settings: the settings that a board in software has by itself, by their name in its file of limits
    uid, points_per_s, curve: of a laser DAC: its name, its rate, and its laser's power by duty, W
    interlock_watched: whether an external interlock is stated for it; None for a board, which has one of its own
    """

    transport: str
    port: str = ""
    baud: int = 1_000_000
    vendor_id: int | None = None
    product_id: int | None = None
    serial_number: str = ""
    own_settings: dict[str, int | str] = field(default_factory=dict)
    uid: str = ""
    points_per_s: int = 40_000
    curve: tuple[tuple[float, float], ...] = ()
    interlock_watched: bool | None = None


ERROR_TEXT_MAX = 200
"""Longest text of a library's error in a message, characters."""


class Transport(Protocol):
    """Byte stream to a board. All methods raise LinkError when the link fails, and close, release never."""

    name: str

    def open(self) -> None:
        """Open the link exclusively. Raise InputError if the configured device does not exist."""

    def read(self, timeout_s: float) -> bytes:
        """Return the bytes that have arrived. Wait at most timeout_s for the first."""

    def write(self, data: bytes) -> None:
        """Hand data to the operating system, and the rest of it, if there is no room, at the next calls."""

    def fileno(self) -> int | None:
        """Return a descriptor that is readable when bytes have arrived, None if there is none or it is closed."""

    def describe_fault(self) -> str:
        """Return the evident fault of the open link with its remedy, or an empty text. Never raise."""

    def close(self) -> None:
        """Close the link. It may be opened again. Do nothing if it is closed."""

    def release(self) -> None:
        """Send unsent data, close permanently, and stop everything that open() has started."""


class TransportKind(NamedTuple):
    """Kind of transport.

    name: its value of `board.transport`; create: from an address, without opening it
    """

    name: str
    create: Callable[[PortSettings], Transport]


# --- errors ---------------------------------------------------------------------------------------------------------

GONE = "the device is gone: unplugged, reset or without power", "check plug, cable and supply"
BROKEN_TRANSFER = "a USB transfer failed: cable, hub or device", "connect it directly, with another cable"
OCCUPIED = "another program has it open", "end that program; `optodrive doctor` names it"
NO_DEVICE = "there is no such device", "connect it, or name another one"
PORT_ERRORS = {
    errno.EACCES: ("this user may not open it", "join its group (often dialout), or give a USB device a udev rule"),
    errno.EPERM: (
        "the system forbids it to this process, not to the user",
        "add the device to DeviceAllow of the service's unit, or to the container",
    ),
    errno.EBUSY: OCCUPIED,
    errno.EAGAIN: OCCUPIED,  # of pyserial's lock
    errno.ENOENT: NO_DEVICE,
    errno.ENOTDIR: NO_DEVICE,
    errno.ENXIO: ("the name exists, and no device is behind it", "connect the device, or name another port"),
    errno.EIO: (
        "the device does not answer its driver: unplugged, without power, or none at this port",
        "check plug, cable and supply, or name another port",
    ),
    errno.ENODEV: GONE,
    errno.ESHUTDOWN: GONE,
    errno.ENOTTY: ("it is no serial port", "name a serial port"),
    errno.EINVAL: ("its driver refuses a setting, as the bit rate", "choose a bit rate that the adapter supports"),
    errno.ETIMEDOUT: ("the device accepts no bytes", "check whether it hangs, its plug and its supply"),
    errno.EMFILE: ("this process has too many files open", "raise LimitNOFILE of the service, or ulimit -n"),
    errno.ENFILE: ("this computer has too many files open", "end other programs, or raise fs.file-max"),
    errno.ENOMEM: ("this computer has no memory left for it", "end other programs"),
    errno.ENOSPC: ("its USB bus or this disk has no room left", "connect it to another USB port, free the disk"),
    errno.EPIPE: BROKEN_TRANSFER,
    errno.EPROTO: BROKEN_TRANSFER,
    errno.EILSEQ: BROKEN_TRANSFER,
    errno.EOVERFLOW: BROKEN_TRANSFER,
}
"""Meaning and remedy of the errors of ports, by their number."""
ABSENT = (errno.ENOENT, errno.ENOTDIR)
DENIED = (errno.EACCES, errno.EPERM)


def find_errno(error: BaseException | None) -> int | None:
    """Return the number of an error of the operating system, also of one that a library has wrapped, None without."""
    while error is not None:
        number = getattr(error, "errno", None)
        if number is None and error.args:  # of termios.error, which has no field of this name
            number = error.args[0]
        if type(number) is int and number in errno.errorcode:
            return number
        error = error.__cause__ or error.__context__
    return None


def describe_port_error(error: BaseException) -> str:
    """Return the meaning of an error of a port and the remedy in one line, or that its cause is not known."""
    number = find_errno(error)
    if number in PORT_ERRORS:
        meaning, remedy = PORT_ERRORS[number]
        return f"{meaning} ({errno.errorcode[number]}); {remedy}"
    text = escape_unprintable(f"{type(error).__name__}: {error}")[:ERROR_TEXT_MAX]
    return f"{text}{'' if number is None else f' ({errno.errorcode[number]})'}; what causes it is not known"


def build_open_error(name: str, error: Exception, config_key: str) -> InputError | LinkError:
    """Return the error for a port that could not be opened: InputError if it is absent or denied."""
    number = find_errno(error)
    if number in ABSENT:
        return InputError(config_key, name, "a device that exists", "no_port")
    if number in DENIED:
        return InputError(config_key, name, f"permission to open it: {describe_port_error(error)}", "no_port")
    return LinkError(f"{name} cannot be opened: {describe_port_error(error)}")


def build_lost_error(name: str, error: Exception) -> LinkError:
    """Return the error for a link that failed while open."""
    return LinkError(f"link to {name} lost: {describe_port_error(error)}")


@contextmanager
def guard_port(name: str) -> Iterator[None]:
    """Let every exception of a library, at any call on an open port, be the loss of its link."""
    try:
        yield
    except (OptodriveError, MemoryError):
        raise
    except Exception as error:
        raise build_lost_error(name, error) from None


@contextmanager
def guard_opening(name: str, config_key: str = "board.port") -> Iterator[None]:
    """Let every exception of a library, while a port is opened, say why it could not be."""
    try:
        yield
    except (OptodriveError, MemoryError):
        raise
    except Exception as error:
        raise build_open_error(name, error, config_key) from None
