"""Sentences that state a claim and its numbers."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

from optodrive.core.quantity import format_quantity
from optodrive.core.types.discrepancy import Discrepancy, HeldOutGain, InstrumentDisturbance, Probabilities
from optodrive.lab.inference.claim import NOTHING_FOUND, Claim, TermClaim, format_probability
from optodrive.physics.term import Term

MIN_SHOWN = 0.01
"""Smallest probability of a set of causes that the text states."""


def describe_claim(found: Discrepancy, terms: Mapping[str, Term]) -> list[str]:
    """Return the headline, and why it is not more definite.

    terms: by key, those of the causes named at least
    """
    return [_build_headline(found, [terms[key] for key in found.causes]), *found.reasons]


def _build_headline(found: Discrepancy, causes: Sequence[Term]) -> str:
    failed = ", ".join(found.failures)
    if found.verdict == "none":
        return "No error found: the refitted nominal model agrees with this recording within its noise."
    if found.verdict == "undecided":
        return "Undecided: this recording shows neither an error of the nominal model nor that there is none."
    if found.verdict == "instrument":
        disturbed = " and ".join(describe_disturbance(item) for item in found.disturbances)
        return f"No error of the model found, but an instrument is disturbed: {disturbed}."
    if found.verdict == "incomplete":
        return f"The search is incomplete, for {failed} could not be computed; nothing else shows an error."
    doubts = "".join(f", but {clause}" for clause in found.doubts.values())
    others = f"; {failed} could not be computed and may explain it" if failed else ""
    wrong = _describe_difference(causes)
    labels = [term.label for term in causes]
    if found.verdict == "cause":
        return f"{wrong}{', perhaps' if doubts or failed else ''} because {' and '.join(labels)}{doubts}{others}."
    if found.verdict == "ambiguous" and len(labels) == 1:
        probability = format_probability(found.probabilities.sum_of(found.causes[0]))
        return f"{wrong}, perhaps because {labels[0]} ({probability}){doubts}{others}."
    if found.verdict == "ambiguous":
        return f"{wrong}; this data cannot separate these causes: {'; or '.join(labels)}{doubts}{others}."
    return f"{wrong}, and no known cause explains it{others}."


def describe_sufficiency(
    found: Claim, probabilities: Probabilities, model: str, labels: Mapping[str, str]
) -> list[str]:
    """Return whether a model suffices, and why the answer is not more definite.

    model: its name, at the beginning of a sentence; labels: of the causes, by key
    """
    named = ["; ".join(" and ".join(labels[key] for key in keys) for keys in found.sets)]
    if len(found.sets) == 1:
        probability = min((probabilities.sum_of(key) for key in found.causes), default=0.0)
        named.append(f"({format_probability(probability)})")
    headline = {
        "none": f"{model} suffices ({format_probability(probabilities.no_effect)}).",
        "undecided": f"Undecided: this data shows neither that {model} suffices nor that it does not.",
        "cause": f"{model} does not suffice: {' '.join(named)}.",
        "ambiguous": f"{model} does not suffice, perhaps: {' '.join(named)}"
        + (", which this data cannot separate." if len(found.sets) > 1 else "."),
    }.get(found.verdict, f"{model} does not suffice, and nothing known explains it.")
    return [headline, *found.reasons]


def _describe_difference(causes: Iterable[Term]) -> str:
    """Return a clause on the model or on the recording."""
    if any(term.is_instrument for term in causes):
        return "The recording differs from the nominal model"
    return "The nominal model is wrong"


def describe_probabilities(probabilities: Probabilities) -> str:
    """Return the probabilities in one sentence, those of sets of causes above `MIN_SHOWN`."""
    parts = [
        f"{' with '.join(keys)} {format_probability(probability)}"
        for keys, probability in probabilities.ranked
        if probability >= MIN_SHOWN
    ]
    parts += [
        f"none of these causes {format_probability(probabilities.none_of_these)}",
        f"no effect, or none that this recording could show, {format_probability(probabilities.no_effect)}",
    ]
    return f"Probabilities: {', '.join(parts)}."


def describe_disturbance(item: InstrumentDisturbance) -> str:
    """Return a disturbance of an instrument as a clause."""
    name, unit = item.signal.rsplit("_", 1)
    size = format_quantity(item.size, unit)
    if item.form == "line":
        return f"{name} carries a line of {item.frequency_hz:.4g} Hz with an amplitude of {size}"
    if item.form == "hops":
        return f"the zero of {name} hops by {size}, seen in {item.runs} run{'s' if item.runs > 1 else ''}"
    return f"the zero of {name} drifts by {size} over the recording"


def describe_gain(gain: HeldOutGain | None, verdict: str, runs: int) -> list[str]:
    """Return the gain on this number of held-out runs, which an extension may also lose."""
    if gain is None:
        if verdict in NOTHING_FOUND or verdict == "unexplained":
            return []
        return ["The gain cannot be measured: no held-out run shows the effect."]
    if gain.interval is None:
        interval = "one experiment was held out, so there is no interval"
    else:
        interval = f"95 %: {_format_share(gain.interval[0])} to {_format_share(gain.interval[1])}"
    change = "removes" if gain.reduction >= 0.0 else "adds"
    lines = [
        f"On {runs} runs held out of the selection, the extended model {change} "
        f"{_format_share(abs(gain.reduction))} of the avoidable error ({interval})."
    ]
    for name, nominal in gain.nominal.items():
        unit = name.rsplit("_", 1)[1]
        extended, floor = gain.extended[name], gain.noise_floor[name]
        lines.append(
            f"  {name}: RMSE {format_quantity(nominal, unit)} nominal, {format_quantity(extended, unit)} extended, "
            f"noise {format_quantity(floor, unit)}"
        )
    return lines


def describe_term(term: TermClaim) -> list[str]:
    """Return the lines on a missing term: its form, three probabilities, gains, rivals and doubts."""
    form = term.chosen
    kind = form.kind if form.place == form.where else f"{form.kind} in {' times '.join(form.depends_on)}"
    if term.is_sure:
        head = f"{form.where} lacks {form.formula}: {kind}"
    elif term.claim.verdict == "ambiguous":
        head = f"{form.where} lacks a term, perhaps {form.formula}: {kind}"
    else:
        head = f"{form.where} lacks a function of {' times '.join(form.depends_on)}: {form.formula}"
    lines = [
        head,
        f"  something is missing: {format_probability(term.missing)}; of what was tried, in {form.place}: "
        f"{format_probability(term.place_probability)}; as {form.kind} there: {format_probability(form.probability)}",
    ]
    if term.gains:
        shares = ", ".join(
            f"{_format_share(each.held_out)} in {each.split} ({_format_share(each.trained)} where fitted)"
            for each in term.gains
        )
        lines.append(f"  removes of the avoidable error, where it was held out: {shares}")
    lines += [
        f"  or {rival.name}, {rival.formula}: {format_probability(rival.probability)}, "
        f"removes {_format_share(rival.gain)} or more"
        for rival in term.rivals
    ]
    lines += [f"  {reason}" for reason in term.claim.reasons]
    return [*lines, *([f"  next record: {term.next_record}"] if term.next_record else [])]


def describe_no_term(found: Claim, error: float, noise: float, judged_by: str) -> list[str]:
    """Return the lines where no term is added. error: of free runs of held-out data."""
    size = f"held-out error of the fitted simulation {error:.4g} in {judged_by}, noise at least {noise:.2g}"
    openings = {
        "none": "no missing term found",
        "undecided": "undecided: these records show neither a missing term nor that there is none",
    }
    head = openings.get(
        found.verdict, "something is missing, and no term that was tried predicts all that was held out"
    )
    return [f"{head}; {size}", *(f"  {reason}" for reason in found.reasons)]


def build_term_document(term: TermClaim) -> dict[str, Any]:
    """Return the claim on a missing term as JSON values."""
    return {
        "verdict": term.claim.verdict,
        "reasons": list(term.claim.reasons),
        "probability_missing": term.missing,
        "probability_place": term.place_probability,
        "probability_form": term.chosen.probability,
        "gain": term.chosen.gain,
        "gains": [asdict(each) for each in term.gains],
        "rivals": [asdict(each) for each in term.rivals],
        "next_record": term.next_record,
    }


def _format_share(share: float) -> str:
    return f"{share:.0%}".replace("-", "−")
