"""Fingertips from a multitouch film, and touches at known pixels, of which its calibration is made."""

import time
from collections.abc import Iterable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Self

import numpy as np

from optodrive.core.errors import InputError, Unquoted, refuse_os_error
from optodrive.core.files import read_regular_file
from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.fingers import FingerReport
from optodrive.device.config import PixelLayout
from optodrive.tracking.contacts import (
    ABS_MT_POSITION_X,
    ABS_MT_POSITION_Y,
    ABS_MT_SLOT,
    Contact,
    ContactDecoder,
    ContactReport,
    FilmAxes,
    FilmAxis,
    InputEvent,
    decode_contacts,
)
from optodrive.tracking.evdev_film import EvdevFilm
from optodrive.tracking.film_calibration import FilmCalibration

HEAD = "# EVEMU 1.3"
BYTES_MAX = 256_000_000
VALUE_MAX = 2**31
SECONDS_MAX = 1e10


class FilmRecording:
    """A recording that was read.

    axes: of its film; events: [n], at times since the first one. Raises InputError for a file that is none.
    """

    def __init__(self, path: Path) -> None:
        content = read_regular_file(path, BYTES_MAX)
        axes: dict[int, tuple[int, ...]] = {}
        name, events = "", []
        if not content.startswith(b"# EVEMU"):
            raise InputError(str(path), Unquoted("another format"), "a recording by --record or evemu-record")
        for number, line in enumerate(content.decode("utf-8", "replace").splitlines(), start=1):
            key, _, rest = line.partition(":")
            try:
                if key == "N":
                    name = rest.strip()[:100]
                elif key == "A":
                    code, *numbers = rest.split("#")[0].split()
                    axes[int(code, 16)] = tuple(map(int, numbers))
                elif key == "E":
                    events.append(_parse_event(rest))
            except ValueError:
                raise InputError(f"{path}: line {number}", line, "a line of evemu's format") from None
        if not {ABS_MT_SLOT, ABS_MT_POSITION_X, ABS_MT_POSITION_Y} <= axes.keys():
            raise InputError(str(path), Unquoted("axes without slots"), "a recording of a multitouch film")
        if next(decode_contacts(events), None) is None:
            raise InputError(str(path), Unquoted("no event"), "a recording of touches")
        begin_s = events[0].at_s
        self.events = tuple(event._replace(at_s=event.at_s - begin_s) for event in events)
        if any(later.at_s < earlier.at_s for earlier, later in pairwise(self.events)):
            raise InputError(f"{path}: times of events", Unquoted("decreasing"), "times that do not decrease")
        x, y = (_build_axis(path, code, axes[code]) for code in (ABS_MT_POSITION_X, ABS_MT_POSITION_Y))
        self.axes = FilmAxes(name, _build_axis(path, ABS_MT_SLOT, axes[ABS_MT_SLOT]).maximum + 1, x, y)


def _parse_event(text: str) -> InputEvent:
    time, kind, code, value = text.split("#")[0].split()
    event = InputEvent(float(time), int(kind, 16), int(code, 16), int(value))
    if not (0.0 <= event.at_s <= SECONDS_MAX and abs(event.value) <= VALUE_MAX):
        raise ValueError
    return event


def _build_axis(path: Path, code: int, numbers: tuple[int, ...]) -> FilmAxis:
    """Return an axis from its line: minimum, maximum, fuzz, flat and a resolution, which may be missing."""
    if len(numbers) < 2 or not -VALUE_MAX <= numbers[0] <= numbers[1] <= VALUE_MAX:
        raise InputError(f"{path}: axis {code:02x}", " ".join(map(str, numbers)), "a minimum and a maximum")
    return FilmAxis(numbers[0], numbers[1], numbers[4] if len(numbers) > 4 else 0)


class FilmRecorder:
    """Writes a recording while its events come. Raises InputError if the file exists or cannot be written."""

    def __init__(self, path: Path, axes: FilmAxes) -> None:
        with refuse_os_error(path, "a new file that can be written"):
            self._file = path.open("x", encoding="utf-8")
        slots = FilmAxis(0, axes.slots - 1, 0)
        lines = [HEAD, f"N: {axes.name}"]
        for code, axis in ((ABS_MT_SLOT, slots), (ABS_MT_POSITION_X, axes.x), (ABS_MT_POSITION_Y, axes.y)):
            lines.append(f"A: {code:02x} {axis.minimum} {axis.maximum} 0 0 {axis.per_mm}")
        self._file.write("\n".join(lines) + "\n")
        self._begin_s: float | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *details: object) -> None:
        self._file.close()

    def write(self, events: Iterable[InputEvent]) -> None:
        """Write events. Times count from the first one."""
        for event in events:
            if self._begin_s is None:
                self._begin_s = event.at_s
            since_s = max(0.0, event.at_s - self._begin_s)
            self._file.write(f"E: {since_s:.6f} {event.kind:04x} {event.code:04x} {event.value:04d}\n")


REPEAT_S = 0.04
"""Time after which contacts that do not change are reported again. A finger that rests causes no event, and a daemon
takes a tracker that is silent for 0.1 s for lost."""


def follow_contacts(film: EvdevFilm, recorder: FilmRecorder | None = None) -> Iterator[ContactReport]:
    """Yield the contacts on a film as they come, and those that stay again, at times of CLOCK_MONOTONIC."""
    decoder = ContactDecoder()
    contacts: ContactReport | None = None
    for events in film.read_events(REPEAT_S):
        if recorder is not None:
            recorder.write(events)
        for event in events:
            report = decoder.push(event)
            if report is not None:
                contacts = report
                yield report
        if not events and contacts is not None:
            yield contacts._replace(at_s=time.monotonic())


def replay_contacts(recording: FilmRecording) -> Iterator[ContactReport]:
    """Yield the contacts of a recording, and those that stay again, at times since its first event.

    At its end all are lifted.
    """
    contacts: ContactReport | None = None
    for report in decode_contacts(recording.events):
        while contacts is not None and report.at_s - contacts.at_s > REPEAT_S:
            contacts = contacts._replace(at_s=contacts.at_s + REPEAT_S)
            yield contacts
        contacts = report
        yield report
    if contacts is not None:
        yield ContactReport(contacts.at_s + REPEAT_S, ())


def locate_contacts(reports: Iterable[ContactReport], calibration: FilmCalibration) -> Iterator[FingerReport]:
    """Yield the fingertips on the display that make the contacts of a film."""
    for report in reports:
        yield FingerReport(report.at_s, calibration.locate(report.contacts))


TOUCH_MIN_S = 0.2
"""Shortest time of a touch. A shorter contact is the brush of a hand."""


def choose_corner_pixels(layout: PixelLayout) -> tuple[int, ...]:
    """Return the pixels nearest to the corners of a display, around it: one that is nearest to two, once."""
    x_m, y_m = layout.x_m, layout.y_m
    corners_m = [(x_m.min(), y_m.min()), (x_m.max(), y_m.min()), (x_m.max(), y_m.max()), (x_m.min(), y_m.max())]
    nearest = (int(np.hypot(x_m - corner[0], y_m - corner[1]).argmin()) for corner in corners_m)
    return tuple(dict.fromkeys(nearest))


def iterate_touches(reports: Iterable[ContactReport]) -> Iterator[FloatArray]:
    """Yield the middle [2] of every touch on a film when it ends, in units of the film.

    A touch is one contact from its begin to its end, of TOUCH_MIN_S or more, with no other beside it.
    """
    touch: list[tuple[float, Contact]] = []
    is_alone = True
    for report in reports:
        if touch and touch[0][1].number not in {contact.number for contact in report.contacts}:
            if is_alone and report.at_s - touch[0][0] >= TOUCH_MIN_S:
                yield np.median([contact[1:] for _, contact in touch], axis=0)
            touch, is_alone = [], True
        if report.contacts:
            is_alone = is_alone and len(report.contacts) == 1
            touch.append((report.at_s, report.contacts[0]))
