"""Copies among the runs of a recording, which would pass for repeats with very little noise."""

from hashlib import sha256

import numpy as np

from optodrive.core.errors import InputError, Unquoted
from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.measurements import Measurement, Run, Signal
from optodrive.lab.diagnosis.noise_model import estimate_resolution

MIN_NOISE = 3.0
"""Noise of equal samples, in resolutions, from which they are a copy: a simulation without noise stays below it."""
MIN_WHITENESS = 0.5
"""Third differences of neighbouring samples over those of every second one: 1 for white noise, 1/8 if smooth."""
MIN_SAMPLES, MAX_INTERVAL_S = 20, 2e-3
"""Minimum number of samples of a signal whose noise is estimated; their maximum interval, shorter than a response."""


def check_copied_runs(measurement: Measurement) -> None:
    """Raise InputError if a run with noise is a copy of another one: the same pulses, samples and signals."""
    first: dict[bytes, Run] = {}
    for run in measurement.runs:
        content = sha256(run.pulses.tobytes())
        for name in sorted(run.signals):
            content.update(run.signals[name].value.tobytes())
        twin = first.setdefault(content.digest(), run)
        if twin is not run and any(_has_noise(signal) for signal in run.signals.values()):
            raise InputError(
                f"recording: {run.name}", Unquoted(f"a copy of {twin.name}"), "a repeat that was recorded on its own"
            )


def _has_noise(signal: Signal) -> bool:
    """Return whether neighbouring samples differ as noise does: above the resolution, and as much as distant ones."""
    finite = signal.value[np.isfinite(signal.value)]
    if len(finite) < MIN_SAMPLES or float(np.median(np.diff(signal.t_s))) > MAX_INTERVAL_S:
        return False
    near, far = _estimate_noise(finite, 1), _estimate_noise(finite, 2)
    return near > MIN_NOISE * estimate_resolution(finite, float(np.ptp(finite))) and near > MIN_WHITENESS * far


def _estimate_noise(value: FloatArray, stride: int) -> float:
    """Return the standard deviation of white noise by third differences, which are small where a signal is smooth."""
    differences = value[3 * stride :] - 3.0 * (value[2 * stride : -stride] - value[stride : -2 * stride])
    return float(1.4826 * np.median(np.abs(differences - value[: -3 * stride])) / np.sqrt(20.0))
