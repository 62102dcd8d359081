"""Limits of the numbers in a recording, within which its diagnosis takes finite time and does not overflow."""

import numpy as np

from optodrive.core.errors import InputError, Unquoted
from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.measurements import Measurement, Run

MAX_MAGNITUDE = 1e9
"""Largest magnitude of a sample or of a pulse's power, SI; statistics hold fourth powers of it."""
MAX_TIME_S = 1e4
"""Latest end of a pulse or command, and longest duration of all runs together: each of some thousand predictions
integrates it in steps of milliseconds."""
MIN_SPACING_S = 1e-9
"""Shortest time between two samples."""


def check_numeric_limits(measurement: Measurement) -> None:
    """Raise InputError for a number that a diagnosis cannot compute with."""
    for run in measurement.runs:
        place = f"/runs/{run.name}"
        if len(run.pulses):
            _check_magnitude(f"{place}/pulses: start_s", run.pulses[:, 0], MAX_TIME_S, "s")
            _check_magnitude(f"{place}/pulses: width_s", run.pulses[:, 1], MAX_TIME_S, "s")
            _check_magnitude(f"{place}/pulses: power_W", run.pulses[:, 2], MAX_MAGNITUDE, "W")
        if run.commands is not None and len(run.commands):
            _check_magnitude(f"{place}/commands: t_s", run.commands[:, 0], MAX_TIME_S, "s")
            _check_magnitude(f"{place}/commands", run.commands[:, 1:], MAX_MAGNITUDE, "rad")
        for name, signal in run.signals.items():
            finite = signal.value[np.isfinite(signal.value)]
            _check_magnitude(f"{place}/{name}", finite, MAX_MAGNITUDE, name.rsplit("_", 1)[1])
            _check_magnitude(f"{place}/{name}/t_s", signal.t_s, MAX_TIME_S, "s")
            spacing_s = float(np.diff(signal.t_s).min(initial=np.inf))
            if not spacing_s >= MIN_SPACING_S:
                found = Unquoted(f"samples {spacing_s:.3g} s apart")
                raise InputError(
                    f"{place}/{name}/t_s", found, f"{MIN_SPACING_S:g} s at least; time stamps of SI seconds"
                )
    _check_duration(measurement.runs)


def _check_magnitude(place: str, numbers: FloatArray, limit: float, unit: str) -> None:
    magnitude = np.abs(numbers)
    if len(numbers) and not magnitude.max() <= limit:
        worst = float(numbers.reshape(-1)[magnitude.argmax()])
        raise InputError(place, worst, f"a magnitude of at most {limit:g} {unit}")


def _check_duration(runs: tuple[Run, ...]) -> None:
    ends_s = [max((float(signal.t_s[-1]) for signal in run.signals.values()), default=0.0) for run in runs]
    if sum(ends_s) > MAX_TIME_S:
        longest = int(np.argmax(ends_s))
        found = f"{sum(ends_s):.0f} s of runs, {ends_s[longest]:.0f} s of them in {runs[longest].name}"
        raise InputError("recording", Unquoted(found), f"at most {MAX_TIME_S:g} s from the starts to the last samples")
