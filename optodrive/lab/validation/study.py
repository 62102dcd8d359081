"""The whole question: which causes the facts ask for, what is like them, and what they predict of facts left out."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from optodrive.lab.validation.candidate_causes import catalogue
from optodrive.lab.validation.cause_search import APART, NAMED, Fit, Search
from optodrive.lab.validation.contradictions import Contradiction, contradictions
from optodrive.lab.validation.measured_facts import GROUPS, Datum, recording
from optodrive.physics.paper_facts import Fact
from optodrive.physics.parameters import ParameterSet

UNSEEN = 4.0
"""A cause that changes χ² by less, at either end of its range, is one that these facts cannot show: two σ."""
MOST_OF = 0.8
"""A cause rests on the facts that hold so much of what it takes."""
HALF = 0.5
"""A cause that takes so much in a named one's place is told as ruled out, not as idle."""
MISSED = 2.0
"""Standard errors from which a fact counts as unexplained."""


@dataclass(frozen=True)
class Named:
    """A cause that is needed: its number and 95 % of it.

    taken: by how much χ² grows without it; rests_on: the facts that hold most of that; alike: causes that would do
    as well
    """

    key: str
    value: float
    low: float
    high: float
    taken: float
    rests_on: tuple[str, ...]
    alike: tuple[str, ...]


@dataclass(frozen=True)
class Candidate:
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
    alone: float
    beside: float
    place: str
    regained: float


@dataclass(frozen=True)
class LeftOut:
    """Facts left out of choice and fit, and predicted.

    before, after: ratios model over measured, nominal and extended; lost: named causes that no fact left shows
    """

    label: str
    facts: tuple[str, ...]
    causes: tuple[str, ...]
    lost: tuple[str, ...]
    before: tuple[float, ...]
    after: tuple[float, ...]


@dataclass(frozen=True)
class Answer:
    """All there is to tell; nominal, extended: model over measured, fact by fact; misses: in standard errors."""

    base: str
    data: tuple[Datum, ...]
    nominal: tuple[float, ...]
    extended: tuple[float, ...]
    misses: tuple[float, ...]
    before: Fit
    chosen: Fit
    named: tuple[Named, ...]
    candidates: tuple[Candidate, ...]
    contradicted: tuple[Contradiction, ...]
    groups: tuple[LeftOut, ...]
    singles: tuple[LeftOut, ...]

    @property
    def unpredicted(self) -> tuple[LeftOut, ...]:
        """Groups that alone show one of the named causes."""
        return tuple(item for item in self.groups if item.lost)

    @property
    def predictions(self) -> tuple[LeftOut, ...]:
        """Each fact once: with its whole group left out, or by itself where nothing else shows a cause."""
        lost = {name for group in self.unpredicted for name in group.facts}
        return tuple(item for item in (*self.groups, *self.singles) if item.label in lost or not item.lost)

    @property
    def unexplained(self) -> tuple[str, ...]:
        """Facts that the extended model misses."""
        pairs = zip(self.data, self.misses, strict=True)
        return tuple(datum.id for datum, miss in pairs if abs(miss) > MISSED)


def factor(ratios: Sequence[float]) -> float:
    """The factor by which facts are missed, geometric rms: 1 is perfect."""
    return float(np.exp(np.sqrt(np.mean(np.log(np.array(ratios)) ** 2)))) if ratios else float("nan")


def study(facts: Mapping[str, Fact], base: ParameterSet, tick: Callable[[str], None] = lambda what: None) -> Answer:
    """Diagnose a parameter set by the paper's facts."""
    data = recording(facts, base)
    tick("choosing causes")
    search = Search(base, data)
    chosen = search.choose()
    named = _named(search, chosen)
    groups, singles = [], []
    for group, names in GROUPS.items():
        tick(f"leaving out {group}")
        whole = left_out(base, data, group, names, named)
        groups.append(whole)
        if whole.lost:
            singles += [left_out(base, data, name, (name,), named) for name in names]
    return Answer(
        base=base.name,
        data=data,
        nominal=_ratios(search, search.nominal, data),
        extended=_ratios(search, chosen, data),
        misses=tuple((search.model(chosen).misses(data) / [datum.sigma for datum in data]).tolist()),
        before=search.nominal,
        chosen=chosen,
        named=named,
        candidates=_candidates(search, chosen),
        contradicted=contradictions(facts),
        groups=tuple(groups),
        singles=tuple(singles),
    )


def left_out(
    base: ParameterSet, data: Sequence[Datum], label: str, names: Sequence[str], named: Sequence[Named]
) -> LeftOut:
    """Choice and fit made anew without some facts, then those predicted; named: what all facts together name."""
    search = Search(base, [datum for datum in data if datum.id not in names])
    chosen = search.choose()
    hidden = [datum for datum in data if datum.id in names]
    lost = [item.key for item in named if not {item.key, *item.alike} & set(chosen.keys)]
    before, after = _ratios(search, search.nominal, hidden), _ratios(search, chosen, hidden)
    return LeftOut(label, tuple(names), chosen.keys, tuple(lost), before, after)


def _ratios(search: Search, fit: Fit, data: Sequence[Datum]) -> tuple[float, ...]:
    model = search.model(fit)
    return tuple(model.outcome(datum.id) / datum.value for datum in data)


def _named(search: Search, chosen: Fit) -> tuple[Named, ...]:
    removed, exchanged = search.removals(chosen), search.exchanges(chosen)
    out = []
    for key in chosen.keys:
        alike = [other for (own, other), fit in exchanged.items() if own == key and fit.aicc - chosen.aicc < APART]
        low, high = search.interval(chosen, key)
        taken = removed[key].chi2 - chosen.chi2
        rests_on = _held_by(search, removed[key], chosen)
        out.append(Named(key, chosen.numbers[key], low, high, taken, rests_on, tuple(alike)))
    return tuple(sorted(out, key=lambda item: -item.taken))


def _held_by(search: Search, without: Fit, chosen: Fit) -> tuple[str, ...]:
    """The facts that, the most first, hold MOST_OF of what a cause takes."""
    taken = search.squares(without) - search.squares(chosen)
    out: list[str] = []
    held = 0.0
    for place in np.argsort(-taken).tolist():
        if held >= MOST_OF * taken.clip(0.0).sum():
            break
        held += float(taken[place])
        out.append(search.data[place].id)
    return tuple(out)


def _candidates(search: Search, chosen: Fit) -> tuple[Candidate, ...]:
    exchanged, removed = search.exchanges(chosen), search.removals(chosen)
    added = {fit.keys[-1]: fit for fit in search.additions(chosen)}
    out = []
    for key, cause in catalogue().items():
        if key in chosen.keys:
            continue
        alone = search.nominal.chi2 - search.fit((key,)).chi2
        swaps = {own: fit for (own, other), fit in exchanged.items() if other == key}
        regained = {own: _regained(removed[own], fit, chosen) for own, fit in swaps.items()}
        place = max(regained, key=lambda own: regained[own], default="")
        beside = chosen.chi2 - added[key].chi2 if key in added else 0.0
        if any(fit.aicc - chosen.aicc < APART for fit in swaps.values()):
            verdict = "alike"
        elif key in added and cause.instead and added[key].aicc - chosen.aicc < APART:
            verdict = "as good"
        elif key in added and not cause.instead and search.most_changed(chosen, key) < UNSEEN:
            verdict = "not shown"
        else:
            tempting = alone >= NAMED or regained.get(place, 0.0) >= HALF
            verdict = "ruled out" if tempting else "not needed"
        value = added[key].numbers[key] if key in added else None
        out.append(Candidate(key, verdict, value, alone, beside, place, regained.get(place, 0.0)))
    return tuple(sorted(out, key=lambda item: -item.alone))


def _regained(without: Fit, swapped: Fit, chosen: Fit) -> float:
    """Share of what a cause takes that another takes in its place."""
    return (without.chi2 - swapped.chi2) / (without.chi2 - chosen.chi2)
