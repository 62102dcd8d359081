"""Disturbances of an instrument in one signal: a line, hops of its zero, and a drift of its zero over the recording.

Theory of operation

Problem. What an instrument adds to a signal makes repeats differ, so a noise model that is estimated from repeats
absorbs it, or it is equal in all runs and looks like an effect of the pixel. Neither is true.

Line. A sinusoid of one frequency and one amplitude, of any phase in every run. Noise that oscillates is told from it by
its amplitude, which differs from run to run as a Rayleigh distribution does; a ringing membrane and a rippling laser by
the power of the pulses, which their amplitude follows. So a frequency is sought at which the spectrum of the residuals
exceeds its neighbourhood in every group of runs, with nearly equal amplitudes.

Hops. Steps of the zero within a few samples, at times that differ between repeats, and in no other signal of the run:
what happens in the pixel or in the laser shows in all of them. Differences of means before and after are compared with
their own median in the same run, so that slow noise of any spectrum passes.

Drift. A smooth change of the zero, before the first pulse of each run, over the recording. That of the thermometer is a
cause in the catalogue, the ambient temperature.

All are subtracted from the data, and the diagnosis goes on without them.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import f as f_distribution

from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.discrepancy import InstrumentDisturbance
from optodrive.lab.diagnosis.dataset import PIXEL_KINDS, SIGNALS, Block, BoolArray, Dataset
from optodrive.lab.diagnosis.fitting import JitterSensitivity
from optodrive.lab.diagnosis.noise_model import NoiseModel, estimate_resolution, whiten
from optodrive.lab.diagnosis.replicate_contrasts import Contrast, compute_contrasts

MIN_SAMPLES = 32
MIN_CYCLES = 2.0
"""Cycles of a line within a run in which it is sought."""
NEIGHBOURHOOD = (6, 9, 12, 15, 18, 21, 24)
"""Offsets, in quarters of a run's frequency resolution, at which the spectrum beside a line is taken."""
MIN_LINE_RATIO, LINE_RATIO_BY_RUN, MIN_GROUP_RATIO = 7.0, 24.0, 4.0
"""Smallest mean ratio of a line to the spectrum beside it, what fewer runs add to it, and the smallest in a group."""
MIN_EVENNESS = 0.92
"""Smallest squared mean of the amplitudes over their mean square: 0.79 for noise, 1 for a line."""
MIN_LINE_RUNS, MAX_LINES, MAX_PEAKS, PEAK_WIDTH = 4, 4, 6, 2.0
"""Smallest number of runs, largest ones of lines and of peaks that are tried, half width of a peak in resolutions."""
HOP_WINDOWS, MIN_HOP_SAMPLES = (6, 24), 60
SINGLE_HOP, PAIR_HOP, MORE_HOPS = 6.5, 5.5, 5.0
"""Smallest hop in robust σ of differences of means: of one run alone, of two runs, and of others beside them."""
HOP_ABRUPTNESS, QUICK = 0.6, 3
"""Share of a hop within that many samples."""
JITTER, JITTER_LEFT = (0.02, 1e-4), (1e-3, 1e-5)
"""Jitter of power, relative, and of time, s: a priori, and left where it is subtracted, as steps at edges of pulses."""
OTHER_SIGMAS, OTHER_USUAL = 4.5, 1.5
"""Largest change of another signal at a hop, in robust σ, and relative to what nine in ten of its samples have."""
HOP_SETTLED_S = 0.02
"""Time after a pulse from which a signal that was measured alone can hop."""
MAX_HOPS = 60
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
            line = _find_line(data, residual - added, kind)
            if line is None:
                break
            found.append(line[0])
            added += line[1]
    hops, steps = _find_hops(data, residual - added, sensitivity, noise)
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


def _find_resolution(data: Dataset, kind: int) -> float:
    """Return the standard deviation that quantisation gives to samples of one kind of signal."""
    values = np.concatenate([data.value[block.part] for block in data.blocks if block.kind == kind])
    return estimate_resolution(values, float(np.ptp(values)))


def _list_even_blocks(data: Dataset, kind: int) -> list[tuple[Block, float, FloatArray]]:
    """Return the blocks of one kind that are sampled evenly but for gaps, with their step, s, and sample numbers."""
    out = []
    for block in data.blocks:
        if block.kind == kind and len(block.t_s) >= MIN_SAMPLES:
            dt_s = float(np.median(np.diff(block.t_s)))
            number = (block.t_s - block.t_s[0]) / dt_s
            if np.abs(number - np.round(number)).max() < 0.2:
                out.append((block, dt_s, np.round(number)))
    return out


def _find_line(data: Dataset, residual: FloatArray, kind: int) -> tuple[InstrumentDisturbance, FloatArray] | None:
    """Return the strongest line in one kind of signal and its values [m], or None."""
    blocks = _list_even_blocks(data, kind)
    if len(blocks) < MIN_LINE_RUNS:
        return None
    spans_s = [float(block.t_s[-1] - block.t_s[0]) for block, _, _ in blocks]
    longest_s, shortest_s = max(spans_s), min(spans_s)
    grid_hz = np.arange(MIN_CYCLES / longest_s, 0.45 / min(dt_s for _, dt_s, _ in blocks), 0.25 / longest_s)
    ratios = np.full((len(blocks), len(grid_hz)), np.nan)
    for row, (block, dt_s, number) in enumerate(blocks):
        span_s = float(block.t_s[-1] - block.t_s[0])
        is_inside = (grid_hz >= MIN_CYCLES / span_s) & (grid_hz <= 0.45 / dt_s)
        own_hz, ratio = _compute_spectral_ratio(residual[block.part], number.astype(int), dt_s)
        ratios[row, is_inside] = np.interp(grid_hz[is_inside], own_hz, ratio)
    counts = np.isfinite(ratios).sum(axis=0)
    is_possible = counts >= MIN_LINE_RUNS
    if not is_possible.any():
        return None
    mean = np.where(is_possible, np.nansum(ratios, axis=0) / np.maximum(counts, 1), 0.0)
    excess = mean - LINE_RATIO_BY_RUN / np.maximum(counts, 1)
    for _ in range(MAX_PEAKS):
        at = int(np.argmax(excess))
        if excess[at] < MIN_LINE_RATIO:
            return None
        seen = [(row, item[0]) for row, item in enumerate(blocks) if np.isfinite(ratios[row, at])]
        by_group: dict[str, list[float]] = {}
        for row, block in seen:
            by_group.setdefault(data.runs[block.run].group, []).append(float(ratios[row, at]))
        if min(np.mean(values) for values in by_group.values()) >= MIN_GROUP_RATIO:
            line = _fit_line(data, residual, kind, [block for _, block in seen], float(grid_hz[at]), longest_s)
            if line is not None:
                return line
        excess[np.abs(grid_hz - grid_hz[at]) < PEAK_WIDTH / shortest_s] = -np.inf
    return None


def _compute_spectral_ratio(values: FloatArray, number: FloatArray, dt_s: float) -> tuple[FloatArray, FloatArray]:
    """Return frequencies and the spectrum there, relative to its neighbourhood."""
    length = int(number[-1]) + 1
    window = np.hanning(length + 2)[1:-1]
    even = np.zeros(length)
    even[number] = values - values.mean()
    spectrum = np.abs(np.fft.rfft(even * window, 4 * length)) ** 2
    padded = np.pad(spectrum, NEIGHBOURHOOD[-1], mode="reflect")
    beside = np.stack(
        [
            padded[NEIGHBOURHOOD[-1] + sign * offset : NEIGHBOURHOOD[-1] + sign * offset + len(spectrum)]
            for offset in NEIGHBOURHOOD
            for sign in (-1, 1)
        ]
    )
    level = np.median(beside, axis=0) / np.log(2.0)
    return np.asarray(np.fft.rfftfreq(4 * length, dt_s)), np.asarray(spectrum / np.maximum(level, 1e-300))


def _fit_line(
    data: Dataset, residual: FloatArray, kind: int, blocks: list[Block], start_hz: float, longest_s: float
) -> tuple[InstrumentDisturbance, FloatArray] | None:
    """Return the line near a frequency and its values [m], or None if its amplitude differs from run to run."""

    def fit_all(hz: float) -> tuple[float, list[complex]]:
        amplitudes = [_fit_sinusoid(block.t_s, residual[block.part], hz) for block in blocks]
        energy = sum(abs(item) ** 2 * len(block.t_s) for item, block in zip(amplitudes, blocks, strict=True))
        return float(energy), amplitudes

    trials_hz = start_hz + np.linspace(-0.5, 0.5, 41) / longest_s
    best_hz = max(trials_hz.tolist(), key=lambda hz: fit_all(hz)[0])
    sizes = np.abs(fit_all(best_hz)[1])
    if float(sizes.mean() ** 2 / (sizes**2).mean()) < MIN_EVENNESS:
        return None
    amplitude = float(np.sqrt((sizes**2).mean()))
    if amplitude < _find_resolution(data, kind):
        return None
    added = np.zeros(len(residual))
    for block in data.blocks:
        if block.kind != kind or (block.t_s[-1] - block.t_s[0]) * best_hz < 1.0:
            continue
        number = _fit_sinusoid(block.t_s, residual[block.part], best_hz)
        phase = 2.0 * np.pi * best_hz * block.t_s
        scale = amplitude / max(abs(number), 1e-300)
        added[block.part] = scale * (number.real * np.cos(phase) + number.imag * np.sin(phase))
    return InstrumentDisturbance(SIGNALS[kind], "line", amplitude, best_hz, len(blocks)), added


def _fit_sinusoid(t_s: FloatArray, values: FloatArray, hz: float) -> complex:
    """Return the coefficients of cosine and sine, beside a straight line."""
    phase = 2.0 * np.pi * hz * t_s
    centred = t_s - t_s.mean()
    columns = np.column_stack([np.cos(phase), np.sin(phase), np.ones(len(t_s)), centred / max(np.ptp(t_s), 1e-300)])
    gram = columns.T @ columns
    solved = np.linalg.solve(gram + 1e-9 * np.trace(gram) * np.eye(4), columns.T @ values)
    return complex(solved[0], solved[1])


def _find_hops(
    data: Dataset, residual: FloatArray, sensitivity: JitterSensitivity, noise: NoiseModel
) -> tuple[list[InstrumentDisturbance], FloatArray]:
    """Return the hops of each kind of signal and their values [m]."""
    added = np.zeros(len(residual))
    hops: dict[int, list[tuple[Block, int, float, float]]] = {}
    for _ in range(MAX_HOPS):
        min_scores = {kind: MORE_HOPS if _are_certain(hops.get(kind, [])) else PAIR_HOP for kind in PIXEL_KINDS}
        hop = _find_largest_hop(data, residual - added, sensitivity, noise, min_scores)
        if hop is None:
            break
        block, first, size, _ = hop
        added[block.part.start + first : block.part.stop] += size
        hops.setdefault(block.kind, []).append(hop)
    found = []
    for kind, some in sorted(hops.items()):
        if _are_certain(some):
            runs = len({block.run for block, _, _, _ in some})
            size = float(np.median([abs(size) for _, _, size, _ in some]))
            found.append(InstrumentDisturbance(SIGNALS[kind], "hops", size, None, runs))
            continue
        for block, first, size, _ in some:
            added[block.part.start + first : block.part.stop] -= size
    return found, added


def _are_certain(hops: list[tuple[Block, int, float, float]]) -> bool:
    """Return whether two runs hop, or one so much that noise alone does not reach it."""
    return len({block.run for block, _, _, _ in hops}) > 1 or any(score >= SINGLE_HOP for _, _, _, score in hops)


def _find_largest_hop(
    data: Dataset,
    residual: FloatArray,
    sensitivity: JitterSensitivity,
    noise: NoiseModel,
    min_scores: dict[int, float],
) -> tuple[Block, int, float, float] | None:
    """Return the block, the first sample, the size and the score of the most significant hop, or None.

    min_scores: score of a hop, by kind of signal
    """
    contrasts = [
        item
        for item in compute_contrasts(data, residual, sensitivity.power, sensitivity.timing)
        if item.kind in PIXEL_KINDS and len(item.t_s) >= MIN_HOP_SAMPLES
    ]
    best: tuple[float, Contrast, float] | None = None
    scores = _score_hops(contrasts, noise, {kind: _find_resolution(data, kind) for kind in data.kinds})
    for item, own in zip(contrasts, scores, strict=True):
        for at in np.flatnonzero(own.is_abrupt & (own.score > min_scores[item.kind])):
            found = float(own.score[at]), item, float(own.t_s[at])
            if (best is None or found[0] > best[0]) and _is_alone(data, item, found[2], contrasts, scores):
                best = found
    if best is None:
        return None
    score, item, time_s = best
    group = data.runs[data.blocks[item.block].run].group
    members = [
        block
        for block in data.blocks
        if block.kind == item.kind
        and block.pixel == data.blocks[item.block].pixel
        and data.runs[block.run].group == group
    ]
    steps = [(*_measure_step(block, residual[block.part], time_s), block) for block in members]
    first, size, block = max(steps, key=lambda step: abs(step[1]))
    return (block, first, size, score) if size else None


@dataclass(frozen=True, eq=False)
class _HopScores:
    """Times [k], differences of means there in robust σ, and whether these come within three samples."""

    t_s: FloatArray
    score: FloatArray
    is_abrupt: BoolArray


def _score_hops(contrasts: list[Contrast], noise: NoiseModel, resolutions: dict[int, float]) -> list[_HopScores]:
    """Return the scores of each contrast.

    Their σ is the median of contrasts that are sampled alike.

    resolutions: by kind of signal, below which σ does not fall
    """
    every = [_subtract_jitter(item, noise) for item in contrasts]
    kinds = [(item.kind, round(np.log2(float(np.median(np.diff(item.t_s)))))) for item in contrasts]
    scores = [_HopScores(item.t_s, np.zeros(len(item.t_s)), np.zeros(len(item.t_s), dtype=bool)) for item in contrasts]
    for width in HOP_WINDOWS:
        changes = [_compute_changes(values, width) for values in every]
        for kind in set(kinds):
            members = [row for row, other in enumerate(kinds) if other == kind]
            spreads = [float(np.median(np.abs(changes[row]))) for row in members if len(changes[row])]
            spread = max(1.4826 * float(np.median(spreads or [0.0])), resolutions[kind[0]])
            for row in members:
                rows = np.arange(width, width + len(changes[row]))
                jitter = [_compute_changes(column, width) for column in contrasts[row].jitter.T[:2]]
                left = [share * change for share, change in zip(JITTER_LEFT, jitter, strict=True)]
                ratio = np.abs(changes[row]) / np.sqrt(spread**2 + left[0] ** 2 + left[1] ** 2)
                quick = _compute_changes(every[row], QUICK)[rows - QUICK] * np.sign(changes[row])
                is_larger = ratio > scores[row].score[rows]
                scores[row].score[rows[is_larger]] = ratio[is_larger]
                is_abrupt = quick > HOP_ABRUPTNESS * np.abs(changes[row])
                scores[row].is_abrupt[rows[is_larger]] = is_abrupt[is_larger]
    return scores


def _subtract_jitter(item: Contrast, noise: NoiseModel) -> FloatArray:
    """Return the values of a contrast without their jitters, as estimated under its coloured noise."""
    size = np.array(JITTER)
    columns = np.column_stack([item.value, item.jitter[:, :2] * size, np.ones(len(item.value))])
    whitened, _ = whiten(item.t_s, columns, noise.coloured[item.kind])
    gram = whitened.T @ whitened
    solved = np.linalg.solve(gram[1:, 1:] + np.diag([1.0, 1.0, 1e-9 * gram[3, 3]]), gram[1:, 0])
    return np.asarray(item.value - columns[:, 1:] @ solved)


def _compute_changes(values: FloatArray, width: int) -> FloatArray:
    """Return the mean of as many samples from each on, less that of as many before it, from sample `width` on."""
    total = np.concatenate([[0.0], np.cumsum(values)])
    rows = np.arange(width, len(values) - width + 1)
    return np.asarray((total[rows + width] - 2.0 * total[rows] + total[rows - width]) / width)


def _is_alone(
    data: Dataset, item: Contrast, time_s: float, contrasts: list[Contrast], scores: list[_HopScores]
) -> bool:
    """Return whether no other signal of the same runs changes at that time."""
    others = [
        own for other, own in zip(contrasts, scores, strict=True) if other.pair == item.pair and other.kind != item.kind
    ]
    reach_s = HOP_WINDOWS[-1] * float(np.median(np.diff(item.t_s)))
    for own in others:
        near = own.score[np.abs(own.t_s - time_s) <= reach_s]
        usual = OTHER_USUAL * float(np.quantile(own.score, 0.9))  # large where pulses differ by more than jitter
        if float(near.max(initial=0.0)) > max(OTHER_SIGMAS, usual):
            return False
    if others:
        return True
    pulses = data.runs[data.blocks[item.block].run].pulses
    return not bool(((pulses[:, 0] - reach_s < time_s) & (time_s < pulses[:, 0] + pulses[:, 1] + HOP_SETTLED_S)).any())


def _measure_step(block: Block, residual: FloatArray, time_s: float) -> tuple[int, float]:
    """Return the first sample after a step near a time, and its size."""
    middle = int(np.searchsorted(block.t_s, time_s))
    narrow, wide = HOP_WINDOWS
    changes = np.abs(_compute_changes(residual, narrow))
    first, last = max(middle - 2 * narrow, 0), min(middle + 1, len(changes))
    if first >= last:
        return middle, 0.0
    at = narrow + first + int(np.argmax(changes[first:last]))
    after, before = residual[at : at + wide], residual[max(at - wide, 0) : at]
    return at, float(after.mean() - before.mean())


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
    if p_value > MAX_DRIFT_P or span < _find_resolution(data, kind):
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
    return float(f_distribution.sf(ratio, degree, degrees)), fitted
