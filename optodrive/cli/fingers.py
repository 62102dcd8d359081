"""`optodrive fingers`: report fingertips to the daemon, from a film, a camera, or a file as a tracker would."""

import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from optodrive.cli.options import UrlOption
from optodrive.core.daemon_url import DEFAULT_URL
from optodrive.core.errors import MISSING, InputError, Unquoted

if TYPE_CHECKING:
    from optodrive.tracking.contacts import ContactReport, FilmAxes
if TYPE_CHECKING:
    from optodrive.core.types.fingers import FingerReport


RecordOption = Annotated[
    Path | None,
    typer.Option("--record", metavar="FILE", help="Record the events of the film's device, to replay them."),
]


@contextmanager
def open_film(path: Path, record: Path | None) -> Iterator[tuple["FilmAxes", Iterator["ContactReport"]]]:
    """Yield the axes of a film and its contacts. Those of a recording come at once, at times from 0."""
    from optodrive.tracking.evdev_film import EvdevFilm, is_device
    from optodrive.tracking.film import FilmRecorder, FilmRecording, follow_contacts, replay_contacts

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


def fingers(
    script: Annotated[
        Path | None, typer.Argument(metavar="[FILE.csv]", help="time_s,number,x_m,y_m,radius_m: a fingertip a row.")
    ] = None,
    film: Annotated[
        Path | None,
        typer.Option("--film", metavar="PATH", help="A multitouch film, /dev/input/event…, or a recording of one."),
    ] = None,
    camera: Annotated[
        str | None,
        typer.Option("--camera", metavar="N|PATH", help="A camera that sees the display's marks, or a video of one."),
    ] = None,
    calibration: Annotated[
        Path | None,
        typer.Option("--calibration", metavar="film.toml", help="Of the film, an output of `calibrate film`."),
    ] = None,
    marks: Annotated[
        Path | None,
        typer.Option("--marks", metavar="marks.toml", help="Where the marks for the camera are on the display."),
    ] = None,
    record: RecordOption = None,
    repeat: Annotated[bool, typer.Option("--repeat", help="Begin again at the end, until Ctrl-C.")] = False,
    url: UrlOption = DEFAULT_URL,
) -> None:
    """Report fingertips, for which standing frames are refreshed first."""
    from optodrive.cli.signals import end_as_interrupted
    from optodrive.client.fingers import read_finger_script

    sources = [
        name for name, given in (("FILE.csv", script), ("--film", film), ("--camera", camera)) if given is not None
    ]
    if len(sources) != 1:
        found = Unquoted(" and ".join(sources)) if sources else MISSING
        raise InputError("FILE.csv, --film or --camera", found, "one source of fingertips")
    for option, path, source in (
        ("--calibration", calibration, "--film"),
        ("--record", record, "--film"),
        ("--marks", marks, "--camera"),
    ):
        if path is not None and source not in sources:
            raise InputError(option, str(path), f"{source} with it")
    with end_as_interrupted():
        if script is not None:
            _send(_pace(read_finger_script(script), repeat), url)
        if film is not None:
            _report_film(film, calibration, record, repeat, url)
        if camera is not None:
            _report_camera(camera, marks, repeat, url)


def _report_film(path: Path, calibration: Path | None, record: Path | None, repeat: bool, url: str) -> None:
    from optodrive.tracking.evdev_film import is_device
    from optodrive.tracking.film import locate_contacts
    from optodrive.tracking.film_calibration import load_film_calibration

    if calibration is None:
        raise InputError("--calibration", MISSING, "film.toml, an output of `optodrive calibrate film`")
    is_live = is_device(path)
    _check_repeat(repeat, is_live)
    with open_film(path, record) as (axes, contacts):
        reports = locate_contacts(contacts, load_film_calibration(calibration, axes))
        _send(reports if is_live else _pace(reports, repeat), url)


def _report_camera(source: str, marks: Path | None, repeat: bool, url: str) -> None:
    from optodrive.tracking.camera import Camera, follow_fingertips
    from optodrive.tracking.fingertips import load_marks

    if marks is None:
        raise InputError("--marks", MISSING, "marks.toml, which states where the marks are")
    content = load_marks(marks)
    with Camera(source) as camera:
        _check_repeat(repeat, camera.is_live)
        reports = follow_fingertips(camera, content)
        _send(reports if camera.is_live else _pace(reports, repeat), url)


def _check_repeat(repeat: bool, is_live: bool) -> None:
    if repeat and is_live:
        raise InputError("--repeat", Unquoted("a device"), "a recording to repeat")


def _pace(reports: Iterable["FingerReport"], repeat: bool) -> Iterator["FingerReport"]:
    """Yield each report at its time since the begin, with this time as the monotonic clock shows it."""
    begin_s, played = time.monotonic(), []
    for report in reports:
        played.append(report)
        yield _wait_for(report, begin_s)
    while repeat:
        begin_s += played[-1].at_s
        for report in played:
            yield _wait_for(report, begin_s)


def _wait_for(report: "FingerReport", begin_s: float) -> "FingerReport":
    due_s = begin_s + report.at_s
    time.sleep(max(0.0, due_s - time.monotonic()))
    return report._replace(at_s=due_s)


def _send(reports: Iterable["FingerReport"], url: str) -> None:
    """Send reports with their ages, until there is no other."""
    from optodrive.client.display import Display
    from optodrive.core.errors import BusyError
    from optodrive.daemon.responses.messages import AGE_MAX_S, FINGERS_MAX

    count, begin_s = 0, time.monotonic()
    with Display(url) as display, display.fingers() as connection:
        for report in reports:
            age_s = max(0.0, time.monotonic() - report.at_s)
            if age_s <= AGE_MAX_S:  # older after a pause of this process: the fingers are elsewhere by now
                try:
                    connection.send(report.places[:FINGERS_MAX], age_s)
                    count += 1
                except BusyError as error:
                    print(f"optodrive: {error}", file=sys.stderr)
    print(f"{count} reports of fingertips in {time.monotonic() - begin_s:.3g} s")
