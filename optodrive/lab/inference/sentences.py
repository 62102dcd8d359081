"""Sentences that state a claim and its numbers."""

from collections.abc import Iterable, Mapping, Sequence

from optodrive.core.quantity import format_quantity
from optodrive.core.types.discrepancy import Discrepancy, HeldOutGain, InstrumentDisturbance, Probabilities
from optodrive.lab.inference.claim import NOTHING_FOUND, format_probability
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


def _format_share(share: float) -> str:
    return f"{share:.0%}".replace("-", "−")
