"""Nominal model fitted under the noise of the repeats, its prior, and a test for power that fluctuates within pulses.

The power jitter of a run is one value for the whole run. A power that fluctuates within pulses differs between repeats
and resembles slow noise, but it appears with the pulse and decays as the absorber cools.
"""

from collections.abc import Mapping
from dataclasses import replace
from math import ceil, log

import numpy as np

from optodrive.core.plausibility import RECORDING, check_plausible
from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.measurements import Measurement
from optodrive.device.config import Config
from optodrive.lab.diagnosis.dataset import MIRROR_KINDS, PIXEL_KINDS, Dataset
from optodrive.lab.diagnosis.fitting import BaseParameterPrior, FitProblem, ModelFit, compute_jitter_sensitivity, fit
from optodrive.lab.diagnosis.noise_model import ColouredNoise, NoiseModel, estimate_noise_model, whiten
from optodrive.lab.diagnosis.prediction import ParameterPoint
from optodrive.lab.diagnosis.replicate_contrasts import Contrast, compute_contrasts
from optodrive.physics.parameters import load_parameters
from optodrive.physics.pixel import Pixel
from optodrive.physics.pixel_ode import ActiveTerms, PixelExperiment, simulate_signals
from optodrive.physics.term import TermValues

DEFAULT_PARAMETER_SET = "calibrated"
R_SIGMA, C_SIGMA, GAS_SIGMA = 0.25, 0.16, 0.4
"""Relative σ: one sample against its row of Table S3; gas, membrane and force against the calibrated set."""


def build_prior(measurement: Measurement, config: Config | None) -> tuple[BaseParameterPrior, float | None]:
    """Return prior and bridge width.

    The prior is centred on the configured pixel, else on the stated bridge width, else it covers the whole of Table S3.
    """
    stated_m = None
    for run in measurement.runs:
        width = run.attributes.get("bridge_width_m")
        if isinstance(width, int | float):
            check_plausible(f"recording: {run.name}: bridge_width_m", float(width), RECORDING["bridge_width_m"])
            stated_m = float(width) if stated_m is None else stated_m
    width_m = stated_m if config is None else stated_m or config.display.bridge_width_m
    if width_m is None:
        return BROAD_PRIOR, None
    parameter_set = DEFAULT_PARAMETER_SET if config is None else config.pixel_model.parameters
    pixel = load_parameters(parameter_set).build_pixel(width_m)
    values = (pixel.r_k_per_w, pixel.c_j_per_k, pixel.tau_g_s, pixel.kappa_m_per_k, pixel.phi_n_per_k)
    sigma = (R_SIGMA, C_SIGMA, GAS_SIGMA, GAS_SIGMA, GAS_SIGMA)
    return BaseParameterPrior(tuple(map(log, values)), sigma), width_m


BROAD_PRIOR = BaseParameterPrior(
    (np.log(150.0), np.log(101e-6), np.log(3e-3), np.log(4e-6), np.log(2.3e-4)), (0.7, 0.16, 0.5, 0.5, 0.5)
)
"""Prior over the whole of Table S3; gas and membrane from the peak values in the paper."""
MIRROR_NOISE_FRACTION = 1e-3
R_STARTS_K_PER_W = (100.0, 180.0, 320.0)


def fit_nominal(
    data: Dataset,
    prior: BaseParameterPrior = BROAD_PRIOR,
    min_timing_sigma_s: float = 0.0,
    shared: Mapping[str, TermValues] | None = None,
) -> tuple[FitProblem, ModelFit]:
    """Estimate the noise model and fit the nominal model.

    min_timing_sigma_s: lower limit of the timing jitter, from other signals; shared: known terms of the clock
    that all signals share
    """
    # The noise needs the jitters' sensitivities, these a fit, and a fit some noise.
    crude_noise = _estimate_crude_noise(data)
    problem = FitProblem(data, crude_noise, prior)
    trials = [
        fit(problem, ParameterPoint((float(np.log(r)), *prior.mean[1:]), shared or {}), iterations=3)
        # From one start the fit may end with a wrong pair of R and C, of equal time constant.
        for r in R_STARTS_K_PER_W
    ]
    base = fit(problem, min(trials, key=lambda item: item.chi2).point, iterations=10)
    problem = update_noise(problem, base, min_timing_sigma_s)
    base = fit(problem, base.point)
    return replace(
        problem, noise=replace(problem.noise, intra_pulse_power_excess=compute_intra_pulse_power_excess(problem, base))
    ), base


def update_noise(problem: FitProblem, fitted: ModelFit, min_timing_sigma_s: float) -> FitProblem:
    """Return the problem with the noise model estimated from repeats, with jitter sensitivities at this fit."""
    data = problem.data
    sensitivity = compute_jitter_sensitivity(data, fitted.point, fitted.prediction)
    noise = estimate_noise_model(data, data.value - fitted.prediction, sensitivity)
    noise = replace(
        noise,
        timing_sigma_s=max(noise.timing_sigma_s, min_timing_sigma_s),
        coloured=_raise_mirror_noise(data, noise.coloured),
    )
    return replace(problem, noise=noise)


def _raise_mirror_noise(data: Dataset, coloured: dict[int, ColouredNoise]) -> dict[int, ColouredNoise]:
    """Raise the white noise of mirror signals to a share of their range: jitter is nonlinear at mirror steps."""
    out = dict(coloured)
    for kind in MIRROR_KINDS:
        if kind in out:
            span = float(np.ptp(np.concatenate([data.value[b.part] for b in data.blocks if b.kind == kind])))
            # A mirror at rest is measured so precisely that the model of its servo would have to be exact.
            out[kind] = replace(out[kind], white=float(np.hypot(out[kind].white, MIRROR_NOISE_FRACTION * span)))
    return out


def _estimate_crude_noise(data: Dataset) -> NoiseModel:
    coloured, baseline = {}, {}
    for kind in data.kinds:
        blocks = [block for block in data.blocks if block.kind == kind]
        steps = np.concatenate([np.diff(data.value[block.part]) for block in blocks])
        span = float(np.ptp(np.concatenate([data.value[block.part] for block in blocks])))
        white = float(np.median(np.abs(steps))) + 1e-3 * span + 1e-15
        coloured[kind] = ColouredNoise(white, (white, white), (1e-2, 1.0))
        baseline[kind] = 3.0 * white
    return NoiseModel(coloured, 0.01, 5e-5, baseline, False)


SLICE_S = 0.012
"""Length of a pulse slice, about the thermal time constant: faster fluctuations are smoothed, slower span slices."""
MAX_SLICES = 2000
"""Maximum number of slices that are examined; of more, evenly spaced ones are."""

RUN_POWER_SIGMA = 1.0
"""Prior σ of a run's relative power here: ageing and drift between repeats are no fluctuation within pulses."""


def compute_intra_pulse_power_excess(problem: FitProblem, base: ModelFit) -> float:
    """Return the score statistic, in σ, for independent powers of the pulse slices added to the noise model."""
    data, noise = problem.data, problem.noise
    sensitivity = compute_jitter_sensitivity(data, base.point, base.prediction)
    pixel = base.point.pixel()
    experiments = {number: experiment for experiment, numbers in data.experiments for number in numbers}
    pairs: dict[int, list[Contrast]] = {}
    for item in compute_contrasts(data, data.value - base.prediction, sensitivity):
        if item.kind in PIXEL_KINDS:
            pairs.setdefault(item.pair, []).append(item)
    excess = variance = 0.0
    for members in pairs.values():
        slices = slice_pulses(experiments[members[0].block].pulses)
        count = 1 + len(slices)
        size = 2 + len(PIXEL_KINDS)
        gram = np.zeros((count + size, count + size))
        for item in members:
            sigma = np.array([RUN_POWER_SIGMA, noise.timing_sigma_s, noise.baseline_sigma[item.kind]])
            responses = _compute_slice_responses(experiments[item.block], slices, item, pixel)
            columns = np.column_stack([item.value, responses, item.jitter * sigma])
            whitened, _ = whiten(item.t_s, columns, noise.coloured[item.kind])
            indices = np.append(np.arange(count), count + np.array([0, 1, 2 + item.kind]))
            gram[np.ix_(indices, indices)] += whitened.T @ whitened
        inner = gram[count:, count:] + np.eye(size)
        projected = gram[:count, :count] - gram[:count, count:] @ np.linalg.solve(inner, gram[count:, :count])
        # The score of a variance at zero: it needs no fit of the fluctuation, which nobody would use.
        excess += float((projected[1:, 0] ** 2).sum() - np.trace(projected[1:, 1:]))
        variance += 2.0 * float((projected[1:, 1:] ** 2).sum())
    return excess / float(np.sqrt(variance)) if variance > 0.0 else 0.0


def slice_pulses(pulses: FloatArray, slice_s: float = SLICE_S) -> FloatArray:
    """Return pulses [k, 4] cut into equal slices, MAX_SLICES at most."""
    rows = []
    for start_s, width_s, power_w, pixel in pulses.tolist():
        count = max(1, round(width_s / slice_s))
        rows += [[start_s + k * width_s / count, width_s / count, power_w, pixel] for k in range(count)]
    slices = np.array(rows, dtype=np.float64).reshape(-1, 4)
    return slices[:: max(1, ceil(len(slices) / MAX_SLICES))]


def _compute_slice_responses(
    experiment: PixelExperiment, slices: FloatArray, item: Contrast, pixel: Pixel
) -> FloatArray:
    """Return the nominal response [n, k] to each slice: the derivative with respect to the logarithm of its power."""
    empty = np.zeros(0)
    times = tuple(item.t_s if kind == item.kind else empty for kind in PIXEL_KINDS)
    out = np.empty((len(item.t_s), len(slices)))
    for row in range(len(slices)):
        single = replace(experiment, pulses=slices[row : row + 1], t_s=(times[0], times[1], times[2]))
        out[:, row] = simulate_signals(single, pixel, ActiveTerms.from_values({}), (0.0, 0.0, 0.0))[item.kind]
    return out
