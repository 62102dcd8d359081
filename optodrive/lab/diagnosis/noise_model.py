"""Noise of each signal kind, white plus two coloured parts, on arbitrary sample times, and jitters common to a run.

Theory of operation

Problem. Whether a residual is an effect or noise depends on the noise, which nobody states, and which is hardly ever
white: thermometers drift, converters quantise, lines hum, a laser's power differs from run to run. A model of the noise
that is fitted to the residuals would absorb the effect that is sought.

Way out. Runs are repeated. Contrasts between the runs of one group contain no pixel at all, of any physics, so
everything here is estimated from them (`replicate_contrasts.py`); only without repeats are residuals used, and the
model says so (`from_replicates`). A program that averages or filters leaves noise that is smooth from sample to sample,
which no process below describes: such a signal is compared by its means over the length of that noise.

Model. Per signal kind Σ = white + σ₁² exp(−|Δt| / τ₁) + σ₂² exp(−|Δt| / τ₂) cos(ω Δt): drift, and a slower or
oscillating part such as hum. Both parts are Markov processes (Ornstein-Uhlenbeck, and a damped rotation in two states),
so a Kalman filter with three states whitens a block in linear time, at any sample times and with gaps; a matrix of all
samples would take their number cubed. Whitening is linear: it is applied to data and to columns of predictions alike,
after which everything else in the diagnosis is least squares with unit noise. Each run also has a power factor, a time
offset and a baseline per signal, which are shared by all its samples; they enter as columns (sensitivities of the
prediction) with a normal prior and are marginalised, never fitted per run.

Estimation. Maximum likelihood by Nelder-Mead in logarithms of ratios to robust guesses; jitters are projected out of
the first fit and estimated by a second one. The oscillating form must gain more than 6 in −2 ln L over the smooth one.
Weak priors keep what the data do not determine where it started.

Floors. Samples of a converter are rounded; the noise is at least the quantum / √12 and 5e-5 of the range, to which the
pixel's closed form and its integrator agree. If all repeats are equal to the last digit the recording is a simulation
without noise: rounding errors are then equal in all runs, do not average out, and are taken as slow noise.

Checks. `replicate_excess` says by how much repeats differ beyond the model (something changes between runs that it does
not contain, or an effect shifts the jitters' sensitivities). Above a threshold no cause is named.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import ceil, cos, exp, log, pi, sin, sqrt

import numpy as np
from scipy.optimize import minimize

from optodrive.core.kernels import array_kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.lab.diagnosis.dataset import PIXEL_KINDS, Dataset
from optodrive.lab.diagnosis.replicate_contrasts import (
    Contrast,
    JitterSensitivity,
    Windows,
    average_windows,
    build_residual_contrasts,
    compute_contrasts,
    find_window,
    find_windows,
)
from optodrive.lab.inspection.signal_faults import find_quantum

EPS = 1e-12
RESOLUTION_SHARE = 5e-5
"""Smallest noise relative to a signal's range: a 16-bit converter resolves 1.5e-5, and the closed form of the pixel and
its integrator agree to 2e-5."""
ROUNDING_S = 0.02
"""Duration for which the rounding error of a settled signal without noise persists."""
AVERAGED_ENDS = 1.5
"""Samples left out at the ends of a signal that was averaged, relative to the number in a mean, which is known to a
quarter."""
MAX_LAG = 40
"""Samples over which correlations of whitened samples are looked at."""


@dataclass(frozen=True)
class ColouredNoise:
    """White noise and two exponentially correlated parts, the second of which may oscillate.

    white, sigma: standard deviations; tau_s: correlation times; omega_rad_per_s: angular frequency of the second part;
    windows: over which samples are averaged first, where noise is smooth; all other numbers then are of the means
    """

    white: float
    sigma: tuple[float, float]
    tau_s: tuple[float, float]
    omega_rad_per_s: float = 0.0
    windows: Windows = ()

    def compute_mean_variance(self, t_s: FloatArray, count: float) -> float:
        """Return the variance of the mean of this number of samples, at intervals as of t_s, by its white part."""
        window = find_window(t_s, self.windows)
        return self.white**2 * min(1.0, (1 if window is None else window.count) / count)


@dataclass(frozen=True)
class NoiseModel:
    """Noise of all signals.

    coloured, baseline_sigma: by signal kind; power_sigma: relative; from_replicates: estimated from repeats;
    replicate_excess: largest excess of χ² of a contrast over its expectation, in σ; intra_pulse_power_excess:
    significance, in σ, of contrasts that look like power changes within pulses; has_noise: False if all repeats are
    equal to the last digit
    """

    coloured: dict[int, ColouredNoise]
    power_sigma: float
    timing_sigma_s: float
    baseline_sigma: dict[int, float]
    from_replicates: bool
    replicate_excess: float = 0.0
    intra_pulse_power_excess: float = 0.0
    has_noise: bool = True


@array_kernel
def _whiten(
    t_s: FloatArray,
    columns: FloatArray,
    white: float,
    sigma_1: float,
    tau_1: float,
    sigma_2: float,
    tau_2: float,
    omega: float,
    out: FloatArray,
) -> float:
    """Write whitened columns [n, k] to out and return ln |Σ|.

    States are the first part, the second part and its quadrature.
    """
    n, k = columns.shape
    x = np.zeros((k, 3))
    v1, v2, q = sigma_1 * sigma_1, sigma_2 * sigma_2, white * white
    p00, p01, p02, p11, p12, p22 = v1, 0.0, 0.0, v2, 0.0, v2
    a1 = a2 = co = si = total = 0.0
    known_s = -1.0
    for row in range(n):
        if row > 0:
            dt = t_s[row] - t_s[row - 1]
            # Evenly sampled signals need the exponentials once.
            if abs(dt - known_s) > 1e-9 * dt:
                a1, a2, known_s = exp(-dt / tau_1), exp(-dt / tau_2), dt
                co, si = a2 * cos(omega * dt), a2 * sin(omega * dt)
            # P ← F P Fᵀ + Q with F = diag(a1, rotation × a2).
            n01, n02 = a1 * (co * p01 - si * p02), a1 * (si * p01 + co * p02)
            r11, r12 = co * p11 - si * p12, co * p12 - si * p22
            s11, s12 = si * p11 + co * p12, si * p12 + co * p22
            p00 = a1 * a1 * p00 + v1 * (1.0 - a1 * a1)
            p11, p12, p22 = (
                co * r11 - si * r12 + v2 * (1.0 - a2 * a2),
                si * r11 + co * r12,
                si * s11 + co * s12 + v2 * (1.0 - a2 * a2),
            )
            p01, p02 = n01, n02
        h0, h1, h2 = p00 + p01, p01 + p11, p02 + p12
        s = h0 + h1 + q
        g0, g1, g2, root = h0 / s, h1 / s, h2 / s, 1.0 / sqrt(s)
        total += log(s)
        for column in range(k):
            if row > 0:
                x0, x1, x2 = a1 * x[column, 0], x[column, 1], x[column, 2]
                x1, x2 = co * x1 - si * x2, si * x1 + co * x2
            else:
                x0 = x1 = x2 = 0.0
            e = columns[row, column] - x0 - x1
            out[row, column] = e * root
            x[column, 0], x[column, 1], x[column, 2] = x0 + g0 * e, x1 + g1 * e, x2 + g2 * e
        p00, p01, p02 = p00 - g0 * h0, p01 - g0 * h1, p02 - g0 * h2
        p11, p12, p22 = p11 - g1 * h1, p12 - g1 * h2, p22 - g2 * h2
    return float(total)


def whiten(t_s: FloatArray, columns: FloatArray, noise: ColouredNoise) -> tuple[FloatArray, float]:
    """Return the columns [n, k] of one block, or their means in windows, with unit white noise, and ln |Σ|."""
    t_s, columns = average_windows(t_s, columns, noise.windows)
    out = np.empty_like(columns, order="C")
    logdet = _whiten(
        np.ascontiguousarray(t_s),
        np.ascontiguousarray(columns),
        noise.white,
        noise.sigma[0],
        noise.tau_s[0],
        noise.sigma[1],
        noise.tau_s[1],
        noise.omega_rad_per_s,
        out,
    )
    return out, logdet


def estimate_noise_model(data: Dataset, residual: FloatArray, sensitivity: JitterSensitivity) -> NoiseModel:
    """Estimate the noise by maximum likelihood from the contrasts, or from the residuals if no run is repeated."""
    contrasts = compute_contrasts(data, residual, sensitivity)
    coloured: dict[int, ColouredNoise] = {}
    quanta: dict[int, float] = {}
    repeats_differ = any(item.value.any() for item in contrasts)
    for kind in data.kinds:
        members = [item for item in contrasts if item.kind == kind]
        windows = find_windows(members) if kind in PIXEL_KINDS else ()
        if not members:
            # Residuals contain the effect that is sought, so this noise is too large; the report says that it is a
            # guess.
            members = build_residual_contrasts(data, residual, sensitivity, kind)
        values, span = _collect_values(data, data.value - residual, kind)
        quanta[kind] = find_quantum(values)
        coloured[kind] = _fit_coloured(members, estimate_resolution(values, span), windows)
    if not contrasts:
        # Without repeats jitters cannot be estimated; these are guesses.
        return NoiseModel(coloured, 0.005, 2e-5, {kind: 3.0 * item.white for kind, item in coloured.items()}, False)
    power_sigma, timing_sigma_s, baseline_sigma = _fit_jitter(contrasts, coloured, data.kinds)
    if not repeats_differ:
        for kind, quantum in quanta.items():
            # Without noise the rounding errors are slow, and equal in all runs: they do not average out.
            error, item = quantum * sqrt(len(data.runs) / 12.0), coloured[kind]
            sigma, tau_s = (max(item.sigma[0], error), item.sigma[1]), (max(item.tau_s[0], ROUNDING_S), item.tau_s[1])
            coloured[kind] = replace(item, white=max(item.white, error), sigma=sigma, tau_s=tau_s)
            baseline_sigma[kind] = max(baseline_sigma[kind], error)
    model = NoiseModel(coloured, power_sigma, timing_sigma_s, baseline_sigma, True, has_noise=repeats_differ)
    return replace(model, replicate_excess=_compute_replicate_excess(contrasts, model))


def drop_averaged_ends(data: Dataset, noise: NoiseModel) -> Dataset:
    """Return the data without the ends of signals that a program averaged, or the data itself.

    Every program continues a signal beyond its ends in its own way: by zeros, by the last sample, mirrored, or not.
    """
    counts = {}
    for number, block in enumerate(data.blocks):
        window = find_window(block.t_s, noise.coloured[block.kind].windows)
        if window is not None and window.count > 1:
            counts[number] = ceil(AVERAGED_ENDS * window.reach)
    return data.drop_ends(counts) if counts else data


def _compute_replicate_excess(contrasts: list[Contrast], model: NoiseModel) -> float:
    """Return the largest excess of a contrast's χ², jitters marginalised, over its expectation, in σ.

    Where the model whitens the noise badly, as of a signal that was filtered, squares of neighbours are no independent
    ones, and the sum of them varies more by the sum of the squared correlations.
    """
    largest = 0.0
    for kind in {item.kind for item in contrasts if item.kind in PIXEL_KINDS}:
        found = [_compute_excess(item, model) for item in contrasts if item.kind == kind]
        # The median: one run that truly differs must not excuse itself by its own correlations.
        correlations = np.median([correlation for _, correlation in found], axis=0)
        largest = max(largest, max(excess for excess, _ in found) / sqrt(1.0 + 2.0 * float((correlations**2).sum())))
    return largest


def _compute_excess(contrast: Contrast, model: NoiseModel) -> tuple[float, FloatArray]:
    """Return the excess of one contrast's χ² for independent samples, and the correlations of its whitened samples."""
    size = np.array([model.power_sigma, model.timing_sigma_s, model.baseline_sigma[contrast.kind]])
    columns = np.column_stack([contrast.value, contrast.jitter * size])
    whitened, _ = whiten(contrast.t_s, columns, model.coloured[contrast.kind])
    gram, count = whitened.T @ whitened, len(whitened)
    inner = gram[1:, 1:] + np.eye(len(size))
    jitter = np.linalg.solve(inner, gram[0, 1:])
    values = whitened[:, 0] - whitened[:, 1:] @ jitter
    lags = range(1, min(MAX_LAG, count // 4) + 1)
    correlations = np.zeros(MAX_LAG)
    correlations[: len(lags)] = [float(values[lag:] @ values[:-lag]) for lag in lags]
    correlations /= max(float(values @ values), EPS)
    return float((gram[0, 0] - gram[0, 1:] @ jitter - count) / sqrt(2.0 * count)), correlations


def _minimize(function: Callable[[FloatArray], float], start: FloatArray, step: float, evaluations: int) -> FloatArray:
    simplex = np.vstack([start, *(start + step * row for row in np.eye(len(start)))])
    options = {"maxfev": evaluations, "initial_simplex": simplex, "xatol": 0.01, "fatol": 0.05}
    return np.asarray(minimize(function, start, method="Nelder-Mead", options=options).x)


def estimate_resolution(values: FloatArray, span: float) -> float:
    """Return the standard deviation that quantisation or a converter of that span gives to samples."""
    return max(find_quantum(values) / sqrt(12.0), RESOLUTION_SHARE * span, EPS)


def find_resolution(data: Dataset, kind: int) -> float:
    """Return the standard deviation that quantisation gives to samples of one kind of signal."""
    return estimate_resolution(*_collect_values(data, data.value, kind))


def _collect_values(data: Dataset, prediction: FloatArray, kind: int) -> tuple[FloatArray, float]:
    """Return the samples of one kind, and the range of data and prediction."""
    parts = [block.part for block in data.blocks if block.kind == kind]
    values = np.concatenate([data.value[part] for part in parts])
    return values, max(float(np.ptp(values)), float(np.ptp(np.concatenate([prediction[part] for part in parts]))))


def _fit_coloured(contrasts: list[Contrast], resolution: float, windows: Windows) -> ColouredNoise:
    """Fit the noise of one signal kind, white noise of at least the resolution, with the jitters projected out."""
    contrasts = [_average(item, windows) for item in contrasts]
    differences = np.concatenate([np.diff(item.value) for item in contrasts])
    std = float(np.sqrt(np.mean(np.concatenate([item.value - item.value.mean() for item in contrasts]) ** 2))) + EPS
    std = max(std, resolution)
    # Differences of neighbours hold no slow noise, and the median no missed pulse.
    white = min(std, float(1.4826 * np.median(np.abs(differences)) / sqrt(2.0)) + 1e-3 * std)
    white = max(white, resolution)
    dt_s = float(np.median(np.concatenate([np.diff(item.t_s) for item in contrasts])))
    # Projected out rather than with a prior: their sizes are not known before the noise is.
    stacked = [(item.t_s, np.column_stack([item.value, _normalize_columns(item.jitter)])) for item in contrasts]

    def decode(x: FloatArray) -> ColouredNoise:
        first, second = dt_s * exp(x[3]), dt_s * exp(x[4])
        omega_rad_per_s = exp(x[5]) if len(x) > 5 else 0.0
        return ColouredNoise(
            max(white * exp(x[0]), resolution), (white * exp(x[1]), white * exp(x[2])), (first, second), omega_rad_per_s
        )

    def cost(x: FloatArray) -> float:
        noise, total = decode(x), 0.0
        grams: dict[int, list[FloatArray]] = {}
        for t_s, columns in stacked:
            whitened, logdet = whiten(t_s, columns, noise)
            grams.setdefault(columns.shape[1], []).append(whitened.T @ whitened)
            total += logdet
        for gram in map(np.array, grams.values()):  # of the same size, for one call of each function
            right, identity = gram[:, 1:, 0], np.eye(gram.shape[1] - 1)
            inner = gram[:, 1:, 1:] + 1e-9 * identity * np.trace(gram, axis1=1, axis2=2)[:, None, None]
            total += float(
                (gram[:, 0, 0] - (right * np.linalg.solve(inner, right[:, :, None])[:, :, 0]).sum(axis=1)).sum()
            )
            # The restricted likelihood: without it, noise that looks like a jitter would be estimated too small.
            total += float(np.linalg.slogdet(inner)[1].sum())
        # Weak priors regularise parameters that the data does not determine.
        return total + 0.02 * float((x[:5] ** 2).sum()) + 1e3 * float(np.maximum(0.0, np.abs(x[:5]) - 8.0).sum())

    smooth_start = np.array([-0.1, -0.7, -1.0, 1.0, 3.0])
    smooth = _minimize(cost, smooth_start, 0.7, 220)
    # A frequency must start near its line: Nelder-Mead finds no narrow minimum by itself.
    oscillatory_start = np.array([-0.1, -1.5, -0.7, 2.0, 2.5, log(_find_dominant_omega(contrasts, dt_s))])
    oscillatory = _minimize(cost, oscillatory_start, 0.4, 260)
    # It has a number more, and white noise has some largest line by chance.
    best = oscillatory if cost(oscillatory) < cost(smooth) - 6.0 else smooth
    return replace(decode(best), windows=windows)


def _average(contrast: Contrast, windows: Windows) -> Contrast:
    columns = np.column_stack([contrast.value, contrast.jitter])
    t_s, means = average_windows(contrast.t_s, columns, windows)
    return replace(contrast, t_s=t_s, value=means[:, 0], jitter=means[:, 1:])


def _find_dominant_omega(contrasts: list[Contrast], dt_s: float) -> float:
    """Return the angular frequency at which the mean spectrum exceeds its smoothed form the most."""
    count, power = 256, np.zeros(129)
    for item in contrasts:
        for start in range(0, len(item.value) - count + 1, count):
            segment = item.value[start : start + count]
            power += np.abs(np.fft.rfft((segment - segment.mean()) * np.hanning(count))) ** 2
    if not power.any():
        return 0.2 * pi / dt_s
    # Relative to its neighbourhood, else slow noise, always the largest, would win.
    smooth = np.convolve(np.log(power[2:] + EPS * power.max()), np.ones(5) / 5, mode="same")
    return float((2 + int(np.argmax(smooth[2:-2])) + 2) * 2.0 * pi / (count * dt_s))


def _normalize_columns(jitter: FloatArray) -> FloatArray:
    # A jitter to which a signal does not respond has no column.
    size = np.sqrt((jitter**2).sum(axis=0))
    return np.asarray(jitter[:, size > 0] / size[size > 0])


def _fit_jitter(
    contrasts: list[Contrast], coloured: dict[int, ColouredNoise], kinds: list[int]
) -> tuple[float, float, dict[int, float]]:
    """Return σ of power (relative), of timing (s) and of baselines by maximum likelihood of the contrasts."""
    pairs: dict[int, list[Contrast]] = {}
    for item in contrasts:
        pairs.setdefault(item.pair, []).append(item)
    grams = []
    for members in pairs.values():
        size = 2 + len(kinds)
        gram, right = np.zeros((size, size)), np.zeros(size)
        for item in members:
            whitened, _ = whiten(item.t_s, np.column_stack([item.jitter, item.value]), coloured[item.kind])
            small = whitened.T @ whitened
            indices = [0, 1, 2 + kinds.index(item.kind)]
            gram[np.ix_(indices, indices)] += small[:3, :3]
            right[indices] += small[:3, 3]
        grams.append((gram, right))
    # Also the centre of the weak prior: with one pair of repeats the estimate could be anything.
    start = np.log(np.array([0.005, 2e-5, *(coloured[kind].white for kind in kinds)]))

    def cost(x: FloatArray) -> float:
        variance = np.exp(2.0 * (x + start))
        total = float((x[:2] ** 2).sum()) + float((x[2:] ** 2).sum()) / 9.0
        for gram, right in grams:
            root = np.sqrt(variance)
            inner = np.eye(len(root)) + root[:, None] * gram * root
            scaled = root * right
            total += float(np.linalg.slogdet(inner)[1]) - float(scaled @ np.linalg.solve(inner, scaled))
        return total

    best = np.exp(_minimize(cost, np.zeros(len(start)), 0.5, 400) + start)
    return float(best[0]), float(best[1]), {kind: float(best[2 + row]) for row, kind in enumerate(kinds)}
