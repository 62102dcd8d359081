"""Merge of a session's executed pulses with separately measured signals into one recording."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from optodrive.core.errors import InputError, Unquoted, suggest_nearest
from optodrive.core.types.measurements import Measurement, Run, Signal
from optodrive.lab.recording import checks
from optodrive.lab.recording.reader import open_tree, read_header, read_pulses, read_recording
from optodrive.lab.recording.storage import PULSES, SIGNALS, convert_errors


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
        names, _ = read_header(tree)
        runs = {}
        for name in names:
            attributes = tree.read_run_attributes(name)
            ambient_k = checks.pop_ambient_k(tree.format_place(name), attributes)
            runs[name] = Run(name, ambient_k, read_pulses(tree, name), {}, attributes)
        return runs


def _merge_run(run: Run, session_runs: dict[str, Run], session: Path, measured: Path, shift_s: float) -> Run:
    place = f"{measured}: /runs/{run.name}"
    session_run = session_runs.get(run.name)
    if session_run is None:
        raise InputError(place, run.name, f"a run of {session}, {suggest_nearest(run.name, list(session_runs))}")
    if len(run.pulses):
        expected = f"none: the pulses are taken from {session}"
        raise InputError(f"{place}/{PULSES}", Unquoted(f"{len(run.pulses)} pulses"), expected)
    signals = {
        name: Signal(signal.pixel, np.asarray(signal.t_s + shift_s), signal.value, signal.sigma)
        for name, signal in run.signals.items()
    }
    return replace(
        run, pulses=session_run.pulses, signals=signals, attributes={**run.attributes, **session_run.attributes}
    )
