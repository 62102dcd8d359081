"""Records of one mirror under any excitation, extracted from a recording with the noise and the held-out part."""

from collections.abc import Iterator

import numpy as np

from optodrive.core.errors import MISSING, InputError
from optodrive.core.types.arrays import BoolArray, FloatArray
from optodrive.core.types.measurements import Measurement, Run
from optodrive.lab.servo_identification.effect_fit import ServoRecord
from optodrive.lab.servo_identification.step_trace import AXES, is_dense

LEVEL_TOLERANCE = 1.15
"""Runs whose commands differ by less in rms have one amplitude."""
HELD_OUT_SHARE = 1.0 / 3.0
"""Part held out of the only run of an amplitude: its end."""
SAMPLES_MIN = 200
DIFFERENCE_ORDERS = (2, 4, 6, 8)
"""Orders of differences from which the noise is estimated: a response is smooth, white noise is not."""
NOISE_MIN = 1e-5
RANGE_MAX = 8000
"""Samples of one record that are compared."""


def is_excitation(measurement: Measurement, axis: int) -> bool:
    """Return whether the commands of mirror x or y are an excitation rather than steps."""
    tables = [run.commands for run in measurement.runs if run.commands is not None and len(run.commands)]
    return any(is_dense(table[1:, 0][np.diff(table[:, 1 + axis]) != 0.0]) for table in tables)


def extract_records(where: str, measurement: Measurement, axis: int) -> list[ServoRecord]:
    """Extract the records of mirror x or y, the last run of each amplitude held out. Raise InputError."""
    name = f"mirror_{AXES[axis]}_rad"
    runs = [
        run for run in measurement.runs if name in run.signals and run.commands is not None and _level(run, axis) > 0.0
    ]
    if not runs:
        raise InputError(f"{where}: {name}", MISSING, "a run with this signal and commands that move this mirror")
    return [record for level in _group_levels(runs, axis) for record in _split(where, level, axis)]


def _level(run: Run, axis: int) -> float:
    assert run.commands is not None  # noqa: S101
    return float(np.std(run.commands[:, 1 + axis])) if len(run.commands) > 1 else 0.0


def _group_levels(runs: list[Run], axis: int) -> list[list[Run]]:
    levels: list[list[Run]] = []
    for run in sorted(runs, key=lambda each: _level(each, axis)):
        if levels and _level(run, axis) < LEVEL_TOLERANCE * _level(levels[-1][0], axis):
            levels[-1].append(run)
        else:
            levels.append([run])
    return levels


def _split(where: str, runs: list[Run], axis: int) -> Iterator[ServoRecord]:
    """Yield the records of one amplitude. The end of an only run is held out, the last one of several."""
    for run in runs:
        signal, commands = run.signals[f"mirror_{AXES[axis]}_rad"], run.commands
        assert commands is not None  # noqa: S101
        good = np.isfinite(signal.value) & (signal.t_s >= commands[0, 0])
        t_s, value = signal.t_s[good], signal.value[good]
        if len(t_s) < SAMPLES_MIN:
            raise InputError(
                f"{where}: {run.name}/mirror_{AXES[axis]}_rad", len(t_s), f"at least {SAMPLES_MIN} samples"
            )
        noise = estimate_noise(value)
        until = len(t_s) if len(runs) > 1 else int(len(t_s) * (1.0 - HELD_OUT_SHARE))
        parts = ((slice(0, until), run is runs[-1] and len(runs) > 1), (slice(until, None), True))
        for part, held_out in parts:
            use = np.zeros(len(t_s), dtype=np.bool_)
            use[part] = True
            use = _keep_every_nth(use)
            if use.any():
                end = int(np.flatnonzero(use)[-1]) + 1
                rows = commands[:, 0] <= t_s[end - 1]
                yield ServoRecord(
                    commands[rows, 0], commands[rows, 1 + axis], t_s[:end], value[:end], use[:end], held_out, noise
                )


def _keep_every_nth(use: BoolArray) -> BoolArray:
    rows = np.flatnonzero(use)
    kept = np.zeros_like(use)
    kept[rows[:: max(1, -(-len(rows) // RANGE_MAX))]] = True
    return kept


def estimate_noise(value: FloatArray) -> float:
    """Return the rms noise of a sample, the least of estimates from differences of several orders."""
    estimates = []
    for order in DIFFERENCE_ORDERS:
        weights = np.ones(1)
        for _ in range(order):
            weights = np.convolve(weights, [1.0, -1.0])
        difference = np.convolve(value, weights, "valid")
        estimates.append(1.4826 * float(np.median(np.abs(difference))) / float(np.sqrt((weights**2).sum())))
    return max(min(estimates), NOISE_MIN * float(np.std(value)), 1e-300)
