"""Reading and complete checking of recordings in either form: whole, by runs, by pixels, or without their samples.

A worker reads the runs of a pixel where it diagnoses them. A pixel gets the runs in which it was measured, with the
whole drive of each run. Light on a pixel in a run that did not measure it is unknown to that pixel. Mirror signals
belong to no pixel and form a group of their own.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np

from optodrive.core.errors import InputError, Unquoted, suggest_nearest
from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.measurements import MIRRORS, Measurement, Run, Signal
from optodrive.lab.recording import checks
from optodrive.lab.recording.csv_folder import CsvTree
from optodrive.lab.recording.hdf5 import Hdf5Tree, import_h5py, probe_in_sandbox
from optodrive.lab.recording.storage import (
    COMMANDS,
    MIRROR_SIGNALS,
    PULSES,
    SIGNALS,
    Attributes,
    RecordingTree,
    check_run_name,
    convert_errors,
    natural_sort_key,
)

FileStamp = tuple[int, int]


def read_recording(path: Path) -> Measurement:
    """Read a recording. Raise InputError with file, run, signal and expectation if it is invalid."""
    return read_with_notes(path)[0]


def read_with_notes(path: Path) -> tuple[Measurement, str]:
    """Return a recording and its notes on the instruments."""
    with open_tree(path) as tree, convert_errors(str(path), "a readable recording"):
        names, instrument_notes = read_header(tree)
        measurement = Measurement(tuple(_read_run(tree, name) for name in names))
        checks.check_sample_count(tree.format_place(), measurement.runs)
        return measurement, instrument_notes


def read_runs(path: Path, names: list[str], trusted: bool = False) -> Measurement:
    """Read only the named runs, in this order.

    trusted: the file has been probed already
    """
    with open_tree(path, trusted) as tree, convert_errors(str(path), "a readable recording"):
        known, _ = read_header(tree)
        for name in names:
            if name not in known:
                raise InputError(tree.format_place(), name, f"a run of this recording, {suggest_nearest(name, known)}")
        return Measurement(tuple(_read_run(tree, name) for name in names))


def open_tree(path: Path, trusted: bool = False) -> RecordingTree:
    """Open a recording in either form.

    trusted: skip the probe of an HDF5 file in a sandboxed process
    """
    path = Path(path)
    with convert_errors(str(path), "a recording: an HDF5 file or a folder"):
        if path.is_dir():
            return CsvTree(path)
        if path.is_file():
            import_h5py()
            if not trusted:
                probe_in_sandbox(path)
            return Hdf5Tree(path)
        description = "neither file nor folder" if path.exists() else "no file of this name"
        raise InputError(str(path), Unquoted(description), "a recording: an HDF5 file or a folder")


def read_header(tree: RecordingTree) -> tuple[list[str], str]:
    """Check format and version. Return the run names in natural order and the notes on the instruments."""
    head = tree.read_attributes()
    checks.check_format(tree.format_place(), head)
    names = tree.list_runs()
    if not names:
        raise InputError(tree.format_place(), Unquoted("no runs"), "at least one")
    for name in names:
        check_run_name(tree.format_place(), name)
    return sorted(names, key=natural_sort_key), str(head.get("instrument_notes", ""))


def read_pulses(tree: RecordingTree, run: str) -> FloatArray:
    """Return the checked pulses of a run."""
    pulses = tree.read_table(run, PULSES)
    checks.check_pulses(tree.format_place(run, PULSES), pulses)
    return pulses


def _read_drive(tree: RecordingTree, name: str, measured: bool = True) -> tuple[Run, list[str], bool]:
    """Return a run with attributes and pulses alone, the names of its signals, and whether it has commands.

    measured: False for a run of a session, which has no signals
    """
    place = tree.format_place(name)
    attributes = tree.read_attributes(name)
    ambient_k = checks.pop_ambient_k(place, attributes)
    members = tree.list_members(name) if measured else []
    signals = checks.select_signals(place, members) if measured else []
    return Run(name, ambient_k, read_pulses(tree, name), {}, attributes), signals, COMMANDS in members


def _read_run(tree: RecordingTree, name: str) -> Run:
    run, names, has_commands = _read_drive(tree, name)
    commands = None
    if has_commands:
        commands = tree.read_table(name, COMMANDS)
        checks.check_commands(tree.format_place(name, COMMANDS), commands)
    return replace(run, signals={signal: _read_signal(tree, name, signal) for signal in names}, commands=commands)


def read_signal_attributes(tree: RecordingTree, run: str, signal: str) -> tuple[int, float | None]:
    """Return the checked pixel and stated noise of a signal."""
    place = tree.format_place(run, signal)
    attributes = tree.read_attributes(run, signal)
    checks.check_names(place, attributes, checks.SIGNAL_ATTRIBUTES)
    checks.check_unit(place, signal, attributes)
    return checks.parse_pixel(place, signal, attributes), checks.parse_sigma(place, attributes)


def _read_signal(tree: RecordingTree, run: str, signal: str) -> Signal:
    pixel, sigma = read_signal_attributes(tree, run, signal)
    t_s, value = tree.read_samples(run, signal)
    checks.check_samples(tree.format_place(run, signal), t_s, value)
    return Signal(pixel, t_s, value, sigma)


@dataclass(frozen=True)
class SignalIndex:
    """One signal of a run.

    sample_count: includes missing samples
    sigma: the stated noise
    """

    pixel: int
    sample_count: int
    sigma: float | None


@dataclass(frozen=True)
class RunIndex:
    """One run.

    pulsed_pixels: pixels with a pulse, sorted
    signals: by the format's names
    """

    name: str
    ambient_k: float
    attributes: Attributes
    pulsed_pixels: tuple[int, ...]
    pulse_count: int
    has_commands: bool
    signals: dict[str, SignalIndex]

    @property
    def measured_pixels(self) -> tuple[int, ...]:
        """Pixels measured in this run, sorted."""
        return tuple(sorted({signal.pixel for name, signal in self.signals.items() if name not in MIRROR_SIGNALS}))


@dataclass(frozen=True)
class RecordingIndex:
    """Index of a recording. `read` reads the samples of selected runs."""

    path: Path
    instrument_notes: str
    runs: tuple[RunIndex, ...]

    @classmethod
    def open(cls, path: Path) -> Self:
        """Index a recording. Raise InputError if it is invalid, as far as that shows without its samples."""
        with open_tree(path) as tree, convert_errors(str(path), "a recording that can be read"):
            names, notes = read_header(tree)
            return cls(path, notes, tuple(_build_run_index(tree, name) for name in names))

    def group_runs_by_pixel(self) -> dict[int, tuple[str, ...]]:
        """Return the names of the runs that measured each pixel, in order, keyed by pixel in ascending order."""
        by_pixel: dict[int, list[str]] = {}
        for run in self.runs:
            for pixel in run.measured_pixels:
                by_pixel.setdefault(pixel, []).append(run.name)
        return {pixel: tuple(by_pixel[pixel]) for pixel in sorted(by_pixel)}

    def read(self, names: list[str]) -> Measurement:
        """Read the named runs."""
        return read_runs(self.path, names)


def _build_run_index(tree: RecordingTree, name: str) -> RunIndex:
    run, names, has_commands = _read_drive(tree, name)
    signals = {}
    for signal in names:
        pixel, sigma = read_signal_attributes(tree, name, signal)
        signals[signal] = SignalIndex(pixel, tree.count_samples(name, signal), sigma)
    pulsed = tuple(np.unique(run.pulses[:, 3]).astype(int).tolist())
    return RunIndex(name, run.ambient_k, run.attributes, pulsed, len(run.pulses), has_commands, signals)


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
        subject = "mirrors" if self.pixel == MIRRORS else f"pixel {self.pixel}"
        checks.check_sample_count(f"{self.parts[0].path}: {subject}", runs)
        return Measurement(tuple(runs))

    def _select_signals(self, part: RecordingPart, run: Run) -> Run:
        pixels = {name: MIRRORS if name in MIRROR_SIGNALS else signal.pixel for name, signal in run.signals.items()}
        signals = {name: signal for name, signal in run.signals.items() if pixels[name] == self.pixel}
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
        runs = tuple(PixelRuns(pixel, tuple(pixels[pixel])) for pixel in sorted(pixels))
        return cls(runs, PixelRuns(MIRRORS, tuple(mirrors)) if mirrors else None)


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


def merge_session(session: Path, measured: Path, shift_s: float = 0.0) -> Measurement:
    """Return the measured runs with the pulses of the session's runs of the same name.

    measured: a recording whose runs have no pulses; shift_s: added to its times. Session runs without a measurement are
    omitted. Raises InputError that names run and file if the two do not match.
    """
    session_runs = _read_session_runs(session)
    measurement = read_recording(measured)
    return Measurement(tuple(_merge_run(run, session_runs, session, measured, shift_s) for run in measurement.runs))


def read_recording_or_session(path: Path) -> tuple[Measurement, bool]:
    """Read a recording, or a session's runs, which have pulses and no signals. Return also whether it is a session."""
    with open_tree(path) as tree, convert_errors(str(path), "a readable recording"):
        names, _ = read_header(tree)
        is_session = not any(name in SIGNALS for run in names for name in tree.list_members(run))
    if not is_session:
        return read_recording(path), False
    return Measurement(tuple(_read_session_runs(path).values())), True


def _read_session_runs(session: Path) -> dict[str, Run]:
    """Read the runs of a session, which have no signals."""
    with open_tree(session) as tree, convert_errors(str(session), "a session's recording"):
        return {name: _read_drive(tree, name, measured=False)[0] for name in read_header(tree)[0]}


def _merge_run(run: Run, session_runs: dict[str, Run], session: Path, measured: Path, shift_s: float) -> Run:
    place = f"{measured}: /runs/{run.name}"
    session_run = session_runs.get(run.name)
    if session_run is None:
        raise InputError(place, run.name, f"a run of {session}, {suggest_nearest(run.name, list(session_runs))}")
    if len(run.pulses):
        expected = f"none: the pulses are taken from {session}"
        raise InputError(f"{place}/{PULSES}", Unquoted(f"{len(run.pulses)} pulses"), expected)
    signals = {name: replace(signal, t_s=np.asarray(signal.t_s + shift_s)) for name, signal in run.signals.items()}
    attributes = run.attributes | session_run.attributes
    return replace(run, pulses=session_run.pulses, signals=signals, attributes=attributes)
