"""Disturbances of an instrument in one signal: a line, hops of its zero, and a drift of its zero over the recording.

Theory of operation

Problem. What an instrument adds to a signal makes repeats differ, so a noise model that is estimated from repeats
absorbs it, or it is equal in all runs and looks like an effect of the pixel. Neither is true.

Line. A sinusoid of one frequency and one amplitude, of any phase in every run. Noise that oscillates is told from it by
its amplitude, which differs from run to run as a Rayleigh distribution does; a ringing membrane and a rippling laser by
the power of the pulses, which their amplitude follows. So a frequency is sought at which the spectrum of the residuals
exceeds its neighbourhood in every group of runs, with nearly equal amplitudes.

Hops are sought in `instrument_hops.py`.

Drift. A smooth change of the zero, before the first pulse of each run, over the recording. That of the thermometer is a
cause in the catalogue, the ambient temperature.

All are subtracted from the data, and the diagnosis goes on without them.
"""

from dataclasses import replace

import numpy as np
from scipy.special import chdtrc, fdtrc

from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.discrepancy import InstrumentDisturbance
from optodrive.lab.diagnosis.dataset import PIXEL_KINDS, SIGNALS, Block, Dataset
from optodrive.lab.diagnosis.instrument_hops import find_hops
from optodrive.lab.diagnosis.noise_model import NoiseModel, find_resolution, whiten
from optodrive.lab.diagnosis.replicate_contrasts import JitterSensitivity
from optodrive.physics.term import BySignal

DRIFT_DEGREES, MAX_DRIFT_P, MIN_DRIFT_RUNS, MIN_QUIET_SAMPLES = (1, 3), 1e-6, 6, 4
"""Degrees of the polynomial of a drift, its largest p value, and the smallest number of runs and of samples in each."""

MAX_ZERO_P = 1e-4
"""Largest p value of zeros that differ from run to run."""


def find_disturbances(
    data: Dataset, residual: FloatArray, sensitivity: JitterSensitivity, noise: NoiseModel
) -> tuple[tuple[InstrumentDisturbance, ...], FloatArray]:
    """Return the disturbances of the pixel's signals, and their values in the data [m].

    residual: [m] of a nominal fit; noise: as estimated from the repeats, disturbances included
    """
    found: list[InstrumentDisturbance] = []
    added = np.zeros(len(residual))
    for kind in (kind for kind in data.kinds if kind in PIXEL_KINDS):
        # Each line is subtracted before the next is sought: a strong one raises its whole neighbourhood.
        for _ in range(MAX_LINES):
            line = find_line(data, residual - added, kind)
            if line is None:
                break
            found.append(line[0])
            added += line[1]
    # After the lines, whose slopes would look like hops, and before drifts, to which hops add up.
    hops, steps = find_hops(data, residual - added, sensitivity, noise)
    found += hops
    added += steps
    # Not of the thermometer, whose drift is the ambient temperature, a cause with its own term.
    for kind in (kind for kind in data.kinds if kind in PIXEL_KINDS[1:]):
        drift = _find_drift(data, residual - added, kind)
        if drift is not None:
            found.append(drift[0])
            added += drift[1]
    return tuple(found), added


def remove_disturbances(data: Dataset, added: FloatArray) -> Dataset:
    """Return the data without the values of the disturbances."""
    return replace(data, value=data.value - added)


def find_dc_coupled(data: Dataset, residual: FloatArray, noise: NoiseModel) -> frozenset[str]:
    """Return the names of the signals, as in `BySignal`, whose zero differs from run to run.

    Behind an AC coupling no zero differs by more than the noise of the sample from which it settles. The zero of a run
    is the generalised least squares mean of its residuals before the first pulse, so slow noise is no difference.
    """
    found = set()
    for kind in (kind for kind in data.kinds if kind in PIXEL_KINDS):
        rows = []
        for number, value in _list_quiet(data, residual, kind):
            columns = np.column_stack([np.ones(len(value)), value])
            whitened, _ = whiten(data.blocks[number].t_s[: len(value)], columns, noise.coloured[kind])
            weight = float(whitened[:, 0] @ whitened[:, 0])
            variance = 1.0 / weight + noise.coloured[kind].white ** 2
            rows.append((float(whitened[:, 0] @ whitened[:, 1]) / weight, 1.0 / variance))
        if len(rows) >= MIN_DRIFT_RUNS:
            zeros, weights = np.array(rows).T
            spread = float(weights @ (zeros - np.average(zeros, weights=weights)) ** 2)
            if chdtrc(len(rows) - 1, spread) < MAX_ZERO_P:
                found.add(BySignal._fields[kind])
    return frozenset(found)


def _list_quiet(data: Dataset, residual: FloatArray, kind: int) -> list[tuple[int, FloatArray]]:
    """Return the number of each block of a kind, with its residuals before the first pulse where there are enough."""
    quiet = []
    for number, block in enumerate(data.blocks):
        first_s = data.runs[block.run].pulses[:, 0].min(initial=np.inf)
        value = residual[block.part][block.t_s < first_s]
        if block.kind == kind and len(value) >= MIN_QUIET_SAMPLES:
            quiet.append((number, value))
    return quiet


def _find_drift(data: Dataset, residual: FloatArray, kind: int) -> tuple[InstrumentDisturbance, FloatArray] | None:
    """Return the drift of the zero of one kind of signal over the recording and its values [m], or None."""
    session = [recorded.session_time for recorded in data.recorded_runs]
    rows = [(session[number], float(value.mean())) for number, value in _list_quiet(data, residual, kind)]
    if len(rows) < MIN_DRIFT_RUNS:
        return None
    times, zeros = np.array(rows).T
    p_value, fitted = min((_fit_drift(times, zeros, degree) for degree in DRIFT_DEGREES), key=lambda item: item[0])
    span = float(np.ptp(fitted(times)))
    # Below the resolution it moves no sample.
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


def find_line(data: Dataset, residual: FloatArray, kind: int) -> tuple[InstrumentDisturbance, FloatArray] | None:
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
    # The mean of few ratios is large by chance.
    excess = mean - LINE_RATIO_BY_RUN / np.maximum(counts, 1)
    for _ in range(MAX_PEAKS):
        at = int(np.argmax(excess))
        if excess[at] < MIN_LINE_RATIO:
            return None
        seen = [(row, item[0]) for row, item in enumerate(blocks) if np.isfinite(ratios[row, at])]
        by_group: dict[str, list[float]] = {}
        for row, block in seen:
            by_group.setdefault(data.runs[block.run].group, []).append(float(ratios[row, at]))
        # What rings after strong pulses only is no line of an instrument.
        if min(np.mean(values) for values in by_group.values()) >= MIN_GROUP_RATIO:
            line = _fit_line(data, residual, kind, [block for _, block in seen], float(grid_hz[at]), longest_s)
            if line is not None:
                return line
        # The whole width of the peak, or its flank would be tried next.
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
    # The median of an exponential distribution is ln 2 of its mean.
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
    if amplitude < find_resolution(data, kind):
        return None
    added = np.zeros(len(residual))
    for block in data.blocks:
        if block.kind != kind or (block.t_s[-1] - block.t_s[0]) * best_hz < 1.0:
            continue
        number = _fit_sinusoid(block.t_s, residual[block.part], best_hz)
        phase = 2.0 * np.pi * best_hz * block.t_s
        # The common amplitude with the run's own phase: a run's own one would take a part of its noise along.
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
