"""Result of a diagnosis: causes, gain, candidate ranking, next experiment."""

from dataclasses import dataclass

from optodrive.core.types.arrays import FloatArray


@dataclass(frozen=True)
class Estimate:
    """A fitted number: value, unit, its 95 % interval."""

    value: float
    unit: str
    low: float
    high: float


@dataclass(frozen=True)
class HeldOutGain:
    """RMSE on runs that were held out, by signal, SI; reduction: (before − after) / (before − floor), 95 % interval."""

    nominal: dict[str, float]
    extended: dict[str, float]
    noise_floor: dict[str, float]
    reduction: float
    low: float
    high: float


@dataclass(frozen=True)
class CandidateCause:
    """One cause as judged. statistic: likelihood ratio beside the nominal fit; smallest: what would have been seen."""

    cause: str
    label: str
    statistic: float
    p_value: float
    heldout_gain: float | None
    verdict: str
    detection_limit: str


@dataclass(frozen=True, eq=False)
class NextExperiment:
    """The experiment that tells rivals apart.

    pulses: [n, 4]; pixel: the one to look at; repeats: how often; separation: χ² between rivals; seconds: of lab time
    """

    rationale: str
    pulses: FloatArray
    pixel: int
    repeats: int
    signals: tuple[str, ...]
    separation: float
    lab_time_s: float


@dataclass(frozen=True, eq=False)
class ResidualTrace:
    """One signal of one group: measured, and residuals before and after in units of sigma, one sample's noise; [m]."""

    group: str
    signal: str
    sigma: float
    t_s: FloatArray
    measured: FloatArray
    nominal: FloatArray
    extended: FloatArray


@dataclass(frozen=True, eq=False)
class Discrepancy:
    """What a recording says of the model: verdict "cause", "none", "unexplained" or "ambiguous", and all behind it.

    terms: the extension, term → parameter → value; base: nominal parameters as refitted with it
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
