"""Recordings of a whole display grouped by pixel.

A worker reads the runs of a pixel where it diagnoses them. A pixel gets the runs in which it was measured, with the
whole drive of each run. Light on a pixel in a run that did not measure it is unknown to that pixel. Mirror signals
belong to no pixel and form a group of their own.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from optodrive.core.errors import InputError, Unquoted
from optodrive.core.types.measurements import MIRRORS, Measurement, Run
from optodrive.lab.recording import checks
from optodrive.lab.recording.index import RecordingIndex
from optodrive.lab.recording.reader import read_runs
from optodrive.lab.recording.storage import MIRROR_SIGNALS

FileStamp = tuple[int, int]


@dataclass(frozen=True)
class RecordingPart:
    """Some runs of one recording.

    prefix: precedes the run names where several recordings are joined; stamp: of the file when it was probed
    """

    path: Path
    prefix: str
    names: tuple[str, ...]
    stamp: FileStamp | None


@dataclass(frozen=True)
class PixelRuns:
    """References to the runs of one pixel, small enough to be sent to a worker.

    pixel: `MIRRORS` for the mirrors
    """

    pixel: int
    parts: tuple[RecordingPart, ...]

    def read(self) -> Measurement:
        """Read the runs with this pixel's signals only. Raise InputError if the data are invalid."""
        runs = [self._select_signals(part, run) for part in self.parts for run in _read_part(part)]
        values = [signal.value for run in runs for signal in run.signals.values()]
        subject = "mirrors" if self.pixel == MIRRORS else f"pixel {self.pixel}"
        checks.check_sample_count(
            f"{self.parts[0].path}: {subject}", sum(int(np.isfinite(value).sum()) for value in values)
        )
        return Measurement(tuple(runs))

    def _select_signals(self, part: RecordingPart, run: Run) -> Run:
        signals = {
            name: signal
            for name, signal in run.signals.items()
            if self.pixel == (MIRRORS if name in MIRROR_SIGNALS else signal.pixel)
        }
        return replace(run, name=f"{part.prefix}{run.name}", signals=signals)


@dataclass(frozen=True)
class DisplayRuns:
    """Recordings of one display: runs per pixel, sorted by pixel, and the runs with mirror signals."""

    pixels: tuple[PixelRuns, ...]
    mirrors: PixelRuns | None

    @classmethod
    def open(cls, paths: list[Path]) -> "DisplayRuns":
        """Index recordings without reading samples. Raise InputError if a path is not a recording."""
        pixels: dict[int, list[RecordingPart]] = {}
        mirrors: list[RecordingPart] = []
        for path in paths:
            stamp = _stat_file(path)
            index = RecordingIndex.open(path)
            prefix = f"{path.stem}/" if len(paths) > 1 else ""
            for pixel, names in index.group_runs_by_pixel().items():
                pixels.setdefault(pixel, []).append(RecordingPart(path.absolute(), prefix, names, stamp))
            mirror_runs = tuple(run.name for run in index.runs if not set(MIRROR_SIGNALS).isdisjoint(run.signals))
            if mirror_runs:
                mirrors.append(RecordingPart(path.absolute(), prefix, mirror_runs, stamp))
        return cls(
            tuple(PixelRuns(pixel, tuple(pixels[pixel])) for pixel in sorted(pixels)),
            PixelRuns(MIRRORS, tuple(mirrors)) if mirrors else None,
        )


def _read_part(part: RecordingPart) -> tuple[Run, ...]:
    """Read the runs of a part. A file that was probed once is trusted while its stamp is unchanged."""
    if part.stamp is not None and part.path.is_file() and _stat_file(part.path) != part.stamp:
        raise InputError(str(part.path), Unquoted("a changed file"), "the file as it was when the diagnosis began")
    return read_runs(part.path, list(part.names), trusted=part.stamp is not None).runs


def _stat_file(path: Path) -> FileStamp | None:
    """Return size and modification time of a file, or None for a folder, which is not probed."""
    if not path.is_file():
        return None
    status = path.stat()
    return status.st_size, status.st_mtime_ns
