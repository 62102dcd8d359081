"""Result of a diagnosis: causes, held-out gain, candidate ranking, next experiment."""

from dataclasses import dataclass, field

from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.measurements import DataFinding


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
class Probabilities:
    """Probabilities of all explanations of a recording, which sum to 1.

    causes: by the keys of one cause, or of two that act together, sorted
    """

    no_effect: float
    none_of_these: float
    causes: dict[tuple[str, ...], float]

    def sum_of(self, cause: str) -> float:
        """Return the probability that a cause acts, alone or with another one."""
        return sum(probability for keys, probability in self.causes.items() if cause in keys)

    @property
    def ranked(self) -> list[tuple[tuple[str, ...], float]]:
        """Sets of causes with their probabilities, most probable first."""
        return sorted(self.causes.items(), key=lambda item: (-item[1], item[0]))

    def combine(self, other: "Probabilities") -> "Probabilities":
        """Return the probabilities of two independent subsystems together."""
        mine = {(): self.no_effect} | self.causes
        theirs = {(): other.no_effect} | other.causes
        causes: dict[tuple[str, ...], float] = {}
        for first, p in mine.items():
            for second, q in theirs.items():
                keys = tuple(sorted({*first, *second}))
                causes[keys] = causes.get(keys, 0.0) + p * q
        none_of_these = 1.0 - (1.0 - self.none_of_these) * (1.0 - other.none_of_these)
        return Probabilities(causes.pop(()), none_of_these, causes)


@dataclass(frozen=True)
class CandidateCause:
    """Judgement of one hypothesis.

    statistic: likelihood ratio against the nominal fit; probability: that its cause acts, alone or with another one;
    detection_limit: the smallest effect that the data would have shown
    """

    cause: str
    label: str
    statistic: float
    probability: float
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


@dataclass(frozen=True)
class RivalModel:
    """One or two hypotheses, refitted to the runs that are not held out.

    chi2: above that of the best rival; log_evidence: below that of the best one, in nats; probability: of exactly these
    causes; heldout_gain: as `HeldOutGain.reduction`, None if not measured;
    parameters: value and unit by name
    """

    label: str
    causes: tuple[str, ...]
    chi2: float
    log_evidence: float
    probability: float
    heldout_gain: float | None
    is_chosen: bool
    parameters: dict[str, tuple[float, str]]


@dataclass(frozen=True)
class InstrumentDisturbance:
    """A disturbance that an instrument adds to one signal, SI.

    form: "line", with the amplitude as size; "hops" of the zero, with their median; "drift" of the zero over the
    recording, with its span; runs: in which it was found
    """

    signal: str
    form: str
    size: float
    frequency_hz: float | None
    runs: int


@dataclass(frozen=True)
class HeldOutError:
    """RMSE of both models in one signal of one held-out group, and the expected noise, in SI units."""

    group: str
    signal: str
    runs: int
    nominal: float
    extended: float
    noise_floor: float


@dataclass(frozen=True)
class HeightError:
    """Error of heights planned with either model, measured / predicted − 1 of recorded pushes: rms and largest.

    pushes, experiments: their number, repeats counting once; noise: rms of the measured heights' own, relative
    """

    pushes: int
    experiments: int
    nominal_rms: float
    nominal_max: float
    extended_rms: float
    extended_max: float
    noise: float


@dataclass(frozen=True, eq=False)
class ResidualTrace:
    """One signal of one run: measured values and residuals, [m].

    nominal, extended: residuals in units of sigma, the noise of one sample; rms_nominal: of all samples, not thinned
    """

    run: str
    group: str
    signal: str
    sigma: float
    t_s: FloatArray
    measured: FloatArray
    nominal: FloatArray
    extended: FloatArray
    rms_nominal: float

    def compute_model(self, residual: FloatArray) -> FloatArray:
        """Return the values of the model with this residual, SI."""
        return self.measured - self.sigma * residual


@dataclass(frozen=True, eq=False)
class Discrepancy:
    """Diagnosis of a recording.

    verdict: "cause", "none", "unexplained", "ambiguous", "instrument" if only disturbances were found, "undecided" if
    the data show neither an effect nor its absence, or "incomplete" if no error was found but failures prevent "none";
    reasons: why the verdict is not more definite, in sentences; omissions: steps that failed and that the verdict does
    not need, with the errors; disturbances: of the instruments, which were subtracted before
    all else; probabilities: of all explanations; terms: the extension, term → parameter → value; base:
    nominal parameters as refitted with it; residual_traces: the first run of every group, with the models fitted to all
    runs; held_out_traces, held_out_errors: with the models fitted to the other runs; explained_fraction: share of the
    detected excess of χ²; doubts: why the size of a named cause is uncertain, a clause by cause; failures: hypotheses
    that could not be computed, with the errors; height_error_held_out, height_error_fitted: on pushes to which the
    models were not fitted, and on all, None if none was measured; data_findings,
    inspection_failures: of the inspection of the recording before all else
    """

    verdict: str
    causes: tuple[str, ...]
    disturbances: tuple[InstrumentDisturbance, ...]
    probabilities: Probabilities
    parameters: dict[str, Estimate]
    base: dict[str, float]
    terms: dict[str, dict[str, float]]
    gain: HeldOutGain | None
    candidates: tuple[CandidateCause, ...]
    next_experiment: NextExperiment | None
    fitted_runs: tuple[str, ...]
    held_out_runs: tuple[str, ...]
    residual_traces: tuple[ResidualTrace, ...]
    held_out_traces: tuple[ResidualTrace, ...]
    held_out_errors: tuple[HeldOutError, ...]
    rivals: tuple[RivalModel, ...]
    remarks: tuple[str, ...]
    explained_fraction: float
    doubts: dict[str, str]
    failures: dict[str, str]
    height_error_held_out: HeightError | None
    height_error_fitted: HeightError | None
    elapsed_s: float
    reasons: tuple[str, ...] = ()
    omissions: dict[str, str] = field(default_factory=dict)
    data_findings: tuple[DataFinding, ...] = ()
    inspection_failures: tuple[str, ...] = ()

    @property
    def omitted_data(self) -> tuple[DataFinding, ...]:
        """Findings that left data out."""
        return tuple(item for item in self.data_findings if item.action == "left out")
