"""Fingertips from a multitouch film, and touches at known pixels, of which its calibration is made."""

import time
from collections.abc import Iterable, Iterator

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.fingers import FingerReport
from optodrive.device.config import PixelLayout
from optodrive.tracking.contacts import Contact, ContactDecoder, ContactReport, decode_contacts
from optodrive.tracking.evdev_film import EvdevFilm
from optodrive.tracking.film_calibration import FilmCalibration
from optodrive.tracking.film_recording import FilmRecorder, FilmRecording

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
