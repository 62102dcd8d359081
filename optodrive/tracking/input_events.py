"""Events of Linux input devices, and the few codes of multitouch protocol B (Documentation/input/multi-touch-protocol).

The codes are those of the kernel's interface (input-event-codes.h), so that a recording is read without python-evdev.
"""

from typing import NamedTuple

EV_SYN, EV_ABS = 0x00, 0x03
SYN_REPORT, SYN_DROPPED = 0x00, 0x03
ABS_MT_SLOT, ABS_MT_POSITION_X, ABS_MT_POSITION_Y, ABS_MT_TRACKING_ID = 0x2F, 0x35, 0x36, 0x39
SLOT_CODES = (ABS_MT_TRACKING_ID, ABS_MT_POSITION_X, ABS_MT_POSITION_Y)
"""Codes of a slot, in the order in which its state is restored."""


class InputEvent(NamedTuple):
    """One event.

    at_s: time of the measurement; kind: EV_SYN, EV_ABS or another; code, value: of the kernel
    """

    at_s: float
    kind: int
    code: int
    value: int


class FilmAxis(NamedTuple):
    """One axis of a film.

    minimum, maximum: of its values; per_mm: values per millimetre, 0 if the film does not state it
    """

    minimum: int
    maximum: int
    per_mm: int


class FilmAxes(NamedTuple):
    """The axes of a film, which tell one film from another.

    name: of the device; slots: maximum number of contacts at a time
    """

    name: str
    slots: int
    x: FilmAxis
    y: FilmAxis
