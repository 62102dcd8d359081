"""Atomic writing of a recording in either form."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from optodrive.core.errors import InputError, suggest_nearest
from optodrive.core.files import atomic_write
from optodrive.core.types.measurements import Measurement, Run, Signal
from optodrive.lab.recording import csv_folder, hdf5
from optodrive.lab.recording.reader import read_with_notes
from optodrive.lab.recording.storage import (
    COMMANDS,
    PULSES,
    RUN_MEMBERS,
    SIGNALS,
    TABLE_COLUMNS,
    check_run_name,
    convert_errors,
    format_name,
    is_hdf5,
    normalize_attribute,
    normalize_attributes,
)


def write_recording(path: Path, measurement: Measurement, instrument_notes: str = "") -> None:
    """Write a recording atomically: HDF5 if the suffix says so, else a folder of CSV files.

    Raises InputError if the target cannot be written, or if names, attributes or shapes do not fit both forms.
    """
    path = Path(path)
    runs = _normalize_runs(str(path), measurement)
    _check_attribute(str(path), "instrument_notes", instrument_notes)
    if is_hdf5(path):
        hdf5.import_h5py()
        with atomic_write(path) as file, convert_errors(str(path), "a writable file"):
            hdf5.write_file(file, runs, instrument_notes)
    else:
        with csv_folder.atomic_folder(path) as folder, convert_errors(str(path), "a writable folder"):
            csv_folder.write_folder(folder, runs, instrument_notes)


def convert_recording(source: Path, target: Path) -> Measurement:
    """Read a recording, write it in the form implied by the target's suffix, and return it."""
    measurement, notes = read_with_notes(source)
    write_recording(target, measurement, notes)
    return measurement


def _normalize_runs(place: str, measurement: Measurement) -> tuple[Run, ...]:
    """Check the runs and convert their numbers and text to the types that both forms store."""
    names = [run.name for run in measurement.runs]
    if not names or len(set(names)) < len(names):
        raise InputError(f"{place}: /runs", names, "at least one run, and unique names")
    for name in names:
        check_run_name(f"{place}: /runs", name)
    return tuple(_normalize_run(f"{place}: /runs/{run.name}", run) for run in measurement.runs)


def _normalize_run(place: str, run: Run) -> Run:
    for key, value in run.attributes.items():
        _check_attribute(place, key, value)
    _check_shape(f"{place}/{PULSES}", run.pulses, len(TABLE_COLUMNS[PULSES]))
    if run.commands is not None:
        _check_shape(f"{place}/{COMMANDS}", run.commands, len(TABLE_COLUMNS[COMMANDS]))
    for name in run.signals:
        if name not in SIGNALS:
            expected = f"a known signal, {suggest_nearest(name, list(SIGNALS))}"
            raise InputError(f"{place}/{format_name(name)}", name, expected)
    # NumPy scalars have another repr than Python's own numbers.
    attributes = normalize_attributes(run.attributes)
    signals = {name: _normalize_signal(f"{place}/{name}", signal) for name, signal in run.signals.items()}
    return replace(run, ambient_k=float(run.ambient_k), attributes=attributes, signals=signals)


def _normalize_signal(place: str, signal: Signal) -> Signal:
    if signal.t_s.ndim != 1 or signal.value.shape != signal.t_s.shape:
        raise InputError(f"{place}/value", signal.value.shape, f"as many values as times, {signal.t_s.shape}")
    return replace(signal, pixel=int(signal.pixel), sigma=None if signal.sigma is None else float(signal.sigma))


def _check_shape(place: str, table: np.ndarray[Any, Any], columns: int) -> None:
    if table.ndim != 2 or table.shape[1] != columns:
        raise InputError(place, table.shape, f"n rows of {columns} columns")


def _check_attribute(place: str, key: str, value: object) -> None:
    if not key or not key.isprintable() or key in RUN_MEMBERS or key == "ambient_K":
        raise InputError(place, key, "an attribute's name: printable, and not the name of a run's member")
    converted = normalize_attribute(value)
    if converted is None or (isinstance(value, str) and converted != value):
        raise InputError(f"{place}: {key}", value, "text without NUL, or a 64-bit number")
