"""The whole question: which causes the facts ask for, what is like them, and what they predict of facts left out."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from optodrive.lab.validation.candidate_causes import index_causes
from optodrive.lab.validation.cause_search import AICC_INDISTINGUISHABLE, CAUSE_COST, CauseFit, CauseSearch
from optodrive.lab.validation.contradictions import Contradiction, find_contradictions
from optodrive.lab.validation.measured_facts import GROUPS, Datum, build_data
from optodrive.physics.paper_facts import PaperFact
from optodrive.physics.parameters import ParameterSet

CHI2_NOT_OBSERVABLE = 4.0
"""A cause that changes χ² by less, at either end of its range, is one that these facts cannot show: two σ."""
EVIDENCE_FRACTION = 0.8
"""A cause rests on the facts that hold so much of what it takes."""
RULED_OUT_FRACTION = 0.5
"""A cause that takes so much in a named one's place is told as ruled out, not as idle."""
UNEXPLAINED_SIGMA = 2.0
"""Standard errors from which a fact counts as unexplained."""


@dataclass(frozen=True)
class NamedCause:
    """A cause that is needed: its number and 95 % of it.

    taken: by how much χ² grows without it; rests_on: the facts that hold most of that; alike: causes that would do
    as well
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
    """A cause that is not in the chosen set.

    verdict: "alike" one that is, "as good" beside them in the place of a law, "not shown" by these facts whatever its
    number, "ruled out" though it takes enough alone or HALF in a named one's place, or "not needed"
    value: its number beside the chosen causes, None where it cannot stand there; alone, beside: χ² that it takes from
    the nominal model, and from the chosen causes; place: the named cause that it replaces best, '' where it can replace
    none; regained: the share of that cause's χ² that it takes there
    """

    key: str
    verdict: str
    value: float | None
    chi2_reduction_alone: float
    chi2_reduction_added: float
    replaces: str
    replaced_fraction: float


@dataclass(frozen=True)
class LeaveOutPrediction:
    """Facts left out of choice and fit, and predicted.

    before, after: ratios model over measured, nominal and extended; lost: named causes that no fact left shows
    """

    label: str
    facts: tuple[str, ...]
    causes: tuple[str, ...]
    unobservable: tuple[str, ...]
    nominal: tuple[float, ...]
    extended: tuple[float, ...]


@dataclass(frozen=True)
class StudyResult:
    """All there is to tell; nominal, extended: model over measured, fact by fact; misses: in standard errors."""

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
    group_predictions: tuple[LeaveOutPrediction, ...]
    fact_predictions: tuple[LeaveOutPrediction, ...]

    @property
    def unpredictable(self) -> tuple[LeaveOutPrediction, ...]:
        """Groups that alone show one of the named causes."""
        return tuple(item for item in self.group_predictions if item.unobservable)

    @property
    def predictions(self) -> tuple[LeaveOutPrediction, ...]:
        """Each fact once: with its whole group left out, or by itself where nothing else shows a cause."""
        lost = {name for group in self.unpredictable for name in group.facts}
        return tuple(
            item
            for item in (*self.group_predictions, *self.fact_predictions)
            if item.label in lost or not item.unobservable
        )

    @property
    def unexplained(self) -> tuple[str, ...]:
        """Facts that the extended model misses."""
        pairs = zip(self.data, self.errors_sigma, strict=True)
        return tuple(datum.id for datum, miss in pairs if abs(miss) > UNEXPLAINED_SIGMA)


def compute_error_factor(ratios: Sequence[float]) -> float:
    """The factor by which facts are missed, geometric rms: 1 is perfect."""
    return float(np.exp(np.sqrt(np.mean(np.log(np.array(ratios)) ** 2)))) if ratios else float("nan")


def run_study(
    facts: Mapping[str, PaperFact], base: ParameterSet, on_progress: Callable[[str], None] = lambda what: None
) -> StudyResult:
    """Diagnose a parameter set by the paper's facts."""
    data = build_data(facts, base)
    on_progress("choosing causes")
    search = CauseSearch(base, data)
    chosen = search.choose()
    named = _build_named_causes(search, chosen)
    group_predictions, fact_predictions = [], []
    for group, names in GROUPS.items():
        on_progress(f"leaving out {group}")
        prediction = predict_left_out(base, data, group, names, named)
        group_predictions.append(prediction)
        if prediction.unobservable:
            fact_predictions += [predict_left_out(base, data, name, (name,), named) for name in names]
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


def predict_left_out(
    base: ParameterSet, data: Sequence[Datum], label: str, names: Sequence[str], named: Sequence[NamedCause]
) -> LeaveOutPrediction:
    """Choice and fit made anew without some facts, then those predicted; named: what all facts together name."""
    search = CauseSearch(base, [datum for datum in data if datum.id not in names])
    chosen = search.choose()
    left_out_data = [datum for datum in data if datum.id in names]
    unobservable = [item.key for item in named if not {item.key, *item.alternatives} & set(chosen.keys)]
    nominal, extended = (
        _compute_ratios(search, search.nominal, left_out_data),
        _compute_ratios(search, chosen, left_out_data),
    )
    return LeaveOutPrediction(label, tuple(names), chosen.keys, tuple(unobservable), nominal, extended)


def _compute_ratios(search: CauseSearch, fit: CauseFit, data: Sequence[Datum]) -> tuple[float, ...]:
    model = search.build_model(fit)
    return tuple(model.compute_outcome(datum.id) / datum.value for datum in data)


def _build_named_causes(search: CauseSearch, chosen: CauseFit) -> tuple[NamedCause, ...]:
    removed, exchanged = search.fit_removals(chosen), search.fit_exchanges(chosen)
    out = []
    for key in chosen.keys:
        alternatives = [
            other
            for (own, other), fit in exchanged.items()
            if own == key and fit.aicc - chosen.aicc < AICC_INDISTINGUISHABLE
        ]
        low, high = search.compute_interval(chosen, key)
        chi2_reduction = removed[key].chi2 - chosen.chi2
        evidence = _find_evidence(search, removed[key], chosen)
        out.append(NamedCause(key, chosen.values[key], low, high, chi2_reduction, evidence, tuple(alternatives)))
    return tuple(sorted(out, key=lambda item: -item.chi2_reduction))


def _find_evidence(search: CauseSearch, without: CauseFit, chosen: CauseFit) -> tuple[str, ...]:
    """The facts that, the most first, hold MOST_OF of what a cause takes."""
    reductions = search.compute_chi2_terms(without) - search.compute_chi2_terms(chosen)
    out: list[str] = []
    total = 0.0
    for place in np.argsort(-reductions).tolist():
        if total >= EVIDENCE_FRACTION * reductions.clip(0.0).sum():
            break
        total += float(reductions[place])
        out.append(search.data[place].id)
    return tuple(out)


def _judge_unchosen(search: CauseSearch, chosen: CauseFit) -> tuple[UnchosenCause, ...]:
    exchanged, removed = search.fit_exchanges(chosen), search.fit_removals(chosen)
    added = {fit.keys[-1]: fit for fit in search.fit_additions(chosen)}
    out = []
    for key, cause in index_causes().items():
        if key in chosen.keys:
            continue
        chi2_reduction_alone = search.nominal.chi2 - search.fit((key,)).chi2
        swaps = {own: fit for (own, other), fit in exchanged.items() if other == key}
        replaced_fractions = {own: _compute_replaced_fraction(removed[own], fit, chosen) for own, fit in swaps.items()}
        replaces = max(replaced_fractions, key=lambda own: replaced_fractions[own], default="")
        chi2_reduction_added = chosen.chi2 - added[key].chi2 if key in added else 0.0
        if any(fit.aicc - chosen.aicc < AICC_INDISTINGUISHABLE for fit in swaps.values()):
            verdict = "alike"
        elif key in added and cause.replaces_law and added[key].aicc - chosen.aicc < AICC_INDISTINGUISHABLE:
            verdict = "as good"
        elif (
            key in added
            and not cause.replaces_law
            and search.compute_max_chi2_increase(chosen, key) < CHI2_NOT_OBSERVABLE
        ):
            verdict = "not shown"
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
    """Share of what a cause takes that another takes in its place."""
    return (without.chi2 - swapped.chi2) / (without.chi2 - chosen.chi2)
