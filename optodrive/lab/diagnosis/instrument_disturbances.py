"""Disturbances of an instrument in one signal: a line, hops of its zero, and a drift of its zero over the recording.

Theory of operation

Problem. What an instrument adds to a signal makes repeats differ, so a noise model that is estimated from repeats
absorbs it, or it is equal in all runs and looks like an effect of the pixel. Neither is true.

Lines and hops are sought in `instrument_lines.py` and `instrument_hops.py`.

Drift. A smooth change of the zero, before the first pulse of each run, over the recording. That of the thermometer is a
cause in the catalogue, the ambient temperature.

All are subtracted from the data, and the diagnosis goes on without them.
"""

from dataclasses import replace

import numpy as np
from scipy.special import chdtrc, fdtrc

from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.discrepancy import InstrumentDisturbance
from optodrive.lab.diagnosis.dataset import PIXEL_KINDS, SIGNALS, Dataset
from optodrive.lab.diagnosis.fitting import JitterSensitivity
from optodrive.lab.diagnosis.instrument_hops import find_hops
from optodrive.lab.diagnosis.instrument_lines import MAX_LINES, find_line
from optodrive.lab.diagnosis.noise_model import NoiseModel, find_resolution, whiten
from optodrive.physics.term import BySignal

DRIFT_DEGREES, MAX_DRIFT_P, MIN_DRIFT_RUNS, MIN_QUIET_SAMPLES = (1, 3), 1e-6, 6, 4
"""Degrees of the polynomial of a drift, its largest p value, and the smallest number of runs and of samples in each."""

MAX_ZERO_P = 1e-4
"""Largest p value of zeros that differ from run to run."""


def find_disturbances(
    data: Dataset, residual: FloatArray, sensitivity: JitterSensitivity, noise: NoiseModel
) -> tuple[tuple[InstrumentDisturbance, ...], FloatArray]:
    """Return the disturbances of the pixel's signals, and their values in the data [m].

    residual: [m] of a nominal fit; noise: as estimated from the repeats, disturbances included
    """
    found: list[InstrumentDisturbance] = []
    added = np.zeros(len(residual))
    for kind in (kind for kind in data.kinds if kind in PIXEL_KINDS):
        # Each line is subtracted before the next is sought: a strong one raises its whole neighbourhood.
        for _ in range(MAX_LINES):
            line = find_line(data, residual - added, kind)
            if line is None:
                break
            found.append(line[0])
            added += line[1]
    # After the lines, whose slopes would look like hops, and before drifts, to which hops add up.
    hops, steps = find_hops(data, residual - added, sensitivity, noise)
    found += hops
    added += steps
    # Not of the thermometer, whose drift is the ambient temperature, a cause with its own term.
    for kind in (kind for kind in data.kinds if kind in PIXEL_KINDS[1:]):
        drift = _find_drift(data, residual - added, kind)
        if drift is not None:
            found.append(drift[0])
            added += drift[1]
    return tuple(found), added


def remove_disturbances(data: Dataset, added: FloatArray) -> Dataset:
    """Return the data without the values of the disturbances."""
    return replace(data, value=data.value - added)


def find_dc_coupled(data: Dataset, residual: FloatArray, noise: NoiseModel) -> frozenset[str]:
    """Return the names of the signals, as in `BySignal`, whose zero differs from run to run.

    Behind an AC coupling that has settled, no zero differs. The zero of a run is the generalised least squares mean of
    its residuals before the first pulse, so slow noise does not pass for a difference.
    """
    found = set()
    for kind in (kind for kind in data.kinds if kind in PIXEL_KINDS):
        rows = []
        for block in data.blocks:
            pulses = data.runs[block.run].pulses
            count = int(np.searchsorted(block.t_s, pulses[:, 0].min())) if block.kind == kind and len(pulses) else 0
            if count >= MIN_QUIET_SAMPLES:
                columns = np.column_stack([np.ones(count), residual[block.part][:count]])
                whitened, _ = whiten(block.t_s[:count], columns, noise.coloured[kind])
                weight = float(whitened[:, 0] @ whitened[:, 0])
                rows.append((float(whitened[:, 0] @ whitened[:, 1]) / weight, weight))
        if len(rows) >= MIN_DRIFT_RUNS:
            zeros, weights = np.array(rows).T
            spread = float(weights @ (zeros - np.average(zeros, weights=weights)) ** 2)
            if chdtrc(len(rows) - 1, spread) < MAX_ZERO_P:
                found.add(BySignal._fields[kind])
    return frozenset(found)


def _find_drift(data: Dataset, residual: FloatArray, kind: int) -> tuple[InstrumentDisturbance, FloatArray] | None:
    """Return the drift of the zero of one kind of signal over the recording and its values [m], or None."""
    session = [recorded.session_time for recorded in data.recorded_runs]
    rows = []
    for number, block in enumerate(data.blocks):
        if block.kind != kind:
            continue
        pulses = data.runs[block.run].pulses
        is_quiet = block.t_s < (pulses[:, 0].min() if len(pulses) else np.inf)
        if is_quiet.sum() >= MIN_QUIET_SAMPLES:
            rows.append((session[number], float(residual[block.part][is_quiet].mean())))
    if len(rows) < MIN_DRIFT_RUNS:
        return None
    times, zeros = np.array(rows).T
    p_value, fitted = min((_fit_drift(times, zeros, degree) for degree in DRIFT_DEGREES), key=lambda item: item[0])
    span = float(np.ptp(fitted(times)))
    # Below the resolution it moves no sample.
    if p_value > MAX_DRIFT_P or span < find_resolution(data, kind):
        return None
    added = np.zeros(len(residual))
    for number, block in enumerate(data.blocks):
        if block.kind == kind:
            added[block.part] = fitted(session[number])
    return InstrumentDisturbance(SIGNALS[kind], "drift", span, None, len(rows)), added


def _fit_drift(times: FloatArray, zeros: FloatArray, degree: int) -> tuple[float, np.polynomial.Polynomial]:
    """Return the p value of a polynomial of the session's time against a constant zero, and the polynomial."""
    fitted = np.polynomial.Polynomial.fit(times, zeros, degree, domain=(-1.0, 1.0))
    left, total = float(((zeros - fitted(times)) ** 2).sum()), float(((zeros - zeros.mean()) ** 2).sum())
    degrees = len(zeros) - degree - 1
    ratio = (total - left) / degree / max(left / degrees, 1e-300)
    return float(fdtrc(degree, degrees, ratio)), fitted
