"""Fingertips from a multitouch film."""

import time
from collections.abc import Iterable, Iterator

from optodrive.core.types.fingers import FingerReport
from optodrive.tracking.contacts import ContactDecoder, ContactReport, decode_contacts
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
