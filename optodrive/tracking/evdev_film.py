"""A multitouch film at the Linux input layer, read by python-evdev.

Of the kernel's interface python-evdev lacks two calls (linux/input.h): the clock of the events' times, which is set to
CLOCK_MONOTONIC here, and the state of all slots, which is read at the begin and where the kernel has dropped events.
"""

import fcntl
import platform
import select
import stat
import struct
import time
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Self

from optodrive.core.errors import MISSING, InputError, LinkError, Unquoted
from optodrive.core.extras import import_extra
from optodrive.tracking.contacts import (
    ABS_MT_POSITION_X,
    ABS_MT_POSITION_Y,
    ABS_MT_SLOT,
    EV_ABS,
    EV_SYN,
    SLOT_CODES,
    SYN_DROPPED,
    SYN_REPORT,
    FilmAxes,
    FilmAxis,
    InputEvent,
)

SET_CLOCK_ID = 0x400445A0
"""EVIOCSCLOCKID, of one int."""
GET_SLOTS = 0x8000450A
"""EVIOCGMTSLOTS, of a buffer whose size stands in bits 16 to 29."""
FILM = "a multitouch film, as `python -m evdev.evtest` lists them"


def is_device(path: Path) -> bool:
    """Return whether a path is that of a device, and not of a recording."""
    try:
        return stat.S_ISCHR(path.stat().st_mode)
    except (OSError, ValueError):
        return False


class EvdevFilm:
    """An opened film. Raises InputError for a path that is none, and LinkError where it is disconnected."""

    def __init__(self, path: Path) -> None:
        if platform.machine() != "x86_64" and find_spec("evdev") is None:  # the extra has no evdev there
            expected = f"`pip install evdev`, which needs a compiler and the kernel's headers on {platform.machine()}"
            raise InputError("evdev", MISSING, expected, "missing_extra")
        evdev = import_extra("evdev", extra="tracking")
        try:
            self._device: Any = evdev.InputDevice(str(path))
        except PermissionError:
            expected = "a device that may be read, as members of the group `input` may"
            raise InputError(str(path), Unquoted("no permission"), expected) from None
        except OSError as error:
            raise InputError(str(path), Unquoted(error.strerror or str(error)), FILM) from None
        codes = self._device.capabilities(absinfo=False).get(EV_ABS, [])
        if not {ABS_MT_SLOT, *SLOT_CODES} <= set(codes):
            found = f"{self._device.name!r}, which has no slots"
            self.close()
            raise InputError(str(path), Unquoted(found), FILM)
        self._path = path
        x, y = (self._device.absinfo(code) for code in (ABS_MT_POSITION_X, ABS_MT_POSITION_Y))
        self.axes = FilmAxes(
            self._device.name,
            self._device.absinfo(ABS_MT_SLOT).max + 1,
            FilmAxis(x.min, x.max, x.resolution),
            FilmAxis(y.min, y.max, y.resolution),
        )
        fcntl.ioctl(self._device.fd, SET_CLOCK_ID, struct.pack("i", time.CLOCK_MONOTONIC))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *details: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the device."""
        self._device.close()

    def read_events(self, timeout_s: float) -> Iterator[tuple[InputEvent, ...]]:
        """Yield events as they come, without any after each time of waiting, until the film is disconnected.

        The state of all slots stands at the begin, and after every gap that the kernel reports.
        """
        yield self._read_state(time.monotonic())
        is_dropping = False
        while True:
            events: list[InputEvent] = []
            for event in self._read_ready(timeout_s):
                events.append(event)
                if (event.kind, event.code) == (EV_SYN, SYN_DROPPED):
                    is_dropping = True
                elif is_dropping and (event.kind, event.code) == (EV_SYN, SYN_REPORT):
                    is_dropping = False
                    events.extend(self._read_state(event.at_s))
            yield tuple(events)

    def _read_ready(self, timeout_s: float) -> list[InputEvent]:
        """Return the events that wait, or none after a time. Raise LinkError if the film is disconnected."""
        if not select.select([self._device.fd], [], [], timeout_s)[0]:
            return []
        try:
            events = [
                InputEvent(event.sec + 1e-6 * event.usec, event.type, event.code, event.value)
                for event in self._device.read()
            ]
        except BlockingIOError:  # woken for nothing
            return []
        except OSError as error:
            raise LinkError(f"{self._path}: the film is gone: {error.strerror}") from None
        if not events:
            raise LinkError(f"{self._path}: the film is gone: end of its events")
        return events

    def _read_state(self, at_s: float) -> tuple[InputEvent, ...]:
        """Return events that state all slots at a time, and then the slot that is current."""
        values = {code: self._read_slots(code) for code in SLOT_CODES}
        events = []
        for slot in range(self.axes.slots):
            events.append(InputEvent(at_s, EV_ABS, ABS_MT_SLOT, slot))
            events.extend(InputEvent(at_s, EV_ABS, code, values[code][slot]) for code in SLOT_CODES)
        current = self._device.absinfo(ABS_MT_SLOT).value
        events.append(InputEvent(at_s, EV_ABS, ABS_MT_SLOT, current))
        return (*events, InputEvent(at_s, EV_SYN, SYN_REPORT, 0))

    def _read_slots(self, code: int) -> tuple[int, ...]:
        buffer = bytearray(struct.pack("I", code) + bytes(4 * self.axes.slots))
        try:
            fcntl.ioctl(self._device.fd, GET_SLOTS | len(buffer) << 16, buffer)
        except OSError as error:
            raise LinkError(f"{self._path}: the film is gone: {error.strerror}") from None
        return struct.unpack_from(f"{self.axes.slots}i", buffer, 4)
