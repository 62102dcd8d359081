"""Reading a recording in either form, checked whole."""

from pathlib import Path

import numpy as np

from optodrive.core.errors import InputError, nearest
from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.measurements import Measurement, Run, Signal
from optodrive.lab.recording import checks
from optodrive.lab.recording.csv_folder import CsvTree
from optodrive.lab.recording.hdf5 import Hdf5Tree
from optodrive.lab.recording.storage import COMMANDS, PULSES, Tree, Words, check_run_name, naturally, refusing


def read_recording(path: Path) -> Measurement:
    """Read a recording, HDF5 file or folder; InputError with file, run, signal and expectation where it is not one."""
    return read_with_notes(path)[0]


def read_with_notes(path: Path) -> tuple[Measurement, str]:
    """A recording, and what it notes of the instruments."""
    with open_tree(path) as tree, refusing(str(path), "a recording that can be read"):
        names, notes = open_head(tree)
        measurement = Measurement(tuple(_read_run(tree, name) for name in names))
        values = [signal.value for run in measurement.runs for signal in run.signals.values()]
        checks.check_enough(tree.where(), sum(int(np.count_nonzero(np.isfinite(value))) for value in values))
        return measurement, notes


def read_runs(path: Path, names: list[str], trusted: bool = False) -> Measurement:
    """Read only these runs of a recording, in this order. trusted: a file that has been tried out already."""
    with open_tree(path, trusted) as tree, refusing(str(path), "a recording that can be read"):
        known, _ = open_head(tree)
        for name in names:
            if name not in known:
                raise InputError(tree.where(), name, f"a run of this recording, {nearest(name, known)}")
        return Measurement(tuple(_read_run(tree, name) for name in names))


def open_tree(path: Path, trusted: bool = False) -> Tree:
    """Open a recording in whichever form it is. trusted: without trying a file out in a process of its own before."""
    path = Path(path)
    with refusing(str(path), "a recording: an HDF5 file or a folder"):
        if path.is_dir():
            return CsvTree(path)
        if path.is_file():
            return Hdf5Tree(path, trusted)
        found = "something that is no file" if path.exists() else "nothing of this name"
        raise InputError(str(path), Words(found), "a recording: an HDF5 file or a folder")


def open_head(tree: Tree) -> tuple[list[str], str]:
    """The runs of a recording in their natural order, and its notes, once format and version are known to be right."""
    head = tree.head()
    checks.check_head(tree.where(), head)
    names = tree.runs()
    if not names:
        raise InputError(tree.where(), Words("no runs"), "at least one")
    for name in names:
        check_run_name(tree.where(), name)
    return sorted(names, key=naturally), str(head.get("instrument_notes", ""))


def read_pulses(tree: Tree, run: str) -> FloatArray:
    """The drive of a run, checked."""
    pulses = tree.table(run, PULSES)
    checks.check_pulses(tree.where(run, PULSES), pulses)
    return pulses


def _read_run(tree: Tree, name: str) -> Run:
    where = tree.where(name)
    attributes = tree.attributes(name)
    ambient_k = checks.take_ambient_k(where, attributes)
    members = tree.members(name)
    wanted = checks.signals_among(where, members)
    pulses = read_pulses(tree, name)
    commands = _read_commands(tree, name) if COMMANDS in members else None
    signals = {signal: _read_signal(tree, name, signal) for signal in wanted}
    return Run(name, ambient_k, pulses, signals, attributes, commands)


def _read_commands(tree: Tree, run: str) -> FloatArray:
    commands = tree.table(run, COMMANDS)
    checks.check_commands(tree.where(run, COMMANDS), commands)
    return commands


def read_signal_attributes(tree: Tree, run: str, signal: str) -> tuple[int, float | None]:
    """Pixel and stated noise of a signal, checked."""
    where = tree.where(run, signal)
    attributes = tree.signal_attributes(run, signal)
    checks.check_unit(where, signal, attributes)
    return checks.pixel_measured(where, signal, attributes), checks.stated_sigma(where, attributes)


def _read_signal(tree: Tree, run: str, signal: str) -> Signal:
    pixel, sigma = read_signal_attributes(tree, run, signal)
    t_s, value = tree.samples(run, signal)
    checks.check_samples(tree.where(run, signal), t_s, value)
    return Signal(pixel, t_s, value, sigma)
