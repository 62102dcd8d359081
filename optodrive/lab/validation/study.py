"""Study of Text S1: necessary causes, their alternatives, and predictions of held-out facts."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from optodrive.lab.validation.candidate_causes import CAUSES_BY_KEY
from optodrive.lab.validation.cause_search import AICC_INDISTINGUISHABLE, CAUSE_COST, CauseFit, CauseSearch
from optodrive.lab.validation.contradictions import Contradiction, find_contradictions
from optodrive.lab.validation.measured_facts import GROUPS, Datum, build_measured_facts
from optodrive.physics.paper_facts import PaperFact
from optodrive.physics.parameters import ParameterSet

CHI2_NOT_OBSERVABLE = 4.0
"""A cause that changes χ² by less than this at both limits of its range is not observable: two σ."""
EVIDENCE_FRACTION = 0.8
"""The evidence for a cause is the facts that hold this share of its reduction of χ²."""
RULED_OUT_FRACTION = 0.5
"""A cause that achieves this share of another's reduction counts as ruled out rather than as not needed."""
UNEXPLAINED_SIGMA = 2.0
"""Deviation in standard errors from which a fact counts as unexplained."""


@dataclass(frozen=True)
class NamedCause:
    """Necessary cause with its parameter and 95 % interval.

    chi2_reduction: increase of χ² without it; evidence: the facts that hold most of that; alternatives: causes that fit
    as well in its place
    """

    key: str
    value: float
    low: float
    high: float
    chi2_reduction: float
    evidence: tuple[str, ...]
    alternatives: tuple[str, ...]


@dataclass(frozen=True)
class UnchosenCause:
    """Cause outside the chosen set.

    verdict: "alternative cause" for a chosen one; "alternative law" in addition to the chosen causes; "not observable"
    in these facts; "ruled out" although it reduces χ² enough alone or by RULED_OUT_FRACTION in place of a chosen cause;
    or "not needed". value: its parameter beside the chosen causes, None where it is incompatible with them.
    chi2_reduction_alone, chi2_reduction_added: from the nominal model, and from the chosen causes; replaces: the chosen
    cause that it replaces best, or ''; replaced_fraction: the share of that cause's reduction of χ² that it achieves
    """

    key: str
    verdict: str
    value: float | None
    chi2_reduction_alone: float
    chi2_reduction_added: float
    replaces: str
    replaced_fraction: float


@dataclass(frozen=True)
class HeldOutPrediction:
    """Prediction of facts held out of choice and fit.

    nominal, extended: ratios model over measured; unobservable: named causes that no remaining fact shows
    """

    label: str
    facts: tuple[str, ...]
    causes: tuple[str, ...]
    unobservable: tuple[str, ...]
    nominal: tuple[float, ...]
    extended: tuple[float, ...]


@dataclass(frozen=True)
class StudyResult:
    """Result of a study.

    nominal_ratios, extended_ratios: model over measured, by fact
    """

    base: str
    data: tuple[Datum, ...]
    nominal_ratios: tuple[float, ...]
    extended_ratios: tuple[float, ...]
    errors_sigma: tuple[float, ...]
    nominal_fit: CauseFit
    fit: CauseFit
    named: tuple[NamedCause, ...]
    unchosen: tuple[UnchosenCause, ...]
    contradictions: tuple[Contradiction, ...]
    group_predictions: tuple[HeldOutPrediction, ...]
    fact_predictions: tuple[HeldOutPrediction, ...]

    @property
    def unpredictable(self) -> tuple[HeldOutPrediction, ...]:
        """Groups of facts that alone show one of the named causes."""
        return tuple(item for item in self.group_predictions if item.unobservable)

    @property
    def predictions(self) -> tuple[HeldOutPrediction, ...]:
        """Predictions with each fact once: held out with its group, or alone where only its group shows a cause."""
        held_out_alone = {name for group in self.unpredictable for name in group.facts}
        return tuple(
            item
            for item in (*self.group_predictions, *self.fact_predictions)
            if item.label in held_out_alone or not item.unobservable
        )

    @property
    def unexplained(self) -> tuple[str, ...]:
        """Facts that the extended model does not explain."""
        pairs = zip(self.data, self.errors_sigma, strict=True)
        return tuple(datum.id for datum, error in pairs if abs(error) > UNEXPLAINED_SIGMA)


def compute_error_factor(ratios: Sequence[float]) -> float:
    """Return the typical error factor, the geometric rms of the ratios: 1 is perfect."""
    return float(np.exp(np.sqrt(np.mean(np.log(np.array(ratios)) ** 2)))) if ratios else float("nan")


def run_study(
    facts: Mapping[str, PaperFact], base: ParameterSet, on_progress: Callable[[str], None] = lambda stage: None
) -> StudyResult:
    """Diagnose a parameter set by the paper's facts."""
    data = build_measured_facts(facts, base)
    on_progress("choosing causes")
    search = CauseSearch(base, data)
    chosen = search.choose()
    named = _build_named_causes(search, chosen)
    group_predictions, fact_predictions = [], []
    for group, names in GROUPS.items():
        on_progress(f"holding out {group}")
        prediction = predict_held_out(base, data, group, names, named)
        group_predictions.append(prediction)
        if prediction.unobservable:
            fact_predictions += [predict_held_out(base, data, name, (name,), named) for name in names]
    return StudyResult(
        base=base.name,
        data=data,
        nominal_ratios=_compute_ratios(search, search.nominal, data),
        extended_ratios=_compute_ratios(search, chosen, data),
        errors_sigma=tuple(
            (search.build_model(chosen).compute_log_errors(data) / [datum.sigma for datum in data]).tolist()
        ),
        nominal_fit=search.nominal,
        fit=chosen,
        named=named,
        unchosen=_judge_unchosen(search, chosen),
        contradictions=find_contradictions(facts),
        group_predictions=tuple(group_predictions),
        fact_predictions=tuple(fact_predictions),
    )


def predict_held_out(
    base: ParameterSet, data: Sequence[Datum], label: str, names: Sequence[str], named: Sequence[NamedCause]
) -> HeldOutPrediction:
    """Repeat choice and fit without some facts and predict these.

    named: the causes named by all facts
    """
    search = CauseSearch(base, [datum for datum in data if datum.id not in names])
    chosen = search.choose()
    held_out_data = [datum for datum in data if datum.id in names]
    unobservable = [item.key for item in named if not {item.key, *item.alternatives} & set(chosen.keys)]
    nominal, extended = (
        _compute_ratios(search, search.nominal, held_out_data),
        _compute_ratios(search, chosen, held_out_data),
    )
    return HeldOutPrediction(label, tuple(names), chosen.keys, tuple(unobservable), nominal, extended)


def _compute_ratios(search: CauseSearch, fit: CauseFit, data: Sequence[Datum]) -> tuple[float, ...]:
    model = search.build_model(fit)
    return tuple(model.compute_outcome(datum.id) / datum.value for datum in data)


def _build_named_causes(search: CauseSearch, chosen: CauseFit) -> tuple[NamedCause, ...]:
    removed, exchanged = search.fit_removals(chosen), search.fit_exchanges(chosen)
    out = []
    for key in chosen.keys:
        alternatives = [
            other
            for (chosen_key, other), fit in exchanged.items()
            if chosen_key == key and fit.aicc - chosen.aicc < AICC_INDISTINGUISHABLE
        ]
        low, high = search.compute_interval(chosen, key)
        chi2_reduction = removed[key].chi2 - chosen.chi2
        evidence = _find_evidence(search, removed[key], chosen)
        out.append(NamedCause(key, chosen.values[key], low, high, chi2_reduction, evidence, tuple(alternatives)))
    return tuple(sorted(out, key=lambda item: -item.chi2_reduction))


def _find_evidence(search: CauseSearch, without: CauseFit, chosen: CauseFit) -> tuple[str, ...]:
    """Return the facts that hold EVIDENCE_FRACTION of a cause's reduction of χ², largest first."""
    reductions = search.compute_chi2_terms(without) - search.compute_chi2_terms(chosen)
    out: list[str] = []
    total = 0.0
    for index in np.argsort(-reductions).tolist():
        if total >= EVIDENCE_FRACTION * reductions.clip(0.0).sum():
            break
        total += float(reductions[index])
        out.append(search.data[index].id)
    return tuple(out)


def _judge_unchosen(search: CauseSearch, chosen: CauseFit) -> tuple[UnchosenCause, ...]:
    exchanged, removed = search.fit_exchanges(chosen), search.fit_removals(chosen)
    added = {fit.keys[-1]: fit for fit in search.fit_additions(chosen)}
    out = []
    for key, cause in CAUSES_BY_KEY.items():
        if key in chosen.keys:
            continue
        chi2_reduction_alone = search.nominal.chi2 - search.fit((key,)).chi2
        swaps = {chosen_key: fit for (chosen_key, other), fit in exchanged.items() if other == key}
        replaced_fractions = {
            chosen_key: _compute_replaced_fraction(removed[chosen_key], fit, chosen)
            for chosen_key, fit in swaps.items()
        }
        replaces = max(replaced_fractions, key=lambda chosen_key: replaced_fractions[chosen_key], default="")
        chi2_reduction_added = chosen.chi2 - added[key].chi2 if key in added else 0.0
        if any(fit.aicc - chosen.aicc < AICC_INDISTINGUISHABLE for fit in swaps.values()):
            verdict = "alternative cause"
        elif key in added and cause.replaces_law and added[key].aicc - chosen.aicc < AICC_INDISTINGUISHABLE:
            verdict = "alternative law"
        elif (
            key in added
            and not cause.replaces_law
            and search.compute_max_chi2_increase(chosen, key) < CHI2_NOT_OBSERVABLE
        ):
            verdict = "not observable"
        else:
            is_plausible = (
                chi2_reduction_alone >= CAUSE_COST or replaced_fractions.get(replaces, 0.0) >= RULED_OUT_FRACTION
            )
            verdict = "ruled out" if is_plausible else "not needed"
        value = added[key].values[key] if key in added else None
        out.append(
            UnchosenCause(
                key,
                verdict,
                value,
                chi2_reduction_alone,
                chi2_reduction_added,
                replaces,
                replaced_fractions.get(replaces, 0.0),
            )
        )
    return tuple(sorted(out, key=lambda item: -item.chi2_reduction_alone))


def _compute_replaced_fraction(without: CauseFit, swapped: CauseFit, chosen: CauseFit) -> float:
    """Return the share of one cause's reduction of χ² that another achieves in its place."""
    return (without.chi2 - swapped.chi2) / (without.chi2 - chosen.chi2)
