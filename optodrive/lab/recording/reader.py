"""Reading and complete checking of a recording in either form."""

from pathlib import Path

import numpy as np

from optodrive.core.errors import InputError, Unquoted, suggest_nearest
from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.measurements import Measurement, Run, Signal
from optodrive.lab.recording import checks
from optodrive.lab.recording.csv_folder import CsvTree
from optodrive.lab.recording.hdf5 import Hdf5Tree, import_h5py
from optodrive.lab.recording.sandboxed_probe import probe_in_sandbox
from optodrive.lab.recording.storage import (
    COMMANDS,
    PULSES,
    RecordingTree,
    check_run_name,
    convert_errors,
    natural_sort_key,
)


def read_recording(path: Path) -> Measurement:
    """Read a recording. Raise InputError with file, run, signal and expectation if it is invalid."""
    return read_with_notes(path)[0]


def read_with_notes(path: Path) -> tuple[Measurement, str]:
    """Return a recording and its notes on the instruments."""
    with open_tree(path) as tree, convert_errors(str(path), "a readable recording"):
        names, instrument_notes = read_header(tree)
        measurement = Measurement(tuple(_read_run(tree, name) for name in names))
        values = [signal.value for run in measurement.runs for signal in run.signals.values()]
        checks.check_sample_count(
            tree.format_place(), sum(int(np.count_nonzero(np.isfinite(value))) for value in values)
        )
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
    head = tree.read_root_attributes()
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


def _read_run(tree: RecordingTree, name: str) -> Run:
    place = tree.format_place(name)
    attributes = tree.read_run_attributes(name)
    ambient_k = checks.pop_ambient_k(place, attributes)
    members = tree.list_members(name)
    signal_names = checks.select_signals(place, members)
    pulses = read_pulses(tree, name)
    commands = _read_commands(tree, name) if COMMANDS in members else None
    signals = {signal: _read_signal(tree, name, signal) for signal in signal_names}
    return Run(name, ambient_k, pulses, signals, attributes, commands)


def _read_commands(tree: RecordingTree, run: str) -> FloatArray:
    commands = tree.read_table(run, COMMANDS)
    checks.check_commands(tree.format_place(run, COMMANDS), commands)
    return commands


def read_signal_attributes(tree: RecordingTree, run: str, signal: str) -> tuple[int, float | None]:
    """Return the checked pixel and stated noise of a signal."""
    place = tree.format_place(run, signal)
    attributes = tree.read_signal_attributes(run, signal)
    checks.check_names(place, attributes, checks.SIGNAL_ATTRIBUTES)
    checks.check_unit(place, signal, attributes)
    return checks.parse_pixel(place, signal, attributes), checks.parse_sigma(place, attributes)


def _read_signal(tree: RecordingTree, run: str, signal: str) -> Signal:
    pixel, sigma = read_signal_attributes(tree, run, signal)
    t_s, value = tree.read_samples(run, signal)
    checks.check_samples(tree.format_place(run, signal), t_s, value)
    return Signal(pixel, t_s, value, sigma)
