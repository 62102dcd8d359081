"""The recording as one HDF5 file."""

from contextlib import suppress
from math import prod
from pathlib import Path
from typing import Any, Self

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.measurements import Run
from optodrive.lab.recording.sandboxed_probe import try_out
from optodrive.lab.recording.storage import (
    COMMANDS,
    FORMAT,
    NUMBERS_MAX,
    PULSES,
    SAMPLES,
    SIGNALS,
    TABLES,
    TEXT_MAX,
    VERSION,
    Attributes,
    Room,
    Words,
    plain_attributes,
    refusing,
)


def h5py_module() -> Any:
    """The library, which only an extra installs; InputError where it is not there."""
    try:
        import h5py
    except ImportError:
        raise InputError("h5py", None, "the extra: pip install 'optodrive[analysis]'", "missing_extra") from None
    return h5py


class Hdf5Tree:
    """A recording in an HDF5 file that is open for reading; a `Tree`."""

    def __init__(self, path: Path, trusted: bool = False) -> None:
        """Open the file. trusted: without trying it out in a process of its own before."""
        self._h5 = h5py_module()
        self._path = path
        self._room = Room()
        self._last: tuple[str, Any] | None = None
        if not trusted:
            try_out(path)
        with refusing(str(path), "a readable HDF5 file"):
            self._file = self._h5.File(path, "r")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *details: object) -> None:
        with suppress(Exception):  # a damaged file may fail again when it is closed
            self._file.close()

    def where(self, *names: str) -> str:
        """The place in words."""
        return f"{self._path}: /{'/'.join(('runs', *names))}"

    def head(self) -> Attributes:
        """Attributes of the whole."""
        return self._attributes(str(self._path), self._file)

    def runs(self) -> list[str]:
        """Names of the runs."""
        return self._names(self.where(), self._group(self.where(), self._file, "runs"))

    def attributes(self, run: str) -> Attributes:
        """Attributes of a run."""
        return self._attributes(self.where(run), self._run(run))

    def members(self, run: str) -> list[str]:
        """Names of a run's tables and signals."""
        return self._names(self.where(run), self._run(run))

    def signal_attributes(self, run: str, signal: str) -> Attributes:
        """Attributes of a signal."""
        return self._attributes(self.where(run, signal), self._signal(run, signal))

    def table(self, run: str, name: str) -> FloatArray:
        """A table of a run, [n, columns]."""
        where, columns = self.where(run, name), TABLES[name]
        dataset = self._dataset(where, self._run(run), name)
        with refusing(where, "readable data"):
            if len(dataset.shape) != 2 or dataset.shape[1] != len(columns):
                expected = f"n rows of {len(columns)} columns: {', '.join(columns)}"
                raise InputError(where, Words(f"the shape {dataset.shape}"), expected)
            return self._numbers(where, dataset)

    def samples(self, run: str, signal: str) -> tuple[FloatArray, FloatArray]:
        """Times and values of a signal."""
        t_s, value = self._series(run, signal)
        with refusing(self.where(run, signal), "readable data"):
            return (
                self._numbers(self.where(run, signal, "t_s"), t_s),
                self._numbers(self.where(run, signal, "value"), value),
            )

    def sample_count(self, run: str, signal: str) -> int:
        """How many samples a signal has."""
        return int(self._series(run, signal)[0].shape[0])

    def _run(self, run: str) -> Any:
        if self._last is None or self._last[0] != run:  # one after the other: the way from the root is long
            self._last = run, self._group(self.where(run), self._group(self.where(), self._file, "runs"), run)
        return self._last[1]

    def _signal(self, run: str, signal: str) -> Any:
        return self._group(self.where(run, signal), self._run(run), signal)

    def _series(self, run: str, signal: str) -> tuple[Any, Any]:
        group = self._signal(run, signal)
        t_s, value = (self._dataset(self.where(run, signal, name), group, name) for name in SAMPLES)
        if len(t_s.shape) != 1:
            raise InputError(self.where(run, signal, "t_s"), Words(f"the shape {t_s.shape}"), "one row of times")
        if value.shape != t_s.shape:
            expected = f"as many values as times, {t_s.shape}"
            raise InputError(self.where(run, signal, "value"), Words(f"the shape {value.shape}"), expected)
        return t_s, value

    def _names(self, where: str, group: Any) -> list[str]:
        with refusing(where, "a readable group"):
            return list(group)

    def _attributes(self, where: str, group: Any) -> Attributes:
        values: dict[str, Any] = {}
        with refusing(where, "readable attributes"):
            for name in group.attrs:
                with suppress(TypeError):  # of a type that h5py has no word for, and so neither text nor number
                    attribute = group.attrs.get_id(name)
                    if prod(attribute.shape) * attribute.dtype.itemsize <= TEXT_MAX:
                        values[name] = group.attrs[name]
            return plain_attributes(values)

    def _member(self, where: str, group: Any, name: str, kind: Any, expected: str) -> Any:
        with refusing(where, expected):
            link = group.get(name, getlink=True)
            if link is None:
                raise InputError(where, None, expected)
            # A link may lead to any file of this machine, or in circles; a recording is one file.
            if not isinstance(link, self._h5.HardLink):
                raise InputError(where, Words("a link"), f"{expected}, stored here")
            member = group[name]
            if not isinstance(member, kind):
                raise InputError(where, Words(f"a {type(member).__name__.lower()}"), expected)
            return member

    def _group(self, where: str, parent: Any, name: str) -> Any:
        return self._member(where, parent, name, self._h5.Group, "a group")

    def _dataset(self, where: str, parent: Any, name: str) -> Any:
        dataset = self._member(where, parent, name, self._h5.Dataset, "a dataset of numbers")
        with refusing(where, "a dataset of numbers"):
            if dataset.dtype.kind not in "iuf" or dataset.shape is None:
                kind = "nothing" if dataset.shape is None else f"entries of type {dataset.dtype}"
                raise InputError(where, Words(" ".join(kind.split())), "a dataset of numbers (float64)")
            if dataset.is_virtual or dataset.external:
                raise InputError(where, Words("data kept in other files"), "a dataset stored here")
            if dataset.chunks and prod(dataset.chunks) > NUMBERS_MAX:
                raise InputError(where, Words(f"chunks of {dataset.chunks}"), f"chunks of at most {NUMBERS_MAX}")
            return dataset

    def _numbers(self, where: str, dataset: Any) -> FloatArray:
        self._room.take(where, prod(dataset.shape))
        return np.array(dataset[()], dtype=np.float64)


def fill(path: Path, runs: tuple[Run, ...], instrument_notes: str) -> None:
    """Write runs, known to fit, to a new HDF5 file."""
    with h5py_module().File(path, "w") as file:
        file.attrs["format"] = FORMAT
        file.attrs["version"] = VERSION
        if instrument_notes:
            file.attrs["instrument_notes"] = instrument_notes
        for run in runs:
            _fill_run(file.create_group(f"runs/{run.name}"), run)


def _fill_run(group: Any, run: Run) -> None:
    for key, value in run.attributes.items():
        group.attrs[key] = value
    group.attrs["ambient_K"] = run.ambient_k
    group.create_dataset(PULSES, data=run.pulses)
    if run.commands is not None:
        group.create_dataset(COMMANDS, data=run.commands)
    for name in SIGNALS:
        if name not in run.signals:
            continue
        signal = run.signals[name]
        member = group.create_group(name)
        member.create_dataset("t_s", data=signal.t_s)
        member.create_dataset("value", data=signal.value)
        member.attrs["pixel"] = signal.pixel
        if signal.sigma is not None:
            member.attrs["sigma"] = signal.sigma
