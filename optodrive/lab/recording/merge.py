"""A session's pulses and what a lab measured meanwhile, as one recording."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from optodrive.core.errors import InputError, nearest
from optodrive.core.types.measurements import Measurement, Run, Signal
from optodrive.lab.recording import checks
from optodrive.lab.recording.reader import open_head, open_tree, read_pulses, read_recording
from optodrive.lab.recording.storage import PULSES, Words, refusing


def merge_session(session: Path, measured: Path, shift_s: float = 0.0) -> Measurement:
    """Runs of a session with the signals measured in them; runs are matched by name.

    measured: a recording whose runs have no pulses of their own; shift_s is added to its times. Runs that were not
    measured are left out. InputError, naming run and file, where the two do not belong together.
    """
    driven = _driven(session)
    measurement = read_recording(measured)
    return Measurement(tuple(_joined(run, driven, session, measured, shift_s) for run in measurement.runs))


def _driven(session: Path) -> dict[str, Run]:
    """A session's runs, which have no signals."""
    with open_tree(session) as tree, refusing(str(session), "a session's recording"):
        names, _ = open_head(tree)
        found = {}
        for name in names:
            attributes = tree.attributes(name)
            ambient_k = checks.take_ambient_k(tree.where(name), attributes)
            found[name] = Run(name, ambient_k, read_pulses(tree, name), {}, attributes)
        return found


def _joined(run: Run, driven: dict[str, Run], session: Path, measured: Path, shift_s: float) -> Run:
    where = f"{measured}: /runs/{run.name}"
    own = driven.get(run.name)
    if own is None:
        raise InputError(where, run.name, f"a run of {session}, {nearest(run.name, list(driven))}")
    if len(run.pulses):
        expected = f"none: those of {session} are taken"
        raise InputError(f"{where}/{PULSES}", Words(f"{len(run.pulses)} pulses"), expected)
    signals = {
        name: Signal(signal.pixel, np.asarray(signal.t_s + shift_s), signal.value, signal.sigma)
        for name, signal in run.signals.items()
    }
    return replace(run, pulses=own.pulses, signals=signals, attributes={**run.attributes, **own.attributes})
