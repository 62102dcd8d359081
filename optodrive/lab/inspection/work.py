"""Recording under inspection, with the edits of its signals and their texts."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeVar, cast

import numpy as np

from optodrive.core.quantity import format_quantity
from optodrive.core.types.arrays import BoolArray, FloatArray
from optodrive.core.types.measurements import DataFinding, Measurement, Run, Signal

MAX_NAMES = 4
Known = TypeVar("Known")


@dataclass(frozen=True, eq=False)
class Edit:
    """One signal of one run that is replaced, or left out if there is no replacement.

    samples: number left out; values: some of them
    """

    run: int
    name: str
    replacement: Signal | None
    samples: int
    values: FloatArray


Found = tuple[list[Edit], list[DataFinding]]


@dataclass(frozen=True)
class Step:
    """One search. find: returns edits and findings of one kind of signal, or of all with an empty name."""

    kind: str
    find: Callable[["Work", str], Found]
    is_joint: bool = False


class Work:
    """Runs under inspection, whose signals the edits of the steps replace."""

    def __init__(self, measurement: Measurement) -> None:
        self.runs: tuple[Run, ...] = measurement.runs
        self.signals = {
            (number, name): signal for number, run in enumerate(self.runs) for name, signal in run.signals.items()
        }
        self._known: dict[object, Any] = {}
        self._repeats: dict[int, list[int]] = {}

    @property
    def names(self) -> list[str]:
        """Names of the signals that are left."""
        return list(dict.fromkeys(name for _, name in self.signals))

    def list_signals(self, name: str) -> list[tuple[int, Signal]]:
        """Return the runs that have a signal, and the signal."""
        return [(run, signal) for (run, own), signal in self.signals.items() if own == name]

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
        return Measurement(
            tuple(
                replace(run, signals={name: self.signals[n, name] for name in run.signals if (n, name) in self.signals})
                for n, run in enumerate(self.runs)
            )
        )

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
            return (
                other.attributes.get("group") is None and is_same and (other.commands is None) == (own.commands is None)
            )

        return [
            number
            for number, other in enumerate(self.runs)
            if number != run and is_repeat(other) and measures_alike(own, other)
        ]


def measures_alike(own: Run, other: Run) -> bool:
    """Return whether signals of one name are of one pixel in both runs: one train of light drives many pixels."""
    return all(signal.pixel == own.signals[name].pixel for name, signal in other.signals.items() if name in own.signals)


def select_finite(signal: Signal) -> tuple[BoolArray, FloatArray, FloatArray]:
    """Return which samples are finite, and their times and values."""
    is_finite = np.isfinite(signal.value)
    return is_finite, signal.t_s[is_finite], signal.value[is_finite]


def remove_samples(run: int, name: str, signal: Signal, is_bad: BoolArray) -> Edit:
    """Return the edit that makes finite samples missing.

    is_bad: of the finite samples
    """
    rows = np.flatnonzero(np.isfinite(signal.value))[is_bad]
    value = signal.value.copy()
    value[rows] = np.nan
    return Edit(run, name, replace(signal, value=value), len(rows), signal.value[rows])


def drop_signal(run: int, name: str, signal: Signal) -> Edit:
    """Return the edit that leaves a signal out."""
    finite = signal.value[np.isfinite(signal.value)]
    return Edit(run, name, None, len(finite), finite)


def describe(work: Work, kind: str, name: str, edits: list[Edit], text: str, action: str = "left out") -> DataFinding:
    """Return the finding of edits, with the action at the end of its text."""
    runs = tuple(dict.fromkeys(work.runs[item.run].name for item in edits))
    samples = sum(item.samples for item in edits)
    numbers: dict[str, tuple[float, str]] = {}
    values = [item.values for item in edits if len(item.values)]
    if name and values:
        low, high = (float(pick([pick(item) for item in values])) for pick in (np.min, np.max))
        numbers = {"lowest": (low, find_unit(name)), "highest": (high, find_unit(name))}
    end = "; left out." if action == "left out" else "."
    return DataFinding(runs, name, kind, f"{text}{end}", action, samples, numbers)


def find_unit(name: str) -> str:
    """Return the unit in a signal's name."""
    return name.rsplit("_", 1)[1]


def list_names(names: tuple[str, ...] | list[str], max_names: int = MAX_NAMES) -> str:
    """Return names as text, the first ones of many."""
    shown = ", ".join(names[:max_names])
    return shown if len(names) <= max_names else f"{shown} and {len(names) - max_names} more"


def count(number: int, noun: str) -> str:
    """Return a number with its noun."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def format_span(values: FloatArray, unit: str) -> str:
    """Return smallest and largest value with the unit, or the one value."""
    low, high = (format_quantity(float(item), unit) for item in (values.min(), values.max()))
    return low if low == high else f"{low} to {high}"
