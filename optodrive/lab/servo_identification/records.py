"""One mirror's commands and angles from a recording: as steps with checks of axes, sign and units, and as records.

Steps identify a servo; records of any excitation, with the noise and what is held out, show effects beside it.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from optodrive.core.errors import MISSING, InputError
from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.core.types.measurements import Measurement, Run
from optodrive.lab.inference.noise import estimate_noise
from optodrive.lab.servo_identification.effect_fit import ServoRecord

AXES = ("x", "y")
STEPS_MIN = 3
STEPS_MAX = 400
"""Steps beyond this number add no information."""
WINDOW_S = 0.02
"""Samples later than this after a step are not used."""
DENSE_HOLD_S = 5e-3
"""Commands that mostly hold for less are an excitation rather than steps."""
STUCK_GAIN = 0.02
"""A mirror with a smaller gain than this is stuck."""
GAIN_TOLERANCE = 0.25
NOISE_MIN = 1e-4
LEVEL_TOLERANCE = 1.15
"""Runs whose commands differ by less in rms have one amplitude."""
LEVELS_MIN = 3
"""Amplitudes of one run each from which the middle one is held out."""
HELD_OUT_SHARE = 1.0 / 3.0
"""Part held out of each run where fewer amplitudes were recorded, once each: its end."""
SAMPLES_MIN = 200
DIFFERENCES = (2, 4, 6, 8)
"""Orders of differences from which the noise is estimated: a response is smooth, white noise is not."""
RECORD_NOISE_MIN = 1e-5
RANGE_MAX = 8000
"""Samples of one record that are compared."""


def is_dense(changes_s: FloatArray) -> bool:
    """Return whether commands that change at changes_s are an excitation: too dense for steps that settle."""
    return len(changes_s) > 2 and float(np.median(np.diff(changes_s))) < DENSE_HOLD_S


class Steps(NamedTuple):
    """Commands of one mirror, all [k]: command_rad from at_s (s) on. The first one holds from the beginning."""

    at_s: FloatArray
    command_rad: FloatArray


@dataclass(frozen=True, eq=False)
class StepTrace:
    """All runs of one mirror. Runs may have different measuring ranges, so each has its own noise.

    axis: 0 for x, 1 for y
    """

    axis: int
    runs: tuple[ServoRecord, ...]

    @property
    def is_dense(self) -> bool:
        """Whether the commands are an excitation rather than steps."""
        return any(is_dense(run.at_s) for run in self.runs)

    @cached_property
    def spacing_s(self) -> float:
        """Median time between samples."""
        return float(np.median(np.concatenate([np.diff(run.t_s) for run in self.runs])))

    @cached_property
    def value(self) -> FloatArray:
        """Angles of all samples, rad."""
        return np.concatenate([run.value for run in self.runs])

    @cached_property
    def noise(self) -> FloatArray:
        """Rms noise of each sample, rad."""
        return np.concatenate([np.full(len(run.t_s), run.noise) for run in self.runs])

    @property
    def noise_rad(self) -> float:
        """Rms noise of all samples, rad."""
        return float(np.sqrt((self.noise**2).mean()))

    @property
    def steps_rad(self) -> FloatArray:
        """Sizes of all steps, [k]."""
        return np.concatenate([np.abs(np.diff(run.command)) for run in self.runs])


def extract_trace(where: str, measurement: Measurement, axis: int) -> StepTrace:
    """Extract the trace of mirror x or y. Raise InputError, naming `where`, if it is incomplete or inconsistent."""
    name = f"mirror_{AXES[axis]}_rad"
    runs = [run for run in measurement.runs if name in run.signals and run.commands is not None and len(run.commands)]
    if not runs:
        expected = "a run with this signal and commands: the mirror's measured angle"
        raise InputError(f"{where}: {name}", MISSING, expected)
    steps_left, found = STEPS_MAX, []
    for run in runs:
        record = _extract_steps(run, axis, steps_left)
        if record is not None:
            found.append(record)
            steps_left -= len(record.command) - 1
    if STEPS_MAX - steps_left < STEPS_MIN:
        count = f"{STEPS_MAX - steps_left} steps of {AXES[axis]} in commands"
        raise InputError(f"{where}: {name}", count, f"at least {STEPS_MIN}")
    _check_following(f"{where}: {name}", runs, axis)
    return StepTrace(axis, tuple(found))


def _extract_steps(run: Run, axis: int, steps_left: int) -> ServoRecord | None:
    """Extract up to steps_left steps of a run and the samples near them. Return None for a run without steps."""
    signal, commands = run.signals[f"mirror_{AXES[axis]}_rad"], run.commands
    assert commands is not None  # noqa: S101
    finite = np.isfinite(signal.value)
    t_s, value_rad = signal.t_s[finite], signal.value[finite]
    at_s, command_rad = commands[:, 0], commands[:, 1 + axis]
    changed = np.flatnonzero(np.diff(command_rad) != 0.0) + 1
    if not len(changed) or not len(t_s):
        return None
    end_s = at_s[changed[steps_left]] if len(changed) > steps_left else np.inf
    changed = changed[: max(0, steps_left)]
    changed = changed[at_s[changed] < t_s[-1]]
    if not len(changed):
        return None
    steps = Steps(at_s[[0, *changed]], command_rad[[0, *changed]])
    step_index = np.searchsorted(steps.at_s[1:], t_s, side="right")
    since_s = t_s - np.concatenate([[steps.at_s[1] - WINDOW_S], steps.at_s[1:]])[step_index]
    near = (since_s <= WINDOW_S) & (since_s >= 0.0) & (t_s < end_s)
    t_s, value_rad = t_s[near], value_rad[near]
    if len(t_s) <= 2:
        return None
    noise_rad = _noise_rad(steps, t_s, value_rad)
    return ServoRecord(*steps, t_s, value_rad, np.ones(len(t_s), dtype=np.bool_), False, noise_rad)


def _find_settled_rows(at_s: FloatArray, t_s: FloatArray) -> IntArray:
    """Return the command's row for samples late in their hold, −1 for others, [m]."""
    row = np.clip(np.searchsorted(at_s, t_s, side="right") - 1, 0, None)
    end_s = np.append(at_s[1:], max(t_s[-1], at_s[-1]))
    late = t_s >= at_s[row] + 0.75 * (end_s[row] - at_s[row])
    return np.where(late, row, -1)


def _check_following(where: str, runs: list[Run], axis: int) -> None:
    """Raise InputError for a mirror that is stuck, inverted, exchanged with the other one, or in other units."""
    commands_at, measured = [], []
    for run in runs:
        signal, commands = run.signals[f"mirror_{AXES[axis]}_rad"], run.commands
        assert commands is not None  # noqa: S101
        row = _find_settled_rows(commands[:, 0], signal.t_s)
        good = (row >= 0) & np.isfinite(signal.value)
        commands_at.append(commands[row[good], 1:])
        measured.append(signal.value[good])
    commanded, value = np.concatenate(commands_at), np.concatenate(measured)
    if not len(value) or not np.any(np.ptp(commanded, axis=0)):
        return
    commanded, value = commanded - commanded.mean(axis=0), value - value.mean()
    spread = np.sqrt((commanded**2).mean(axis=0))
    collinear = abs((commanded[:, 0] * commanded[:, 1]).mean()) > 0.99 * spread[0] * spread[1]
    gains = np.zeros(2)
    if collinear and spread[axis] > 0.0:
        gains[axis] = (commanded[:, axis] @ value) / (commanded[:, axis] @ commanded[:, axis])
    else:
        gains = np.linalg.lstsq(commanded, value, rcond=None)[0]
    own_gain, other_gain = float(gains[axis]), float(gains[1 - axis])
    own_axis, other_axis = AXES[axis], AXES[1 - axis]
    found = f"{own_gain:.2g} of the {own_axis} commands and {other_gain:.2g} of the {other_axis} commands"
    if abs(other_gain) > max(0.5, abs(own_gain)):
        raise InputError(where, found, f"a mirror that follows {own_axis}_rad: axes exchanged")
    if not spread[axis]:
        return
    if abs(own_gain) < STUCK_GAIN:
        raise InputError(where, found, "a mirror that follows its commands: it is stuck")
    if own_gain < 0.0:
        raise InputError(where, found, f"an angle that increases with {own_axis}_rad: axis inverted")
    if abs(own_gain - 1.0) > GAIN_TOLERANCE:
        unit = ": degrees?" if 40.0 < own_gain < 75.0 else ": optical angles?" if 1.7 < own_gain < 2.3 else ""
        expected = f"the mirror's mechanical angle in rad, within {GAIN_TOLERANCE:.0%} of the command{unit}"
        raise InputError(where, found, expected)


def _noise_rad(steps: Steps, t_s: FloatArray, value_rad: FloatArray) -> float:
    """Return the rms noise of a sample from second differences late in each hold, at least NOISE_MIN of a step."""
    row = _find_settled_rows(steps.at_s, t_s)
    second_differences = np.abs(np.diff(value_rad, 2)[(row[:-2] == row[2:]) & (row[:-2] >= 0)])
    sigma_rad = 1.4826 * float(np.median(second_differences)) / np.sqrt(6.0) if len(second_differences) else 0.0
    return max(sigma_rad, NOISE_MIN * float(np.abs(np.diff(steps.command_rad)).mean()))


def is_excitation(measurement: Measurement, axis: int) -> bool:
    """Return whether the commands of mirror x or y are an excitation rather than steps."""
    tables = [run.commands for run in measurement.runs if run.commands is not None and len(run.commands)]
    return any(is_dense(table[1:, 0][np.diff(table[:, 1 + axis]) != 0.0]) for table in tables)


def extract_records(where: str, measurement: Measurement, axis: int) -> list[ServoRecord]:
    """Extract the records of mirror x or y. Raise InputError.

    The last run of each amplitude is held out, or the middle amplitude if each was recorded once.
    """
    name = f"mirror_{AXES[axis]}_rad"
    measured = (run for run in measurement.runs if name in run.signals and run.commands is not None)
    runs = [run for run in measured if _level(run, axis) > 0.0]
    if not runs:
        raise InputError(f"{where}: {name}", MISSING, "a run with this signal and commands that move this mirror")
    levels = _group_levels(runs, axis)
    held_out: list[Run] = [level[-1] for level in levels if len(level) > 1]
    if not held_out and len(levels) >= LEVELS_MIN:
        held_out = levels[len(levels) // 2]
    return [
        record
        for level in levels
        for run in level
        for record in _build_records(where, run, axis, run in held_out, not held_out, _level(level[0], axis))
    ]


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


def _build_records(
    where: str, run: Run, axis: int, is_held_out: bool, is_divided: bool, level: float
) -> Iterator[ServoRecord]:
    """Yield the record of a run, or those of both parts of a run whose end is held out."""
    signal, commands = run.signals[f"mirror_{AXES[axis]}_rad"], run.commands
    assert commands is not None  # noqa: S101
    good = np.isfinite(signal.value) & (signal.t_s >= commands[0, 0])
    t_s, value = signal.t_s[good], signal.value[good]
    if len(t_s) < SAMPLES_MIN:
        raise InputError(f"{where}: {run.name}/mirror_{AXES[axis]}_rad", len(t_s), f"at least {SAMPLES_MIN} samples")
    noise = max(estimate_noise([value], DIFFERENCES), RECORD_NOISE_MIN * float(np.std(value)), 1e-300)
    until = int(len(t_s) * (1.0 - HELD_OUT_SHARE)) if is_divided else len(t_s)
    for part, held_out in ((slice(0, until), is_held_out), (slice(until, None), True)):
        use, every = np.zeros(len(t_s), dtype=np.bool_), np.arange(len(t_s))[part]
        use[every[:: max(1, -(-len(every) // RANGE_MAX))]] = True
        if use.any():
            end = int(np.flatnonzero(use)[-1]) + 1
            rows = commands[:, 0] <= t_s[end - 1]
            at_s, command = commands[rows, 0], commands[rows, 1 + axis]
            yield ServoRecord(at_s, command, t_s[:end], value[:end], use[:end], held_out, noise, level)
