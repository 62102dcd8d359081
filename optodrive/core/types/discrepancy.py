"""Result of a diagnosis: causes, held-out gain, candidate ranking, next experiment."""

from dataclasses import dataclass

from optodrive.core.types.arrays import FloatArray


@dataclass(frozen=True)
class Estimate:
    """Fitted value with its unit and 95 % interval, which contains it.

    at_limit: the fit ended at a limit of the plausible range, which is the value here and no estimate
    """

    value: float
    unit: str
    low: float
    high: float
    at_limit: bool = False


@dataclass(frozen=True)
class HeldOutGain:
    """RMSE on held-out runs by signal, SI, and the share of the avoidable error that the extended model removes.

    reduction: (nominal − extended) / (nominal − noise floor); interval: its 95 % interval, None with fewer than two
    held-out groups, over which it is computed
    """

    nominal: dict[str, float]
    extended: dict[str, float]
    noise_floor: dict[str, float]
    reduction: float
    interval: tuple[float, float] | None


@dataclass(frozen=True)
class CandidateCause:
    """Judgement of one hypothesis.

    statistic: likelihood ratio against the nominal fit; detection_limit: the smallest effect that the data would have
    shown
    """

    cause: str
    label: str
    statistic: float
    p_value: float
    heldout_gain: float | None
    verdict: str
    detection_limit: str


@dataclass(frozen=True, eq=False)
class NextExperiment:
    """Experiment that separates two rival causes.

    pulses: [n, 4] start_s, width_s, power_w, pixel; pixel: to be measured; separation: expected χ² between the rivals
    """

    description: str
    pulses: FloatArray
    pixel: int
    repeats: int
    signals: tuple[str, ...]
    separation: float
    lab_time_s: float


@dataclass(frozen=True, eq=False)
class ResidualTrace:
    """One signal of one group: measured values and residuals, [m].

    nominal, extended: residuals in units of sigma, the noise of one sample
    """

    group: str
    signal: str
    sigma: float
    t_s: FloatArray
    measured: FloatArray
    nominal: FloatArray
    extended: FloatArray


@dataclass(frozen=True, eq=False)
class Discrepancy:
    """Diagnosis of a recording.

    verdict: "cause", "none", "unexplained" or "ambiguous"; terms: the extension, term → parameter → value; base:
    nominal parameters as refitted with it; explained_fraction: share of the detected excess
    """

    verdict: str
    causes: tuple[str, ...]
    hypothesis_labels: tuple[str, ...]
    parameters: dict[str, Estimate]
    base: dict[str, float]
    terms: dict[str, dict[str, float]]
    gain: HeldOutGain | None
    candidates: tuple[CandidateCause, ...]
    next_experiment: NextExperiment | None
    fitted_runs: tuple[str, ...]
    held_out_runs: tuple[str, ...]
    residual_traces: tuple[ResidualTrace, ...]
    remarks: tuple[str, ...]
    explained_fraction: float
    elapsed_s: float
