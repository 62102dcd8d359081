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
from scipy.special import fdtrc

from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.discrepancy import InstrumentDisturbance
from optodrive.lab.diagnosis.dataset import PIXEL_KINDS, SIGNALS, Dataset
from optodrive.lab.diagnosis.fitting import JitterSensitivity
from optodrive.lab.diagnosis.instrument_hops import find_hops
from optodrive.lab.diagnosis.instrument_lines import MAX_LINES, find_line
from optodrive.lab.diagnosis.noise_model import NoiseModel, find_resolution

DRIFT_DEGREES, MAX_DRIFT_P, MIN_DRIFT_RUNS, MIN_QUIET_SAMPLES = (1, 3), 1e-6, 6, 4
"""Degrees of the polynomial of a drift, its largest p value, and the smallest number of runs and of samples in each."""


def find_disturbances(
    data: Dataset, residual: FloatArray, sensitivity: JitterSensitivity, noise: NoiseModel
) -> tuple[tuple[InstrumentDisturbance, ...], FloatArray]:
    """Return the disturbances of the pixel's signals, and their values in the data [m].

    residual: [m] of a nominal fit; noise: as estimated from the repeats, disturbances included
    """
    found: list[InstrumentDisturbance] = []
    added = np.zeros(len(residual))
    for kind in (kind for kind in data.kinds if kind in PIXEL_KINDS):
        for _ in range(MAX_LINES):
            line = find_line(data, residual - added, kind)
            if line is None:
                break
            found.append(line[0])
            added += line[1]
    hops, steps = find_hops(data, residual - added, sensitivity, noise)
    found += hops
    added += steps
    for kind in (kind for kind in data.kinds if kind in PIXEL_KINDS[1:]):
        drift = _find_drift(data, residual - added, kind)
        if drift is not None:
            found.append(drift[0])
            added += drift[1]
    return tuple(found), added


def remove_disturbances(data: Dataset, added: FloatArray) -> Dataset:
    """Return the data without the values of the disturbances."""
    return replace(data, value=data.value - added)


def _find_drift(data: Dataset, residual: FloatArray, kind: int) -> tuple[InstrumentDisturbance, FloatArray] | None:
    """Return the drift of the zero of one kind of signal over the recording and its values [m], or None."""
    session = {
        number: experiment.session_time for experiment, numbers in data.experiments for number in numbers if number >= 0
    }
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
