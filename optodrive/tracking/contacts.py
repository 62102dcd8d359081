"""Contacts on a film: the state of its slots, from events of multitouch protocol B."""

from collections.abc import Iterable, Iterator
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


class Contact(NamedTuple):
    """A contact on a film.

    number: the same until it is lifted; x, y: in units of the film's axes
    """

    number: int
    x: int
    y: int


class ContactReport(NamedTuple):
    """All contacts on a film at a time."""

    at_s: float
    contacts: tuple[Contact, ...]


class ContactDecoder:
    """Follows the slots of a film.

    The kernel sends a value only when it changes, so a slot keeps its place when its finger is lifted: the next finger
    in it may land at the same x. After SYN_DROPPED events are missing. The contacts are then unknown, and so is the
    slot to which values belong, until events state them again, as `EvdevFilm` makes them do.
    """

    def __init__(self) -> None:
        self._slots: dict[int, dict[int, int]] = {}
        self._slot: int | None = 0
        self._is_dropping = False

    def push(self, event: InputEvent) -> ContactReport | None:
        """Take an event. Return all contacts if it completes a report."""
        if event.kind == EV_SYN and event.code == SYN_DROPPED:
            self._slots.clear()
            self._slot, self._is_dropping = None, True
        elif event.kind == EV_SYN and event.code == SYN_REPORT:
            if not self._is_dropping:
                return ContactReport(event.at_s, self._list_contacts())
            self._is_dropping = False
        elif event.kind == EV_ABS and not self._is_dropping:
            if event.code == ABS_MT_SLOT:
                self._slot = event.value
            elif self._slot is not None:
                self._slots.setdefault(self._slot, {})[event.code] = event.value
        return None

    def _list_contacts(self) -> tuple[Contact, ...]:
        states = (
            (state.get(ABS_MT_TRACKING_ID, -1), state.get(ABS_MT_POSITION_X), state.get(ABS_MT_POSITION_Y))
            for _, state in sorted(self._slots.items())
        )
        return tuple(
            Contact(number, x, y) for number, x, y in states if number >= 0 and x is not None and y is not None
        )


def decode_contacts(events: Iterable[InputEvent]) -> Iterator[ContactReport]:
    """Yield the reports of a sequence of events."""
    decoder = ContactDecoder()
    for event in events:
        report = decoder.push(event)
        if report is not None:
            yield report
