"""Study of Text S1: necessary causes, their alternatives, and predictions of held-out facts."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from optodrive.core.types.discrepancy import Probabilities
from optodrive.lab.inference.claim import Claim, HeldOutChange, claim
from optodrive.lab.validation.causes import AICC_INDISTINGUISHABLE, CAUSES_BY_KEY, CauseFit, CauseSearch
from optodrive.lab.validation.facts import GROUPS, Contradiction, Datum, build_measured_facts, find_contradictions
from optodrive.physics.paper_facts import PaperFact
from optodrive.physics.parameters import ParameterSet

CHI2_NOT_OBSERVABLE = 4.0
"""A cause that changes χ² by less than this at both limits of its range is not observable: two σ."""
EVIDENCE_FRACTION = 0.8
"""The evidence for a cause is the facts that hold this share of its reduction of χ²."""
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

    probability: that it acts; value: its parameter beside the chosen causes, None where it is incompatible with them;
    chi2_reduction_alone, chi2_reduction_added: from the nominal model, and from the chosen causes; replaces: the chosen
    cause that it replaces best, or ''; replaced_fraction: the share of that cause's reduction of χ² that it achieves;
    is_observable: whether it changes χ² by more than noise at a limit of its range; is_alternative_law: whether it fits
    as well beside the chosen causes, in place of a law that no parameter of the nominal model changes
    """

    key: str
    probability: float
    value: float | None
    chi2_reduction_alone: float
    chi2_reduction_added: float
    replaces: str
    replaced_fraction: float
    is_observable: bool
    is_alternative_law: bool


@dataclass(frozen=True)
class HeldOutPrediction:
    """Prediction of facts held out of choice and fit.

    nominal, extended: ratios model over measured; changes: of their χ²; unobservable: named causes that no remaining
    fact shows
    """

    label: str
    facts: tuple[str, ...]
    causes: tuple[str, ...]
    unobservable: tuple[str, ...]
    nominal: tuple[float, ...]
    extended: tuple[float, ...]
    changes: tuple[HeldOutChange, ...]


@dataclass(frozen=True)
class StudyResult:
    """Result of a study.

    nominal_ratios, extended_ratios: model over measured, by fact
    """

    base: str
    data: tuple[Datum, ...]
    claim: Claim
    probabilities: Probabilities
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
        both = (*self.group_predictions, *self.fact_predictions)
        return tuple(item for item in both if item.label in held_out_alone or not item.unobservable)

    @property
    def untested(self) -> dict[str, str]:
        """Causes that a single fact shows, with that fact: no prediction tests them."""
        return {key: item.label for item in self.fact_predictions for key in item.unobservable}

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
    model = search.build_model(chosen)
    result = StudyResult(
        base=base.name,
        data=data,
        claim=claim(search.collect_evidence()),
        probabilities=search.weigh(),
        nominal_ratios=_compute_ratios(search, search.nominal, data),
        extended_ratios=_compute_ratios(search, chosen, data),
        errors_sigma=tuple((model.compute_log_errors(data) / [datum.sigma for datum in data]).tolist()),
        nominal_fit=search.nominal,
        fit=chosen,
        named=named,
        unchosen=_judge_unchosen(search, chosen),
        contradictions=find_contradictions(facts),
        group_predictions=tuple(group_predictions),
        fact_predictions=tuple(fact_predictions),
    )
    tested = [change for item in result.predictions if not item.unobservable for change in item.changes]
    doubts = {key: f"only {fact} shows it, so no prediction tests it" for key, fact in result.untested.items()}
    return replace(result, claim=claim(search.collect_evidence(tested, doubts)), probabilities=search.weigh())


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
    fits = search.nominal, chosen
    nominal, extended = (_compute_ratios(search, fit, held_out_data) for fit in fits)
    errors = [search.build_model(fit).compute_log_errors(held_out_data) for fit in fits]
    changes = tuple(
        HeldOutChange(label, datum.id, (after**2 - before**2) / datum.sigma**2, 2.0 * abs(after - before) / datum.sigma)
        for datum, before, after in zip(held_out_data, *(each.tolist() for each in errors), strict=True)
    )
    return HeldOutPrediction(label, tuple(names), chosen.keys, tuple(unobservable), nominal, extended, changes)


def _compute_ratios(search: CauseSearch, fit: CauseFit, data: Sequence[Datum]) -> tuple[float, ...]:
    model = search.build_model(fit)
    return tuple(model.compute_outcome(datum.id) / datum.value for datum in data)


def _build_named_causes(search: CauseSearch, chosen: CauseFit) -> tuple[NamedCause, ...]:
    removed, exchanged = search.fit_removals(chosen), search.fit_exchanges(chosen)
    out = []
    for key in chosen.keys:
        own = ((other, fit) for (chosen_key, other), fit in exchanged.items() if chosen_key == key)
        alternatives = [other for other, fit in own if fit.aicc - chosen.aicc < AICC_INDISTINGUISHABLE]
        low, high = chosen.interval(key)
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
    alone = {key: search.nominal.chi2 - search.fit((key,)).chi2 for key in CAUSES_BY_KEY if key not in chosen.keys}
    probabilities, out = search.weigh(), []
    for key, reduction in sorted(alone.items(), key=lambda item: -item[1]):
        own = ((mine, removed[mine].chi2, fit) for (mine, other), fit in exchanged.items() if other == key)
        shares = {mine: (without - fit.chi2) / (without - chosen.chi2) for mine, without, fit in own}
        replaces, fit = max(shares, key=lambda mine: shares[mine], default=""), added.get(key)
        is_law = CAUSES_BY_KEY[key].replaces_law
        value, added_reduction = (None, 0.0) if fit is None else (fit.values[key], chosen.chi2 - fit.chi2)
        replaced = replaces, shares.get(replaces, 0.0)
        is_seen = fit is None or is_law or search.compute_max_chi2_increase(chosen, key) >= CHI2_NOT_OBSERVABLE
        is_other_law = fit is not None and is_law and fit.aicc - chosen.aicc < AICC_INDISTINGUISHABLE
        judged = value, reduction, added_reduction, *replaced, is_seen, is_other_law
        out.append(UnchosenCause(key, probabilities.sum_of(key), *judged))
    return tuple(out)
