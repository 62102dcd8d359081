"""Index of a recording: names, attributes and counts, without samples."""

from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from optodrive.core.types.measurements import Measurement
from optodrive.lab.recording import checks
from optodrive.lab.recording.reader import open_tree, read_header, read_pulses, read_runs, read_signal_attributes
from optodrive.lab.recording.storage import COMMANDS, MIRROR_SIGNALS, Attributes, RecordingTree, convert_errors


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
    place = tree.format_place(name)
    attributes = tree.read_run_attributes(name)
    ambient_k = checks.pop_ambient_k(place, attributes)
    members = tree.list_members(name)
    signals = {signal: _build_signal_index(tree, name, signal) for signal in checks.select_signals(place, members)}
    pulses = read_pulses(tree, name)
    pulsed_pixels = tuple(int(pixel) for pixel in np.unique(pulses[:, 3]))
    return RunIndex(name, ambient_k, attributes, pulsed_pixels, len(pulses), COMMANDS in members, signals)


def _build_signal_index(tree: RecordingTree, run: str, signal: str) -> SignalIndex:
    pixel, sigma = read_signal_attributes(tree, run, signal)
    return SignalIndex(pixel, tree.count_samples(run, signal), sigma)
