"""Steps and angles of one mirror out of a recording, and what is wrong with them, named as what it is."""

from dataclasses import dataclass

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.types.arrays import FloatArray, freeze_arrays
from optodrive.core.types.measurements import Measurement, Run
from optodrive.lab.servo_identification.step_response import Steps

AXES = ("x", "y")
LEAST_STEPS = 3
STEPS_MAX = 400
"""More steps than this teach nothing more."""
WINDOW_S = 0.02
"""What comes later after a step says nothing of the servo."""
STILL = 0.02
"""A mirror that moves by less than this share of what was asked does not move."""
GAIN_OFF = 0.25
LEAST_NOISE = 1e-4


@dataclass(frozen=True, eq=False)
class Piece:
    """One run of one mirror: what it was told, and its measured angles value_rad at t_s, [m].

    noise_rad: rms of a sample, found where the mirror rests; runs may be measured on ranges of their own
    """

    steps: Steps
    t_s: FloatArray
    value_rad: FloatArray
    noise_rad: float

    def __post_init__(self) -> None:
        freeze_arrays(self)


@dataclass(frozen=True, eq=False)
class Trace:
    """All runs of one mirror. axis: 0 is x; spacing_s: between samples."""

    axis: int
    pieces: tuple[Piece, ...]
    spacing_s: float

    @property
    def noise_rad(self) -> float:
        """Rms noise of all samples, rad."""
        squares = sum(piece.noise_rad**2 * len(piece.t_s) for piece in self.pieces)
        return float(np.sqrt(squares / sum(len(piece.t_s) for piece in self.pieces)))

    @property
    def steps_rad(self) -> FloatArray:
        """Sizes of all steps, [k]."""
        return np.concatenate([piece.steps.sizes_rad for piece in self.pieces])


def trace_of(where: str, measurement: Measurement, axis: int) -> Trace:
    """What a recording says of mirror x or y; InputError, naming `where`, for one that says too little or is wrong."""
    name = f"mirror_{AXES[axis]}_rad"
    runs = [run for run in measurement.runs if name in run.signals and run.commands is not None and len(run.commands)]
    if not runs:
        raise InputError(f"{where}: {name}", None, "a run with this signal and commands: the mirror's measured angle")
    room, pieces = STEPS_MAX, []
    for run in runs:
        piece = _piece(run, axis, room)
        if piece is not None:
            pieces.append(piece)
            room -= len(piece.steps.sizes_rad)
    steps = sum(len(piece.steps.sizes_rad) for piece in pieces)
    if steps < LEAST_STEPS:
        raise InputError(f"{where}: {name}", f"{steps} steps of {AXES[axis]} in commands", f"at least {LEAST_STEPS}")
    _check_it_follows(f"{where}: {name}", runs, axis)
    spacing_s = float(np.median(np.concatenate([np.diff(piece.t_s) for piece in pieces])))
    return Trace(axis, tuple(pieces), spacing_s)


def _piece(run: Run, axis: int, room: int) -> Piece | None:
    """The first steps of a run while there is room, and the samples near them; None for a run without a step."""
    signal, commands = run.signals[f"mirror_{AXES[axis]}_rad"], run.commands
    assert commands is not None  # noqa: S101
    known = np.isfinite(signal.value)
    t_s, value_rad = signal.t_s[known], signal.value[known]
    at_s, command_rad = commands[:, 0], commands[:, 1 + axis]
    changed = np.flatnonzero(np.diff(command_rad) != 0.0) + 1
    if not len(changed) or not len(t_s):
        return None
    end_s = at_s[changed[room]] if len(changed) > room else np.inf
    changed = changed[: max(0, room)]
    changed = changed[at_s[changed] < t_s[-1]]
    if not len(changed):
        return None
    steps = Steps(at_s[[0, *changed]], command_rad[[0, *changed]])
    begun = np.searchsorted(steps.at_s[1:], t_s, side="right")
    since_s = t_s - np.concatenate([[steps.at_s[1] - WINDOW_S], steps.at_s[1:]])[begun]
    near = (since_s <= WINDOW_S) & (since_s >= 0.0) & (t_s < end_s)
    t_s, value_rad = t_s[near], value_rad[near]
    return Piece(steps, t_s, value_rad, _noise_rad(steps, t_s, value_rad)) if len(t_s) > 2 else None


def _resting(at_s: FloatArray, t_s: FloatArray) -> FloatArray:
    """The command's row at samples late in their hold, −1 at others, [m]."""
    row = np.clip(np.searchsorted(at_s, t_s, side="right") - 1, 0, None)
    end_s = np.append(at_s[1:], max(t_s[-1], at_s[-1]))
    late = t_s >= at_s[row] + 0.75 * (end_s[row] - at_s[row])
    chosen: FloatArray = np.where(late, row, -1)
    return chosen


def _check_it_follows(where: str, runs: list[Run], axis: int) -> None:
    """Refuse a mirror that stands still, goes the other way, follows the other's commands, or is in other units."""
    asked, seen = [], []
    for run in runs:
        signal, commands = run.signals[f"mirror_{AXES[axis]}_rad"], run.commands
        assert commands is not None  # noqa: S101
        row = _resting(commands[:, 0], signal.t_s)
        good = (row >= 0) & np.isfinite(signal.value)
        asked.append(commands[row[good], 1:])
        seen.append(signal.value[good])
    told, value = np.concatenate(asked), np.concatenate(seen)
    if not len(value) or not np.any(np.ptp(told, axis=0)):
        return
    told, value = told - told.mean(axis=0), value - value.mean()
    spread = np.sqrt((told**2).mean(axis=0))
    alike = abs((told[:, 0] * told[:, 1]).mean()) > 0.99 * spread[0] * spread[1]
    gains = np.zeros(2)
    if alike and spread[axis] > 0.0:
        gains[axis] = (told[:, axis] @ value) / (told[:, axis] @ told[:, axis])
    else:
        gains = np.linalg.lstsq(told, value, rcond=None)[0]
    own, other = float(gains[axis]), float(gains[1 - axis])
    mine, theirs = AXES[axis], AXES[1 - axis]
    found = f"{own:.2g} of the {mine} commands and {other:.2g} of the {theirs} commands"
    if abs(other) > max(0.5, abs(own)):
        raise InputError(where, found, f"a mirror that follows {mine}_rad: axes exchanged")
    if not spread[axis]:
        return
    if abs(own) < STILL:
        raise InputError(where, found, "a mirror that moves when it is told to: it stands still")
    if own < 0.0:
        raise InputError(where, found, f"an angle that rises with {mine}_rad: axis inverted")
    if abs(own - 1.0) > GAIN_OFF:
        unit = ": degrees?" if 40.0 < own < 75.0 else ": optical angles?" if 1.7 < own < 2.3 else ""
        raise InputError(
            where, found, f"the mirror's mechanical angle in rad, within {GAIN_OFF:.0%} of the command{unit}"
        )


def _noise_rad(steps: Steps, t_s: FloatArray, value_rad: FloatArray) -> float:
    """Rms noise of a sample, from second differences late in each hold; at the least LEAST_NOISE of a step."""
    row = _resting(steps.at_s, t_s)
    rough = np.abs(np.diff(value_rad, 2)[(row[:-2] == row[2:]) & (row[:-2] >= 0)])
    found_rad = 1.4826 * float(np.median(rough)) / np.sqrt(6.0) if len(rough) else 0.0
    return max(found_rad, LEAST_NOISE * float(steps.sizes_rad.mean()))
