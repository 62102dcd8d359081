"""Diagnosis of a recording, separately for pixels and mirrors and then combined."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import reduce
from time import perf_counter

import numpy as np

from optodrive.core.quantity import format_quantity, list_names
from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.discrepancy import (
    CandidateCause,
    Discrepancy,
    Estimate,
    HeldOutError,
    HeldOutGain,
    InstrumentDisturbance,
    NextExperiment,
    Probabilities,
    ResidualTrace,
    RivalModel,
)
from optodrive.core.types.measurements import Measurement
from optodrive.lab.diagnosis.candidate_judgement import judge_candidates, list_rivals
from optodrive.lab.diagnosis.dataset import MIRROR_KINDS, SIGNALS, Dataset, build_dataset, build_hypotheses
from optodrive.lab.diagnosis.detection import ProgressCallback, SearchLog, detect, ignore_progress
from optodrive.lab.diagnosis.estimates import (
    compute_covariance,
    compute_estimates,
    describe_doubts,
    describe_limits,
    is_at_limit,
    limit_sizes,
)
from optodrive.lab.diagnosis.fitting import (
    BaseParameterPrior,
    FitProblem,
    ModelFit,
    compute_jitter_sensitivity,
    fit,
)
from optodrive.lab.diagnosis.instrument_disturbances import (
    find_dc_coupled,
    find_disturbances,
    remove_disturbances,
)
from optodrive.lab.diagnosis.model_comparison import (
    compute_height_error,
    compute_held_out_changes,
    compute_held_out_gain,
    split_runs,
    trace_groups,
)
from optodrive.lab.diagnosis.model_selection import (
    MAX_INTRA_PULSE_POWER_EXCESS,
    MAX_REPLICATE_EXCESS,
    Selection,
    compare_explanations,
    has_replicate_excess,
)
from optodrive.lab.diagnosis.next_steps import propose_for_verdict
from optodrive.lab.diagnosis.noise_model import drop_averaged_ends
from optodrive.lab.diagnosis.nominal_fit import BROAD_PRIOR, compute_intra_pulse_power_excess, fit_nominal, update_noise
from optodrive.lab.diagnosis.prediction import BASE_PARAMETERS, ParameterPoint, predict
from optodrive.lab.diagnosis.recording_checks import check_copied_runs, check_numeric_limits, check_recording_units
from optodrive.lab.diagnosis.refitting import RefittedCandidate, refit_strongest
from optodrive.lab.inference.claim import HeldOutChange, claim, combine_claims
from optodrive.lab.inspection.inspection import inspect_recording
from optodrive.physics.hypothesis import Hypothesis
from optodrive.physics.term import BySignal, TermValues
from optodrive.physics.terms import discover_terms

MIN_CHANGE_RATIO = 16.0
"""Likelihood ratio of an effect that changes from run to run, from which the noise is estimated beside it too."""
QUIETER = 0.8
"""Jitter of the power beside such an effect, relative to that beside none, below which the former counts."""
NEARLY_EXPLAINED = 0.999
"""Share of the excess that a named cause explains without a remark on the rest."""


@dataclass(frozen=True, eq=False)
class _SubsystemFit:
    """Results for the pixels or for the mirrors.

    estimates: of the final parameters, discrepancy marginalised; changes: of held-out errors by the chosen model
    """

    data: Dataset
    held_out: Dataset
    problem: FitProblem
    base: ModelFit
    selection: Selection
    final: ModelFit
    estimates: dict[str, Estimate]
    changes: tuple[HeldOutChange, ...]
    gain: HeldOutGain | None
    candidates: tuple[CandidateCause, ...]
    rivals: tuple[RivalModel, ...]
    next_experiment: NextExperiment | None
    disturbances: tuple[InstrumentDisturbance, ...]

    @property
    def blind_points(self) -> tuple[ParameterPoint, ParameterPoint]:
        """The nominal and the extended model, both fitted without the held-out runs."""
        chosen = self.selection.chosen
        return self.base.point, self.base.point if chosen is None else chosen.fit.point


def diagnose(
    measurement: Measurement,
    seed: int = 0,
    prior: BaseParameterPrior = BROAD_PRIOR,
    on_progress: ProgressCallback = ignore_progress,
    hold_out: bool = True,
    use: Iterable[str] = (),
) -> Discrepancy:
    """Diagnose a recording.

    hold_out: whether runs are held out to measure the gain, where there are enough of them; use: kinds of findings of
    the inspection that leave nothing out. Raises InputError if it has no data to compare with the model, a quantity
    that is probably in a wrong unit, or a copy in place of a repeat.
    """
    began_s = perf_counter()
    inspection = inspect_recording(measurement, use)
    inspection.check()
    measurement = inspection.measurement
    # Before the test of units, in which numbers out of range would overflow.
    check_numeric_limits(measurement)
    check_recording_units(measurement, ParameterPoint(prior.mean, {}).pixel())
    check_copied_runs(measurement)
    log, subsystems = SearchLog(on_progress), list[_SubsystemFit]()
    for part in build_dataset(measurement).split_subsystems():
        # Pixels come first: their edges measure the timing jitter, which a mirror's repeats at rest do not show.
        timing_s = max((item.problem.noise.timing_sigma_s for item in subsystems), default=0.0)
        candidates = build_hypotheses(part)
        # A recording that states how it was coupled needs no test of its zeros.
        if all(run.attributes.get("coupling") == "DC" for run in measurement.runs):
            candidates = [item for item in candidates if not discover_terms()[item.key].removes_zero]
        if subsystems:
            # All signals share one clock, determined by the pixels; a late mirror then is a lag of the mirror.
            candidates = [item for item in candidates if len(discover_terms()[item.key].subsystems) == 1]
        shared = _find_shared_terms(subsystems)
        subsystems.append(_diagnose_subsystem(part, candidates, seed, prior, timing_s, shared, log, hold_out))
    disturbances = tuple(each for item in subsystems for each in item.disturbances)
    claimed = combine_claims([item.selection.claim for item in subsystems], log.failures, bool(disturbances))
    # The pixels where there are any; the mirrors alone else.
    main = subsystems[0]
    named = [(item, chosen) for item in subsystems if (chosen := item.selection.chosen) is not None]
    doubts: dict[str, str] = {}
    for item, chosen in named:
        doubts |= describe_doubts(chosen.hypotheses, item.estimates) | describe_limits(
            chosen.hypotheses, item.estimates
        )
    terms = {key: dict(values) for item in subsystems for key, values in item.final.point.terms.items()}
    base = np.exp(np.array(main.final.point.base)).tolist() if any(kind < 3 for kind in main.data.kinds) else []
    held_out = tuple(sorted({run.name for item in subsystems for run in item.held_out.runs}))
    fitted = tuple(sorted({run.name for item in subsystems for run in item.data.runs}.difference(held_out)))
    blind, no_traces = main.blind_points, tuple[ResidualTrace, ...]()
    return Discrepancy(
        verdict=claimed.verdict,
        causes=claimed.causes,
        disturbances=disturbances,
        probabilities=reduce(Probabilities.combine, (item.selection.probabilities for item in subsystems)),
        parameters={name: each for item in subsystems for name, each in item.estimates.items()},
        base=dict(zip(BASE_PARAMETERS, base, strict=False)),
        terms=terms if claimed.causes else {},
        gain=next((item.gain for item, _ in named), None),
        candidates=tuple(each for item in subsystems for each in item.candidates),
        next_experiment=next((item.next_experiment for item in subsystems if item.next_experiment is not None), None),
        fitted_runs=fitted,
        held_out_runs=held_out,
        # Both models on all runs: the nominal one without the held-out runs, the extended one as fitted to all.
        residual_traces=tuple(
            trace
            for item in subsystems
            for trace in log.attempt(
                "traces", trace_groups, no_traces, item.problem, item.data, item.base.point, item.final.point
            )
        ),
        held_out_traces=tuple(
            trace
            for item in subsystems
            for trace in log.attempt("traces", trace_groups, no_traces, item.problem, item.held_out, *item.blind_points)
        ),
        held_out_errors=tuple(
            HeldOutError(each.group, each.signal, each.runs, *each.rms) for item in subsystems for each in item.changes
        ),
        rivals=tuple(each for item in subsystems for each in item.rivals),
        remarks=(*inspection.remarks, *_build_remarks(subsystems)),
        # The worse of both subsystems, so that the answer promises no more than each of them holds.
        explained_fraction=min((item.selection.explained_fraction for item, _ in named), default=0.0),
        doubts=doubts,
        failures=log.failures,
        height_error_held_out=log.attempt(
            "error of heights", compute_height_error, None, main.problem, main.held_out, *blind
        ),
        height_error_fitted=log.attempt(
            "error of heights", compute_height_error, None, main.problem, main.data, main.base.point, main.final.point
        ),
        elapsed_s=perf_counter() - began_s,
        reasons=claimed.reasons,
        omissions=log.omissions,
        data_findings=inspection.findings,
        inspection_failures=inspection.failures,
    )


def _diagnose_subsystem(
    data: Dataset,
    hypotheses: list[Hypothesis],
    seed: int,
    prior: BaseParameterPrior,
    min_timing_sigma_s: float,
    shared: Mapping[str, TermValues],
    log: SearchLog,
    hold_out: bool,
) -> _SubsystemFit:
    fitted, held_out_runs = split_runs(data) if hold_out else (list(range(len(data.runs))), [])
    fitted_data, held_out = data.select(fitted), data.select(held_out_runs)
    log.on_progress("noise and nominal model")
    problem, base = fit_nominal(fitted_data, prior, min_timing_sigma_s, shared)
    nothing: tuple[tuple[InstrumentDisturbance, ...], FloatArray] = ((), np.zeros(len(data.value)))
    # Sought in all runs, held-out ones too: they are subtracted from the data, and no model gains by them.
    disturbances, added = log.attempt("disturbances of instruments", _find_disturbances, nothing, data, problem, base)
    # The noise was estimated with these in it, so everything begins again without.
    clean = drop_averaged_ends(remove_disturbances(data, added) if disturbances else data, problem.noise)
    if clean is not data:
        log.on_progress("nominal model without what instruments did to signals and to their ends")
        data = clean
        fitted_data, held_out = data.select(fitted), data.select(held_out_runs)
        problem, base = fit_nominal(fitted_data, prior, min_timing_sigma_s, shared)
    # An AC coupling leaves no zero that differs from run to run; where one does, that explanation is out.
    residual = problem.data.value - base.prediction
    coupled = log.attempt("zeros of the runs", find_dc_coupled, frozenset[str](), problem.data, residual, problem.noise)
    hypotheses = [
        item
        for item in hypotheses
        if not (discover_terms()[item.key].removes_zero and coupled.intersection(item.free[0].names))
    ]
    problem, base = log.attempt(
        "noise beside an effect", _revise_noise, (problem, base), problem, base, hypotheses, min_timing_sigma_s, log
    )
    selection = compare_explanations(problem, base, hypotheses, log)
    # Twins stay twins with more runs, so what they leave open is no reason to give up the held-out ones.
    first = claim(replace(selection.evidence, twins={}))
    # The noise stays that of the fitted runs, so that the two comparisons differ by the data alone.
    all_data = FitProblem(data, problem.noise, prior)
    if first.verdict in ("none", "undecided", "ambiguous") and held_out_runs:
        # The held-out, hottest runs may show an effect, or which one: compare the explanations with all runs.
        log.on_progress("fitting all runs")
        # Without a name the verdict decides whether all runs say more; with one of several names, all runs always
        # decide.
        chosen = replace(selection, claim=first).chosen
        all_base = fit(all_data, base.point, base.free)
        wider = compare_explanations(all_data, all_base, hypotheses, log)
        if claim(replace(wider.evidence, twins={})).verdict not in ("none", first.verdict) or chosen is not None:
            # Nothing is held out any more, so no gain can be claimed: the report says so instead of a number from
            # fitted runs.
            problem, base, held_out, selection = all_data, all_base, data.select([]), wider
    unchanged = tuple[HeldOutChange, ...]()
    changes = {
        item: log.attempt(
            "held-out runs", compute_held_out_changes, unchanged, problem, held_out, base.point, item.fit.point
        )
        for item in selection.candidates
    }
    # Judged twice: the sizes' intervals, which may raise a doubt, cost a fit to all runs and are computed for the
    # chosen one only.
    selection = selection.judge(changes, {})
    chosen = selection.chosen
    final, estimates = _fit_all(all_data, base, chosen, hypotheses, log)
    doubts = {} if chosen is None else {chosen: describe_doubts(chosen.hypotheses, estimates)}
    selection = selection.judge(changes, doubts)
    if selection.chosen is not chosen:
        final, estimates = _fit_all(all_data, base, selection.chosen, hypotheses, log)
    gains: dict[str, HeldOutGain | None] = {
        item.label: log.attempt(
            "held-out gain", compute_held_out_gain, None, problem, held_out, base.point, item.fit.point, seed
        )
        for item in selection.candidates
    }
    reductions = {label: gain.reduction for label, gain in gains.items() if gain is not None}
    if selection.chosen is None:
        unextended = (problem, held_out, base.point, base.point)
        own_changes = log.attempt("held-out runs", compute_held_out_changes, unchanged, *unextended)
    else:
        own_changes = changes[selection.chosen]
    return _SubsystemFit(
        data,
        held_out,
        problem,
        base,
        selection,
        final,
        estimates,
        own_changes,
        None if selection.chosen is None else gains[selection.chosen.label],
        judge_candidates(selection, reductions),
        list_rivals(selection, reductions),
        log.attempt("the next experiment", propose_for_verdict, None, problem, base, selection, log.on_progress),
        disturbances,
    )


def _find_disturbances(
    data: Dataset, problem: FitProblem, base: ModelFit
) -> tuple[tuple[InstrumentDisturbance, ...], FloatArray]:
    """Return the disturbances of the instruments beside the nominal fit, and their values in the data [m]."""
    prediction = predict(data, base.point)
    sensitivity = compute_jitter_sensitivity(data, base.point, prediction)
    return find_disturbances(data, data.value - prediction, sensitivity, problem.noise)


def _fit_all(
    problem: FitProblem,
    base: ModelFit,
    chosen: RefittedCandidate | None,
    hypotheses: list[Hypothesis],
    log: SearchLog,
) -> tuple[ModelFit, dict[str, Estimate]]:
    """Return the chosen model fitted to all runs, the nominal one if there is none, and its parameters."""
    log.on_progress("fitting all runs")
    start = base if chosen is None else chosen.fit
    # It starts at the optimum of most runs, so few steps suffice.
    final = fit(problem, start.point, start.free, iterations=6)
    if all(kind in MIRROR_KINDS for kind in problem.data.kinds):  # judge each point by its own jitter sensitivities
        points = (start.point, final.point)
        final = min((fit(problem, point, start.free, iterations=1) for point in points), key=lambda item: item.chi2)
    named = () if chosen is None else chosen.hypotheses
    covariance = log.attempt(
        "intervals beside other forms", compute_covariance, final.covariance, problem, final, named, hypotheses
    )
    estimates = compute_estimates(problem.data, final, covariance)
    return final, log.attempt("smallest sizes of effects", limit_sizes, estimates, problem, final, named, estimates)


def _revise_noise(
    problem: FitProblem, base: ModelFit, hypotheses: list[Hypothesis], min_timing_sigma_s: float, log: SearchLog
) -> tuple[FitProblem, ModelFit]:
    """Return the problem with noise estimated beside the best candidate, where repeats differ by its effect.

    Jitter sensitivities are those of the true model; a large effect changes them, and repeats seem to differ. An effect
    that changes from run to run makes them differ indeed, and passes for jitter.
    """
    detection = detect(problem, base, hypotheses, log)
    scores = detection.scores
    changes = bool(scores) and scores[0].ratio > MIN_CHANGE_RATIO and scores[0].hypothesis.key in _list_varying_causes()
    if not changes and not has_replicate_excess(problem):
        return problem, base
    best = next(iter(refit_strongest(problem, base, (), detection, log)), None)
    if best is None:
        return problem, base
    other = update_noise(problem, best.fit, min_timing_sigma_s)
    # Again beside the effect, which by itself may look like power that fluctuates.
    excess = compute_intra_pulse_power_excess(other, best.fit)
    other = replace(other, noise=replace(other.noise, intra_pulse_power_excess=excess))
    is_quieter = other.noise.power_sigma < QUIETER * problem.noise.power_sigma
    # Noise beside an effect counts only where it explains the repeats; else the strongest candidate would choose the
    # noise that favours it.
    if has_replicate_excess(other) or not (is_quieter or has_replicate_excess(problem)):
        return problem, base
    # The base fit is the nominal one still, and nothing is decided yet.
    return other, fit(other, base.point)


def _list_varying_causes() -> set[str]:
    """Return the causes whose effect changes from run to run."""
    return {key for key, term in discover_terms().items() if term.varies_between_runs}


def _find_shared_terms(subsystems: list[_SubsystemFit]) -> dict[str, TermValues]:
    """Return the identified terms of the clock that all instruments share."""
    return {
        key: values
        for subsystem in subsystems
        for key, values in subsystem.final.point.terms.items()
        if key in subsystem.selection.claim.causes
        and values.get("mirrors")
        # Only the clock is common to pixels and mirrors; any other cause of a pixel says nothing about a mirror.
        and len(discover_terms()[key].subsystems) > 1
    }


def _build_remarks(subsystems: list[_SubsystemFit]) -> tuple[str, ...]:
    out = []
    for subsystem in subsystems:
        noise = subsystem.problem.noise.coloured
        averaged = [SIGNALS[kind] for kind in noise if any(window.count > 1 for window in noise[kind].windows)]
        out += [
            f"{name}: noise of neighbouring samples is alike, as a mean or a filter leaves it: the ends of its runs, "
            "which a program computes from samples that it lacks, are left out."
            for name in averaged
        ]
        if subsystem.problem.noise.replicate_excess > MAX_REPLICATE_EXCESS:
            out.append(
                "Repeats of one experiment differ by far more than noise and jitter: something changes from run to run."
            )
        if subsystem.problem.noise.intra_pulse_power_excess > MAX_INTRA_PULSE_POWER_EXCESS:
            out.append("Repeats differ more during pulses: the power fluctuates within pulses.")
        if not subsystem.problem.noise.from_replicates:
            out.append(
                "No run repeats another: the noise is only guessed, so no cause is certain. Play every experiment two "
                "or three times and give its runs one `group`."
            )
        elif any(not run.has_stated_group for run in subsystem.data.runs):
            out.append("Runs without a `group` whose pulses are equal were taken as repeats of one experiment.")
        if not subsystem.problem.noise.has_noise:
            out.append(
                "Repeats are equal to the last digit, as copies or simulations without noise are: the noise is taken "
                "from the resolution of the data."
            )
        if subsystem.selection.claim.verdict == "cause" and subsystem.selection.explained_fraction < NEARLY_EXPLAINED:
            causes = " and ".join(subsystem.selection.claim.causes)
            out.append(
                f"{causes}: {1 - subsystem.selection.explained_fraction:.1%} of the excess χ² remains, because the "
                "real effect deviates slightly from the form of its term."
            )
        out += [*_describe_range_limits(subsystem.final), *_list_runs(subsystem)]
    return tuple(dict.fromkeys(out))


def _describe_range_limits(final: ModelFit) -> list[str]:
    out = []
    for free in final.free:
        value = final.point.terms[free.key][free.names[0]]
        if is_at_limit(final, free):
            out.append(
                f"{free.label} is at the limit of its plausible range, {format_quantity(value, free.parameter.unit)}."
            )
    return out


def _list_runs(subsystem: _SubsystemFit) -> list[str]:
    """Return in which runs an instrument's record differs, where it does not in all."""
    runs: dict[tuple[str, str, str], list[str]] = {}
    for key, values in subsystem.final.point.terms.items():
        term = discover_terms()[key]
        if term.only_records and term.varies_between_runs:
            for block, recorded in zip(subsystem.data.blocks, subsystem.data.recorded_runs, strict=True):
                name = BySignal._fields[block.kind]
                change = float(term.record(values, name, np.zeros(1), np.ones(1), recorded)[0]) - 1.0
                if change:
                    place = key, SIGNALS[block.kind], f"{change:+.1%}"
                    runs.setdefault(place, []).append(subsystem.data.runs[block.run].name)
    return [f"{key}: {signal} is off by {off} in {list_names(names)}." for (key, signal, off), names in runs.items()]
