"""A whole display's recordings, pixel by pixel: which runs each pixel needs, read only where they are wanted.

A run goes to the pixels it measured, with its whole drive; light on a pixel in a run that did not measure it is not
known to that pixel. What mirrors did belongs to no pixel and is kept apart.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.types.measurements import Measurement, Run
from optodrive.lab.recording import checks
from optodrive.lab.recording.index import RecordingIndex
from optodrive.lab.recording.reader import read_runs
from optodrive.lab.recording.storage import MIRROR_SIGNALS, Unquoted

FileStamp = tuple[int, int]


@dataclass(frozen=True)
class RecordingPart:
    """Runs of one recording. prefix: before their names, where several are joined; stamp: of the file as tried out."""

    path: Path
    prefix: str
    names: tuple[str, ...]
    stamp: FileStamp | None


@dataclass(frozen=True)
class PixelRuns:
    """Where one pixel's runs lie; pixel: None for what mirrors did. Small: it travels to whoever reads them."""

    pixel: int | None
    parts: tuple[RecordingPart, ...]

    def read(self) -> Measurement:
        """These runs, with this pixel's signals and no others; InputError where the data are bad."""
        runs = [self._select_signals(part, run) for part in self.parts for run in _read_part(part)]
        values = [signal.value for run in runs for signal in run.signals.values()]
        subject = "mirrors" if self.pixel is None else f"pixel {self.pixel}"
        checks.check_sample_count(
            f"{self.parts[0].path}: {subject}", sum(int(np.isfinite(value).sum()) for value in values)
        )
        return Measurement(tuple(runs))

    def _select_signals(self, part: RecordingPart, run: Run) -> Run:
        own = {
            name: signal
            for name, signal in run.signals.items()
            if (
                name in MIRROR_SIGNALS
                if self.pixel is None
                else name not in MIRROR_SIGNALS and signal.pixel == self.pixel
            )
        }
        return replace(run, name=f"{part.prefix}{run.name}", signals=own)


@dataclass(frozen=True)
class DisplayRuns:
    """Recordings of one display: the runs of each pixel, pixels sorted, and of the mirrors where they were measured."""

    pixels: tuple[PixelRuns, ...]
    mirrors: PixelRuns | None

    @classmethod
    def open(cls, paths: list[Path]) -> "DisplayRuns":
        """Look into recordings, without their samples; InputError where one is none."""
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
            PixelRuns(None, tuple(mirrors)) if mirrors else None,
        )


def _read_part(part: RecordingPart) -> tuple[Run, ...]:
    """What was tried out once when the recording was opened is trusted for as long as the file stays as it was."""
    if part.stamp is not None and part.path.is_file() and _stat_file(part.path) != part.stamp:
        raise InputError(str(part.path), Unquoted("another file"), "the file that was there when the diagnosis began")
    return read_runs(part.path, list(part.names), trusted=part.stamp is not None).runs


def _stat_file(path: Path) -> FileStamp | None:
    """Size and time of a file; None for a folder, which needs no trial."""
    if not path.is_file():
        return None
    status = path.stat()
    return status.st_size, status.st_mtime_ns
