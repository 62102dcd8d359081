"""`optodrive fingers`: report fingertips to the daemon, from a film, or from a file as a tracker would."""

import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from optodrive.cli.film_source import RecordOption, open_film
from optodrive.cli.options import UrlOption
from optodrive.core.daemon_url import DEFAULT_URL
from optodrive.core.errors import MISSING, InputError, Unquoted

if TYPE_CHECKING:
    from optodrive.core.types.fingers import FingerReport


def fingers(
    script: Annotated[
        Path | None, typer.Argument(metavar="[FILE.csv]", help="time_s,number,x_m,y_m,radius_m: a fingertip a row.")
    ] = None,
    film: Annotated[
        Path | None,
        typer.Option("--film", metavar="PATH", help="A multitouch film, /dev/input/event…, or a recording of one."),
    ] = None,
    calibration: Annotated[
        Path | None,
        typer.Option("--calibration", metavar="film.toml", help="Of the film, an output of `calibrate film`."),
    ] = None,
    record: RecordOption = None,
    repeat: Annotated[bool, typer.Option("--repeat", help="Begin again at the end, until Ctrl-C.")] = False,
    url: UrlOption = DEFAULT_URL,
) -> None:
    """Report fingertips, for which standing frames are refreshed first."""
    from optodrive.cli.signals import end_as_interrupted
    from optodrive.client.finger_script import read_finger_script

    if (script is None) == (film is None):
        found = MISSING if film is None else Unquoted("both")
        raise InputError("FILE.csv or --film", found, "one source of fingertips")
    for option, path in (("--calibration", calibration), ("--record", record)):
        if film is None and path is not None:
            raise InputError(option, str(path), "--film with it")
    with end_as_interrupted():
        if script is not None:
            _send(_pace(read_finger_script(script), repeat), url)
        if film is not None:
            _report_film(film, calibration, record, repeat, url)


def _report_film(path: Path, calibration: Path | None, record: Path | None, repeat: bool, url: str) -> None:
    from optodrive.tracking.evdev_film import is_device
    from optodrive.tracking.film import locate_contacts
    from optodrive.tracking.film_calibration import load_film_calibration

    if calibration is None:
        raise InputError("--calibration", MISSING, "film.toml, an output of `optodrive calibrate film`")
    is_live = is_device(path)
    if is_live and repeat:
        raise InputError("--repeat", Unquoted("a device"), "a recording to repeat")
    with open_film(path, record) as (axes, contacts):
        reports = locate_contacts(contacts, load_film_calibration(calibration, axes))
        _send(reports if is_live else _pace(list(reports), repeat), url)


def _pace(reports: list["FingerReport"], repeat: bool) -> Iterator["FingerReport"]:
    """Yield each report at its time since the begin, with this time as the monotonic clock shows it."""
    begin_s = time.monotonic()
    while True:
        for report in reports:
            due_s = begin_s + report.at_s
            time.sleep(max(0.0, due_s - time.monotonic()))
            yield report._replace(at_s=due_s)
        if not repeat:
            return
        begin_s += reports[-1].at_s


def _send(reports: Iterable["FingerReport"], url: str) -> None:
    """Send reports with their ages, until there is no other."""
    from optodrive.client.display import Display
    from optodrive.daemon.responses.fingers import AGE_MAX_S, FINGERS_MAX

    count, begin_s = 0, time.monotonic()
    with Display(url) as display, display.fingers() as connection:
        for report in reports:
            age_s = max(0.0, time.monotonic() - report.at_s)
            if age_s <= AGE_MAX_S:  # older after a pause of this process: the fingers are elsewhere by now
                connection.send(report.places[:FINGERS_MAX], age_s)
                count += 1
    print(f"{count} reports of fingertips in {time.monotonic() - begin_s:.3g} s")
