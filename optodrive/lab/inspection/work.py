"""Recording under inspection, with the edits of its signals and their texts."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any, TypeVar, cast

import numpy as np

from optodrive.core.quantity import format_quantity, list_names
from optodrive.core.types.arrays import BoolArray, FloatArray
from optodrive.core.types.measurements import DataFinding, Measurement, Run, Signal

Known = TypeVar("Known")


@dataclass(frozen=True, eq=False)
class Edit:
    """One signal of one run that is replaced, or left out if there is no replacement.

    values: that it concerns; kept: number of these that stay
    """

    run: int
    name: str
    replacement: Signal | None
    values: FloatArray
    kept: int = 0


Found = Iterator[tuple[list[Edit], str] | DataFinding]
"""Edits of one signal with what is wrong in words, and facts."""


@dataclass(frozen=True)
class Step:
    """One search. find: yields faults and facts of one kind of signal, or of all with an empty name."""

    kind: str
    find: Callable[["Work", str], Found]
    is_joint: bool = False


class Work:
    """Runs under inspection, whose signals the edits of the steps replace."""

    def __init__(self, measurement: Measurement) -> None:
        self.runs: tuple[Run, ...] = measurement.runs
        numbered = ((number, *item) for number, run in enumerate(self.runs) for item in run.signals.items())
        self.signals = {(number, name): signal for number, name, signal in numbered}
        self._known: dict[object, Any] = {}
        self._repeats: dict[int, list[int]] = {}

    @property
    def names(self) -> list[str]:
        """Names of the signals that are left."""
        return list(dict.fromkeys(name for _, name in self.signals))

    def list_signals(self, name: str) -> list[tuple[int, Signal]]:
        """Return the runs that have a signal, and the signal."""
        return [(run, signal) for (run, own), signal in self.signals.items() if own == name]

    def list_finite(self, name: str) -> list[tuple[int, FloatArray, FloatArray]]:
        """Return the runs that have a signal, and the times and values of its finite samples."""
        return [(run, *select_finite(signal)) for run, signal in self.list_signals(name)]

    def list_runs(self, runs: Iterable[int]) -> str:
        """Return the names of runs as text."""
        return list_names([self.runs[run].name for run in runs])

    def drop(self, name: str, runs: Iterable[int]) -> list[Edit]:
        """Return the edits that leave a signal of these runs out."""
        return [Edit(run, name, None, select_finite(self.signals[run, name])[1]) for run in runs]

    def remove(self, name: str, found: Iterable[tuple[int, BoolArray]]) -> list[Edit]:
        """Return the edits that make samples missing, by run which of its finite ones are bad."""
        edits = []
        for run, is_bad in found:
            if is_bad.any():
                signal = self.signals[run, name]
                rows = np.flatnonzero(np.isfinite(signal.value))[is_bad]
                value = signal.value.copy()
                value[rows] = np.nan
                edits.append(Edit(run, name, replace(signal, value=value), signal.value[rows]))
        return edits

    def apply(self, edits: list[Edit]) -> None:
        """Replace or remove signals."""
        if edits:
            self._known.clear()
        for edit in edits:
            if edit.replacement is None:
                self.signals.pop((edit.run, edit.name), None)
            else:
                self.signals[edit.run, edit.name] = edit.replacement

    def remember(self, key: object, compute: Callable[[], Known]) -> Known:
        """Return the value under this key, computed once from the present signals."""
        if key not in self._known:
            self._known[key] = compute()
        return cast("Known", self._known[key])

    def build(self) -> Measurement:
        """Return the recording as it is left. Runs without signals stay, for their light."""
        runs = []
        for n, run in enumerate(self.runs):
            signals = {name: self.signals[n, name] for name in run.signals if (n, name) in self.signals}
            runs.append(replace(run, signals=signals))
        return Measurement(tuple(runs))

    def find_repeats(self, run: int) -> list[int]:
        """Return the other runs of a run's group that measure its pixels, or with equal light if it states none."""
        if run not in self._repeats:
            self._repeats[run] = self._list_repeats(run)
        return self._repeats[run]

    def _list_repeats(self, run: int) -> list[int]:
        own = self.runs[run]
        group = own.attributes.get("group")

        def is_repeat(other: Run) -> bool:
            if group is not None:
                return other.attributes.get("group") == group
            is_same = other.pulses.shape == own.pulses.shape and np.allclose(other.pulses, own.pulses, 1e-6, 1e-6)
            is_grouped = other.attributes.get("group") is not None
            return not is_grouped and is_same and (other.commands is None) == (own.commands is None)

        others = ((number, other) for number, other in enumerate(self.runs) if number != run)
        return [number for number, other in others if is_repeat(other) and measures_alike(own, other)]


def measures_alike(own: Run, other: Run) -> bool:
    """Return whether signals of one name are of one pixel in both runs: one train of light drives many pixels."""
    return all(signal.pixel == own.signals[name].pixel for name, signal in other.signals.items() if name in own.signals)


def select_finite(signal: Signal) -> tuple[FloatArray, FloatArray]:
    """Return times and values of the finite samples."""
    is_finite = np.isfinite(signal.value)
    return signal.t_s[is_finite], signal.value[is_finite]


def find_unit(name: str) -> str:
    """Return the unit in a signal's name."""
    return name.rsplit("_", 1)[1]


def count_samples(edits: list[Edit]) -> int:
    """Return the number of samples that are left out."""
    return sum(len(item.values) - item.kept for item in edits)


def describe_extent(edits: list[Edit]) -> str:
    """Return the number of samples that are left out, and that of their runs, as text."""
    return f"{count(count_samples(edits), 'sample')} of {count(len(edits), 'run')}"


def count(number: int, noun: str) -> str:
    """Return a number with its noun."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def format_span(values: FloatArray, unit: str) -> str:
    """Return smallest and largest value with the unit, or the one value."""
    low, high = (format_quantity(float(item), unit) for item in (values.min(), values.max()))
    return low if low == high else f"{low} to {high}"
