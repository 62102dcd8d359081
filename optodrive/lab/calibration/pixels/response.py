"""One run's answer: how high a pixel stood, against what the model says of just these pulses."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.measurements import Run

SIGNAL = "displacement_m"
Predict = Callable[[FloatArray, int, FloatArray], FloatArray]
"""Heights of a pixel, m, at times [m] under pulses [n, 4]."""
SAMPLES_LEAST = 8
ROUNDS = 5
FAR = 5.0
"""A sample so many sigmas off the rest is left out."""
NORMAL = 1.4826
"""Sigma over the median distance, of normal noise."""
BEST = 1e-4
"""No response is believed better than this."""
FEELS_M = 1e-7
"""A run whose pulses lift the model's pixel by less says nothing of its gain."""


class Response(NamedTuple):
    """value: measured over predicted, one standard uncertainty sigma; aim: where the beam was sent, from the middle."""

    pixel: int
    aim_x_m: float
    aim_y_m: float
    value: float
    sigma: float


def response_of(where: str, run: Run, predict: Predict, aim_most_m: tuple[float, float]) -> Response | None:
    """The response that a run shows; None without heights, pulses on the pixel, or enough samples.

    InputError for an aim that is no number, or farther off than aim_most_m.
    """
    x_m, y_m = (_aim_m(where, run, axis, most_m) for axis, most_m in zip("xy", aim_most_m, strict=True))
    signal = run.signals.get(SIGNAL)
    if signal is None:
        return None
    kept = np.isfinite(signal.value)
    if int(kept.sum()) < SAMPLES_LEAST or not np.any(run.pulses[:, 3] == signal.pixel):
        return None
    shape_m = predict(run.pulses, signal.pixel, np.array(signal.t_s[kept]))
    if np.ptp(shape_m) < FEELS_M:
        return None
    found = _share(shape_m, signal.value[kept])
    return None if found is None else Response(signal.pixel, x_m, y_m, *found)


def _share(shape_m: FloatArray, value_m: FloatArray) -> tuple[float, float] | None:
    """The factor on a shape, beside an unknown zero of the instrument, and its sigma; without samples far off."""
    kept = np.ones(len(value_m), dtype=np.bool_)
    design = np.column_stack([shape_m, np.ones(len(shape_m))])
    for _ in range(ROUNDS):
        solution = np.linalg.lstsq(design[kept], value_m[kept], rcond=None)[0]
        left_m = value_m - design @ solution
        typical_m = NORMAL * float(np.median(np.abs(left_m[kept])))
        again = np.abs(left_m) <= FAR * typical_m if typical_m > 0.0 else kept
        if np.array_equal(again, kept):
            break
        kept = again
    count = int(kept.sum())
    if count < SAMPLES_LEAST or np.ptp(shape_m[kept]) < FEELS_M:
        return None
    variance = float((left_m[kept] ** 2).sum()) / (count - 2)
    spread = float(((shape_m[kept] - shape_m[kept].mean()) ** 2).sum())
    value = float(solution[0])
    return value, float(np.hypot(np.sqrt(variance / spread), BEST * max(1.0, abs(value))))


def _aim_m(where: str, run: Run, axis: str, most_m: float) -> float:
    key = f"aim_{axis}_m"
    given = run.attributes.get(key, 0.0)
    if isinstance(given, str) or not abs(given) <= most_m:
        expected = f"a number of metres from the pixel's middle, {most_m:.6g} either way at most"
        raise InputError(f"{where}: /runs/{run.name}: {key}", given, expected)
    return float(given)
