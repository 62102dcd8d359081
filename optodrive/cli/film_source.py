"""The contacts on a film, from its device or from a recording of it."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from optodrive.core.errors import InputError

if TYPE_CHECKING:
    from optodrive.tracking.contacts import ContactReport
    from optodrive.tracking.input_events import FilmAxes

RecordOption = Annotated[
    Path | None,
    typer.Option("--record", metavar="FILE", help="Record the events of the film's device, to replay them."),
]


@contextmanager
def open_film(path: Path, record: Path | None) -> Iterator[tuple["FilmAxes", Iterator["ContactReport"]]]:
    """Yield the axes of a film and its contacts. Those of a recording come at once, at times from 0."""
    from optodrive.tracking.evdev_film import EvdevFilm, is_device
    from optodrive.tracking.film import follow_contacts, replay_contacts
    from optodrive.tracking.film_recording import FilmRecorder, FilmRecording

    if not is_device(path):
        if record is not None:
            raise InputError("--record", str(record), "a film's device to record, not a recording")
        recording = FilmRecording(path)
        yield recording.axes, replay_contacts(recording)
        return
    with ExitStack() as stack:
        film = stack.enter_context(EvdevFilm(path))
        recorder = None if record is None else stack.enter_context(FilmRecorder(record, film.axes))
        yield film.axes, follow_contacts(film, recorder)
