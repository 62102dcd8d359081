"""What a recording holds, without its samples: whole displays are read pixel by pixel."""

from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from optodrive.core.types.measurements import Measurement
from optodrive.lab.recording import checks
from optodrive.lab.recording.reader import open_head, open_tree, read_pulses, read_runs, read_signal_attributes
from optodrive.lab.recording.storage import COMMANDS, MIRRORS, Attributes, Tree, refusing


@dataclass(frozen=True)
class SignalIndex:
    """One signal of a run. samples: how many, missing ones counted; sigma: stated noise."""

    pixel: int
    samples: int
    sigma: float | None


@dataclass(frozen=True)
class RunIndex:
    """One run. lit: pixels with a pulse, sorted; pulses: how many; signals: by the format's names."""

    name: str
    ambient_k: float
    attributes: Attributes
    lit: tuple[int, ...]
    pulses: int
    has_commands: bool
    signals: dict[str, SignalIndex]

    @property
    def measured(self) -> tuple[int, ...]:
        """Pixels measured in this run, sorted."""
        return tuple(sorted({signal.pixel for name, signal in self.signals.items() if name not in MIRRORS}))


@dataclass(frozen=True)
class RecordingIndex:
    """What a recording holds; the samples stay where they are until `read` asks for them."""

    path: Path
    instrument_notes: str
    runs: tuple[RunIndex, ...]

    @classmethod
    def open(cls, path: Path) -> Self:
        """Look into a recording; InputError where it is not one, as far as that shows without its samples."""
        with open_tree(path) as tree, refusing(str(path), "a recording that can be read"):
            names, notes = open_head(tree)
            return cls(path, notes, tuple(_run_index(tree, name) for name in names))

    def by_pixel(self) -> dict[int, tuple[str, ...]]:
        """Names of the runs that measured each pixel, in their order; pixels sorted."""
        found: dict[int, list[str]] = {}
        for run in self.runs:
            for pixel in run.measured:
                found.setdefault(pixel, []).append(run.name)
        return {pixel: tuple(found[pixel]) for pixel in sorted(found)}

    def read(self, names: list[str]) -> Measurement:
        """Read these runs."""
        return read_runs(self.path, names)


def _run_index(tree: Tree, name: str) -> RunIndex:
    where = tree.where(name)
    attributes = tree.attributes(name)
    ambient_k = checks.take_ambient_k(where, attributes)
    members = tree.members(name)
    signals = {signal: _signal_index(tree, name, signal) for signal in checks.signals_among(where, members)}
    pulses = read_pulses(tree, name)
    lit = tuple(int(pixel) for pixel in np.unique(pulses[:, 3]))
    return RunIndex(name, ambient_k, attributes, lit, len(pulses), COMMANDS in members, signals)


def _signal_index(tree: Tree, run: str, signal: str) -> SignalIndex:
    pixel, sigma = read_signal_attributes(tree, run, signal)
    return SignalIndex(pixel, tree.sample_count(run, signal), sigma)
