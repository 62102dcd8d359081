"""Periodic excitations of coupled axes in steady state: several realisations at several amplitudes.

Every line's matrix of a linear response comes from the lines around it by local polynomials (Pintelon and Schoukens,
System Identification, 2012, chapter 7), weighted by 1/√A, with A the rms of the drive.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from optodrive.core.errors import MISSING, InputError
from optodrive.core.types.arrays import BoolArray, FloatArray, IntArray, ReadOnlyArrays
from optodrive.lab.servo_identification.effect_fit import ServoRecord

HALF_WINDOW, DEGREE = 5, 2
"""Lines on either side of a local polynomial, and its degree."""
EXCITED_SHARE = 1e-3
"""Lines with less than this share of the largest mean power are not excited."""
DIAGONAL_SHARE = 0.95
"""Axes are decoupled if each output's own input explains this share of its power."""


@dataclass(frozen=True, eq=False)
class PeriodicResponses(ReadOnlyArrays):
    """Steady-state periods, averaged.

    u: [n, i, r]; y: [n, o, r]; level: [r] rms of the drive; held_out: [r]; noise: rms of a sample of y;
    angle_per_output: [2, o], rad of mirrors x and y per unit of each output
    """

    sample_rate_hz: float
    u: FloatArray
    y: FloatArray
    level: FloatArray
    held_out: BoolArray
    noise: float
    angle_per_output: FloatArray | None = None


def read_responses(path: Path, sample_rate_hz: float) -> PeriodicResponses:
    """Read u_NAME and y_NAME [n, channels, realisations, periods] of every NAME, the last realisation held out."""
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: np.asarray(file[name], dtype=np.float64) for name in file.files}
    except (OSError, ValueError) as error:
        raise InputError(str(path), type(error).__name__, "an .npz file of numbers") from None
    names = sorted(name[2:] for name in arrays if name.startswith("u_"))
    if not names:
        expected = "arrays u_NAME and y_NAME, [samples, channels, realisations, periods]"
        raise InputError(f"{path}: u_NAME", MISSING, expected)
    u, y, held_out, differences = [], [], [], []
    for name in names:
        drive, answer = arrays[f"u_{name}"], arrays.get(f"y_{name}")
        is_whole = answer is not None and answer.ndim == drive.ndim == 4 and answer.shape[::2] == drive.shape[::2]
        if answer is None or not is_whole or len(answer) < 64:
            shape = MISSING if answer is None else answer.shape
            expected = f"the shape of u_{name} {drive.shape} but for channels: four axes"
            raise InputError(f"{path}: y_{name}", shape, expected)
        if not np.isfinite(drive).all() or not np.isfinite(answer).all() or drive.shape[2] < 2 or answer.shape[3] < 2:
            expected = "finite, at least 2 realisations and 2 periods"
            raise InputError(f"{path}: u_{name}, y_{name}", drive.shape, expected)
        u.append(drive.mean(axis=3))
        y.append(answer.mean(axis=3))
        held_out += [False] * (drive.shape[2] - 1) + [True]
        differences.append(np.var(answer - answer.mean(axis=3, keepdims=True), ddof=0) / (answer.shape[3] - 1))
    if len({(each.shape[0], each.shape[1]) for each in u}) > 1 or len({each.shape[1] for each in y}) > 1:
        expected = "the same samples and channels at every amplitude"
        raise InputError(f"{path}: u_NAME", [each.shape for each in u], expected)
    drives = np.concatenate(u, axis=2)
    level = np.sqrt((drives**2).mean(axis=(0, 1)))
    noise = float(np.sqrt(np.mean(differences)))
    outputs = np.concatenate(y, axis=2)
    angle = arrays.get("angle_per_output")
    if angle is not None and (angle.shape != (2, outputs.shape[1]) or not np.isfinite(angle).all()):
        raise InputError(f"{path}: angle_per_output", angle.shape, f"finite, [2, {outputs.shape[1]}]")
    return PeriodicResponses(sample_rate_hz, drives, outputs, level, np.array(held_out), noise, angle)


def fit_response(responses: PeriodicResponses, rows: BoolArray) -> Any:
    """Return one linear response to the realisations in rows, [lines, o, i], complex, 0 where nothing was excited."""
    weight = responses.level[rows] ** -0.5
    x, y = (np.fft.rfft(each[:, :, rows], axis=0) * weight for each in (responses.u, responses.y))
    lines = find_excited_lines(responses)
    x_h = np.conj(x[lines].transpose(0, 2, 1))
    moments, products = x[lines] @ x_h, y[lines] @ x_h
    count, size = len(lines), x.shape[1]
    wide = size * (DEGREE + 1)
    left, right = np.zeros((count, wide, wide), complex), np.zeros((count, y.shape[1], wide), complex)
    for shift in range(-HALF_WINDOW, HALF_WINDOW + 1):
        inside = np.flatnonzero((np.arange(count) + shift >= 0) & (np.arange(count) + shift < count))
        share = 1.0 - abs(shift) / (HALF_WINDOW + 1)
        powers = (shift / HALF_WINDOW) ** np.arange(DEGREE + 1)
        weights = (share * np.outer(powers, powers))[None, :, None, :, None]
        block = moments[inside + shift][:, None, :, None, :] * weights
        left[inside] += block.reshape(len(inside), wide, wide)
        right[inside] += np.concatenate([share * power * products[inside + shift] for power in powers], axis=2)
    ridge = 1e-12 * np.einsum("lii->l", left).real[:, None, None] * np.eye(wide)
    solved = np.linalg.solve((left + ridge).transpose(0, 2, 1), right.transpose(0, 2, 1)).transpose(0, 2, 1)
    response = np.zeros((len(x), y.shape[1], size), complex)
    response[lines] = solved[:, :, :size]
    return response


def find_excited_lines(responses: PeriodicResponses) -> IntArray:
    """Return the lines that the drives excite, [l]."""
    power = (np.abs(np.fft.rfft(responses.u, axis=0)) ** 2).mean(axis=(1, 2))
    return np.flatnonzero(power > EXCITED_SHARE * power.max())


def is_coupled(responses: PeriodicResponses) -> bool:
    """Return whether an output depends on more than its own input."""
    if responses.u.shape[1] != responses.y.shape[1]:
        return True
    gains = np.abs(fit_response(responses, ~responses.held_out)) ** 2
    power = np.einsum("loi->oi", gains)
    return bool((np.diag(power) < DIAGONAL_SHARE * power.sum(axis=1)).any())


def build_records(responses: PeriodicResponses, axis: int) -> tuple[list[ServoRecord], float]:
    """Return the records of a decoupled axis, the second of two periods compared, and a rough bandwidth, rad/s."""
    n, rate_hz = len(responses.u), responses.sample_rate_hz
    t_s = np.arange(2 * n) / rate_hz
    records = []
    for row, held_out in enumerate(responses.held_out):
        u, y = (np.tile(each[:, axis, row], 2) for each in (responses.u, responses.y))
        use = (np.arange(2 * n) >= n) & (np.arange(2 * n) % max(1, n // 8000) == 0)
        level = float(responses.level[row])
        records.append(ServoRecord(t_s, u, t_s, y, use, bool(held_out), responses.noise, level))
    gain = np.abs(fit_response(responses, ~responses.held_out)[:, axis, axis])
    gain = np.convolve(gain, np.ones(9) / 9.0, "same")
    lines = np.flatnonzero(gain > 0.0)
    static = float(np.median(gain[lines[: max(3, len(lines) // 50)]]))
    below = lines[gain[lines] < 0.7 * static]
    line = int(below[0]) if len(below) else int(lines[-1])
    return records, 2.0 * np.pi * line * rate_hz / n
