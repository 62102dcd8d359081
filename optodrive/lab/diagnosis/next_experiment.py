"""The experiment that separates two rivals most per second of lab time, over a finite grid of what a display can do."""

from collections import Counter
from collections.abc import Iterator
from math import ceil

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.discrepancy import NextExperiment
from optodrive.lab.diagnosis.dataset import PIXEL_KINDS, SIGNALS, Alike, Block, Dataset, RunInfo
from optodrive.lab.diagnosis.fitting import Fit, Problem, jitter, slopes
from optodrive.lab.diagnosis.normal_equations import normal, solve
from optodrive.lab.diagnosis.prediction import predict
from optodrive.physics.pixel_ode import Scene

REPEATS, MOST = 3, 30
"""How often an experiment is done, at least and at most."""
ENOUGH = 24.0
"""χ² between rivals that tells them apart."""
SETUP_S = 2.0
"""Between two runs."""
SAMPLES = 400


def next_experiment(problem: Problem, first: Fit, second: Fit, labels: tuple[str, str]) -> NextExperiment | None:
    """The most telling run of the grid, repeated until it tells; None where no signal is measured, or none would."""
    data = problem.data
    kinds = tuple(kind for kind in data.kinds() if kind in PIXEL_KINDS)
    if not kinds:
        return None
    pixel = Counter(block.pixel for block in data.blocks if block.kind in PIXEL_KINDS).most_common(1)[0][0]
    best: NextExperiment | None = None
    for why, pulses, span_s in _grid(data, pixel):
        imagined = _imagined(pulses, pixel, span_s, kinds)
        once = _separation(problem, first, second, imagined, REPEATS) / REPEATS
        repeats = max(REPEATS, ceil(min(ENOUGH / max(once, 1e-9), MOST)))
        separation = _separation(problem, first, second, imagined, repeats)
        seconds = repeats * (span_s + SETUP_S)
        if separation < ENOUGH / 2 or (best is not None and seconds >= best.seconds):
            continue
        signals = tuple(SIGNALS[kind] for kind in kinds)
        text = f"{why}, {repeats} times, pixel {pixel} looked at: {labels[0]} and {labels[1]} differ there"
        best = NextExperiment(text, pulses, pixel, repeats, signals, separation, seconds)
    return best


def _grid(data: Dataset, pixel: int) -> Iterator[tuple[str, FloatArray, float]]:
    beside = next((other for other in _lit(data) if other != pixel), pixel + 1)
    full_w = max(scene.full_w for scene, _ in data.scenes)
    for power_w in (0.25 * full_w, 0.5 * full_w, full_w):
        for width_s in (0.002, 0.01, 0.05):
            for lit in (pixel, beside):
                where = "" if lit == pixel else f" on pixel {lit} beside it"
                pulses = np.array([[0.02, width_s, power_w, lit]])
                why = f"one pulse of {width_s * 1e3:g} ms at {power_w:.2f} W{where}"
                yield why, pulses, 0.02 + width_s + 0.25
        for gap_s in (0.02, 0.06):
            starts = 0.02 + np.arange(0.0, 3.0, 0.02 + gap_s)
            pulses = np.array([[start, 0.02, power_w, pixel] for start in starts])
            yield f"3 s of 20 ms pulses, {gap_s * 1e3:g} ms apart, at {power_w:.2f} W", pulses, 4.0


def _lit(data: Dataset) -> list[int]:
    """Pixels that got light, the most often lit first."""
    return [pixel for pixel, _ in Counter(int(lit) for run in data.runs for lit in run.pulses[:, 3]).most_common()]


def _imagined(pulses: FloatArray, pixel: int, span_s: float, kinds: tuple[int, ...]) -> Dataset:
    t_s = np.linspace(span_s / SAMPLES, span_s, SAMPLES)
    blocks = tuple(
        Block(0, kind, pixel, slice(row * SAMPLES, (row + 1) * SAMPLES), t_s) for row, kind in enumerate(kinds)
    )
    empty = np.zeros(0)
    times = tuple(t_s if kind in kinds else empty for kind in PIXEL_KINDS)
    scene = Scene(pulses, pixel, 293.15, (times[0], times[1], times[2]), dose_before=1.0, session=1.0)
    place = {kind: row for row, kind in enumerate(kinds)}
    rows = np.arange(SAMPLES)
    alike = Alike(scene, tuple((kind, place[kind], rows) for kind in kinds))
    places = (place.get(0, -1), place.get(1, -1), place.get(2, -1))
    info = RunInfo("next", "next", 293.15, pulses, None)
    return Dataset((info,), blocks, ((scene, places),), (alike,), np.zeros(SAMPLES * len(kinds)))


def _separation(problem: Problem, first: Fit, second: Fit, data: Dataset, repeats: int) -> float:
    """χ² between both predictions, what either could still be moved by taken out."""
    here = predict(data, first.point, problem.epsilon)
    there = predict(data, second.point, problem.epsilon)
    shared = jitter(data, first.point, problem.epsilon, here)
    imagined = Problem(data, problem.noise, problem.prior, problem.epsilon)
    own = slopes(imagined, first.point, first.free, here)
    other = slopes(imagined, second.point, second.free, there)
    columns = np.column_stack([own, other, here - there])
    gram = repeats * normal(data, columns, problem.noise, shared.power, shared.timing).total()
    count = columns.shape[1] - 1
    known = np.zeros((count, count))
    width = own.shape[1]
    known[:width, :width] = solve(first.covariance, np.eye(width))
    known[width:, width:] = solve(second.covariance, np.eye(count - width))
    cross = gram[:count, -1]
    return float(gram[-1, -1] - cross @ solve(gram[:count, :count] + known, cross))
