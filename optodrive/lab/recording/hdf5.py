"""Recording as one HDF5 file, and the probe of such a file in a process with limited CPU time and memory.

The HDF5 library is not hardened against damaged files: a few changed bytes can make it crash or loop forever. A file
that a short-lived process has read from end to end is safe to be read in this process.
"""

import os
import resource
import signal
import subprocess
import sys
from contextlib import suppress
from math import ceil, prod
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np

from optodrive.core.errors import MISSING, InputError, Unquoted
from optodrive.core.extras import import_extra
from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.measurements import Run
from optodrive.lab.recording.storage import (
    ATTRIBUTES_MAX,
    COMMANDS,
    FORMAT,
    NUMBERS_MAX,
    PLAN_TABLES,
    PLAN_TEXTS,
    PULSES,
    SAMPLE_COLUMNS,
    SIGNALS,
    TABLE_COLUMNS,
    TEXT_BYTES_MAX,
    VERSION,
    Attributes,
    MemoryBudget,
    RecordingTree,
    convert_errors,
    format_name,
    normalize_attribute,
    normalize_attributes,
)

CPU_LIMIT_S = 5
RUN_BYTES_PER_CPU_S = 20_000_000
"""Bytes per second of CPU time that a run may take beyond `CPU_LIMIT_S`; even compressed data is read faster."""
FILE_BYTES_PER_CPU_S = 200_000
"""Bytes per second of CPU time that the whole file may take beyond `CPU_LIMIT_S`; small runs take milliseconds."""
MEMORY_BYTES = 2**32
ERROR_CHARACTERS_MAX = 200
_PROGRAM = "from optodrive.lab.recording.hdf5 import main; main()"
_ENVIRONMENT = {"OPENBLAS_NUM_THREADS": "1", "PYTHONWARNINGS": "ignore"}
_probed_files: set[tuple[str, int, int, int, int]] = set()


def import_h5py() -> Any:
    """Return the module h5py. Raise InputError if the extra that provides it is not installed."""
    return import_extra("h5py")


class Hdf5Tree(RecordingTree):
    """Recording in an HDF5 file that is open for reading."""

    def __init__(self, path: Path) -> None:
        """Open a file that `probe_in_sandbox` has accepted."""
        self._h5 = import_h5py()
        self.path = path
        self._budget = MemoryBudget()
        self._cached_run: tuple[str, Any] | None = None
        with convert_errors(str(path), "a readable HDF5 file"):
            self._file = self._h5.File(path, "r")

    def __exit__(self, *details: object) -> None:
        with suppress(Exception):  # a damaged file may fail again when it is closed
            self._file.close()

    def read_attributes(self, *names: str) -> Attributes:
        """Return the attributes of the recording, of a run, or of a signal."""
        group = self._open_run(*names) if names else self._file
        return self._read_attributes(self.format_place(*names) if names else str(self.path), group)

    def list_runs(self) -> list[str]:
        """Return the run names."""
        place = self.format_place()
        return self._list_groups(place, self._open_group(place, self._file, "runs"))

    def list_members(self, run: str) -> list[str]:
        """Return the names of a run's tables and signals."""
        group = self._open_run(run)
        with convert_errors(self.format_place(run), "a readable group"):
            return list(group)

    def list_plans(self) -> list[str]:
        """Return the IDs of a session's plans. Return none for another recording."""
        if "plans" not in self._file:
            return []
        place = f"{self.path}: /plans"
        names = self._list_groups(place, self._open_group(place, self._file, "plans"))
        return [name for name in names if name != "config"]

    def read_plan(self, plan: str) -> tuple[Attributes, dict[str, str], dict[str, FloatArray]]:
        """Return a plan's attributes, texts (`PLAN_TEXTS`) and tables (`PLAN_TABLES`), those that it has."""
        place = f"{self.path}: /plans/{plan}"
        group = self._open_group(place, self._file, f"plans/{plan}")
        texts: dict[str, str] = {}
        tables: dict[str, FloatArray] = {}
        with convert_errors(place, "a readable plan"):
            for name in (name for name in PLAN_TEXTS if name in group):
                texts[name] = self._read_text(f"{place}/{name}", group, name)
            for name, columns in PLAN_TABLES.items():
                if name in group:
                    tables[name] = self._read_columns(f"{place}/{name}", group, name, columns)
        return self._read_attributes(place, group), texts, tables

    def read_table(self, run: str, name: str) -> FloatArray:
        """Return a table of a run, [n, columns]."""
        return self._read_columns(self.format_place(run, name), self._open_run(run), name, TABLE_COLUMNS[name])

    def _read_columns(self, place: str, group: Any, name: str, columns: tuple[str, ...]) -> FloatArray:
        dataset = self._open_dataset(place, group, name)
        with convert_errors(place, "readable data"):
            if len(dataset.shape) != 2 or dataset.shape[1] != len(columns):
                expected = f"n rows of {len(columns)} columns: {', '.join(columns)}"
                raise InputError(place, Unquoted(f"the shape {dataset.shape}"), expected)
            return self._read_numbers(place, dataset)

    def read_samples(self, run: str, signal: str) -> tuple[FloatArray, FloatArray]:
        """Return the times and values of a signal."""
        series = zip(SAMPLE_COLUMNS, self._open_series(run, signal), strict=True)
        with convert_errors(self.format_place(run, signal), "readable data"):
            t_s, value = (self._read_numbers(self.format_place(run, signal, name), data) for name, data in series)
            return t_s, value

    def count_samples(self, run: str, signal: str) -> int:
        """Return the number of samples of a signal."""
        return int(self._open_series(run, signal)[0].shape[0])

    def _open_run(self, run: str, *signal: str) -> Any:
        """Return the group of a run, or of one of its signals."""
        if self._cached_run is None or self._cached_run[0] != run:  # consecutive calls concern one run
            runs = self._open_group(self.format_place(), self._file, "runs")
            self._cached_run = run, self._open_group(self.format_place(run), runs, run)
        group = self._cached_run[1]
        return self._open_group(self.format_place(run, *signal), group, signal[0]) if signal else group

    def _open_series(self, run: str, signal: str) -> tuple[Any, Any]:
        group = self._open_run(run, signal)
        t_s, value = (self._open_dataset(self.format_place(run, signal, name), group, name) for name in SAMPLE_COLUMNS)
        if len(t_s.shape) != 1:
            place = self.format_place(run, signal, "t_s")
            raise InputError(place, Unquoted(f"the shape {t_s.shape}"), "a one-dimensional array of times")
        if value.shape != t_s.shape:
            expected = f"as many values as times, {t_s.shape}"
            raise InputError(self.format_place(run, signal, "value"), Unquoted(f"the shape {value.shape}"), expected)
        return t_s, value

    def _list_groups(self, place: str, group: Any) -> list[str]:
        """Return the names in a group. Raise InputError at the first link, and for an object of two names.

        Links cost no space: a small file could have any number of runs.
        """
        with convert_errors(place, "a readable group"):
            names, addresses = [], set()
            for name in group:
                own = f"{place}/{format_name(name)}"
                link = group.id.links.get_info(name.encode("utf-8", "surrogateescape"))
                if link.type != self._h5.h5l.TYPE_HARD:
                    raise InputError(own, Unquoted("a link"), "a group, stored in this file")
                if link.u in addresses:
                    raise InputError(own, Unquoted("a second name of a group"), "one name of each")
                addresses.add(link.u)
                names.append(name)
            return names

    def _read_text(self, place: str, group: Any, name: str) -> str:
        dataset = self._open_member(place, group, name, self._h5.Dataset, "text")
        with convert_errors(place, "text"):
            if dataset.shape != () or self._h5.check_string_dtype(dataset.dtype) is None:
                raise InputError(place, Unquoted(f"entries of type {dataset.dtype}"), "one text")
            return str(normalize_attribute(dataset[()]))

    def _read_attributes(self, place: str, group: Any) -> Attributes:
        values: dict[str, Any] = {}
        with convert_errors(place, "readable attributes"):
            if len(group.attrs) > ATTRIBUTES_MAX:
                raise InputError(place, Unquoted(f"{len(group.attrs)} attributes"), f"at most {ATTRIBUTES_MAX}")
            for name in group.attrs:
                with suppress(TypeError):  # h5py cannot represent the type
                    attribute = group.attrs.get_id(name)
                    if prod(attribute.shape) * attribute.dtype.itemsize <= TEXT_BYTES_MAX:
                        values[name] = group.attrs[name]
            return normalize_attributes(values)

    def _open_member(self, place: str, group: Any, name: str, kind: Any, expected: str) -> Any:
        with convert_errors(place, expected):
            link = group.get(name, getlink=True)
            if link is None:
                raise InputError(place, MISSING, expected)
            # A link may lead to another file or form a cycle; a recording is one file.
            if not isinstance(link, self._h5.HardLink):
                raise InputError(place, Unquoted("a link"), f"{expected}, stored in this file")
            member = group[name]
            if not isinstance(member, kind):
                raise InputError(place, Unquoted(f"a {type(member).__name__.lower()}"), expected)
            return member

    def _open_group(self, place: str, parent: Any, name: str) -> Any:
        return self._open_member(place, parent, name, self._h5.Group, "a group")

    def _open_dataset(self, place: str, parent: Any, name: str) -> Any:
        dataset = self._open_member(place, parent, name, self._h5.Dataset, "a dataset of numbers")
        with convert_errors(place, "a dataset of numbers"):
            if dataset.dtype.kind not in "iuf" or dataset.shape is None:
                kind = "nothing" if dataset.shape is None else f"entries of type {dataset.dtype}"
                raise InputError(place, Unquoted(" ".join(kind.split())), "a dataset of numbers (float64)")
            if dataset.is_virtual or dataset.external:
                raise InputError(place, Unquoted("data stored in other files"), "a dataset stored in this file")
            if dataset.chunks and prod(dataset.chunks) > NUMBERS_MAX:
                raise InputError(place, Unquoted(f"chunks of {dataset.chunks}"), f"chunks of at most {NUMBERS_MAX}")
            return dataset

    def _read_numbers(self, place: str, dataset: Any) -> FloatArray:
        self._budget.reserve(place, prod(dataset.shape))
        return np.array(dataset[()], dtype=np.float64)


def write_file(path: Path, runs: tuple[Run, ...], instrument_notes: str) -> None:
    """Write normalized runs to a new HDF5 file."""
    with import_h5py().File(path, "w") as file:
        file.attrs["format"] = FORMAT
        file.attrs["version"] = VERSION
        if instrument_notes:
            file.attrs["instrument_notes"] = instrument_notes
        for run in runs:
            _write_run(file.create_group(f"runs/{run.name}"), run)


def _write_run(group: Any, run: Run) -> None:
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


def probe_in_sandbox(path: Path) -> None:
    """Read a file in a sandboxed process, once per file and process. Raise InputError if that process fails."""
    status = path.stat()
    identity = (str(path.resolve()), status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns)
    if identity in _probed_files:
        return
    run_limit_s = CPU_LIMIT_S + status.st_size // RUN_BYTES_PER_CPU_S
    file_limit_s = CPU_LIMIT_S + status.st_size // FILE_BYTES_PER_CPU_S
    try:
        process = subprocess.run(
            [sys.executable, "-P", "-c", _PROGRAM, str(path.absolute()), str(run_limit_s), str(file_limit_s)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            env={**os.environ, **_ENVIRONMENT, "PYTHONPATH": os.pathsep.join(sys.path)},
            timeout=20 * file_limit_s,
            check=False,
        )
        returncode, error_lines = process.returncode, process.stderr.decode(errors="replace").splitlines()
    except subprocess.TimeoutExpired:
        returncode, error_lines = -signal.SIGXCPU, []
    if returncode < 0:
        raise InputError(str(path), Unquoted("damage on which the HDF5 library hangs or crashes"), "an undamaged file")
    if returncode > 0:  # Python itself reported it, such as a lack of memory: the file need not be the cause
        reason = " ".join(error_lines[-1:])[:ERROR_CHARACTERS_MAX]
        found = f"a file that could not be tried out ({reason})"
        raise InputError(str(path), Unquoted(found), "a process that reads it")
    _probed_files.add(identity)


def _limit_resources(file_limit_s: int) -> None:
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_CPU, (file_limit_s, file_limit_s))
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    soft = MEMORY_BYTES if hard == resource.RLIM_INFINITY else min(hard, MEMORY_BYTES)
    resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def _extend_cpu_limit(run_limit_s: int) -> None:
    """Set the CPU limit to run_limit_s from now.

    The kernel kills the process if it makes no progress until then.
    """
    _, hard_s = resource.getrlimit(resource.RLIMIT_CPU)
    resource.setrlimit(resource.RLIMIT_CPU, (min(ceil(process_time()) + run_limit_s, hard_s), hard_s))


def _read_all(path: Path, run_limit_s: int) -> None:
    runs: list[str] = []
    plans: list[str] = []
    _extend_cpu_limit(run_limit_s)
    with suppress(InputError), Hdf5Tree(path) as tree:
        tree.read_attributes()
        runs = tree.list_runs()
        plans = tree.list_plans()
    for plan in plans:
        _extend_cpu_limit(run_limit_s)
        with suppress(InputError), Hdf5Tree(path) as tree:
            tree.read_plan(plan)
    for run in runs:
        _extend_cpu_limit(run_limit_s)
        with suppress(InputError), Hdf5Tree(path) as tree:
            tree.read_attributes(run)
            _read_members(tree, run, tree.list_members(run))


def _read_members(tree: Hdf5Tree, run: str, members: list[str]) -> None:
    for name in members:
        with suppress(InputError):
            if name in TABLE_COLUMNS:
                tree.read_table(run, name)
            elif name in SIGNALS:
                tree.read_attributes(run, name)
                tree.read_samples(run, name)


def main() -> None:
    """Read the file argv[1], each run within argv[2] seconds of CPU time and all runs within argv[3].

    Invalid content is ignored here; only a crash or a timeout matters.
    """
    _limit_resources(int(sys.argv[3]))
    _read_all(Path(sys.argv[1]), int(sys.argv[2]))
