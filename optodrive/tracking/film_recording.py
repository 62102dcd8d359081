"""Recordings of a film in the text format of evemu: lines of its axes, and a line for each event.

`evemu-record` writes the same lines and more. A recording of its own does not state the slots again where the kernel
has dropped events, and its contacts then remain unknown until their slots are named.
"""

from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path
from typing import Self

from optodrive.core.errors import InputError, Unquoted
from optodrive.core.files import read_regular_file
from optodrive.tracking.contacts import decode_contacts
from optodrive.tracking.input_events import (
    ABS_MT_POSITION_X,
    ABS_MT_POSITION_Y,
    ABS_MT_SLOT,
    FilmAxes,
    FilmAxis,
    InputEvent,
)

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
        try:
            self._file = path.open("x", encoding="utf-8")
        except OSError as error:
            raise InputError(str(path), error.strerror or str(error), "a new file that can be written") from None
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
