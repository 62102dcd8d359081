"""Judge of the claims about a recording.

Theory of operation

Problem. A probability is relative to the explanations that were compared. Where the right one is not among them, as
where an instrument did what no hypothesis describes, the least bad of the others takes it all, though it explains
little or makes worse what the fit never saw. So a probability alone must not name a cause.

Conditions. A cause is named only if it is probable, and explains half of the excess alone and nine tenths with other
forms of its own effect, and makes no signal of a held-out group worse beyond noise, and all of them together better,
and if the interval of its effect does not contain zero. Each condition is a number from data that the fit did not see,
or did not shape. What fails is `ambiguous` where the name is still likely, else `unexplained`, and the reason is part
of the claim. Without repeats the noise is a guess, and nothing is certain.

Nothing found. `none` needs a large probability of no effect. Between that and an effect that is certain, the recording
cannot tell, and the claim says so: `undecided`.

Missing terms. A discovery compares forms of a term where a diagnosis compares causes, by the same conditions and one
more: a name must gain where the fit does not interpolate, in every split at least half of what it gains in training.
What has no formula of physics, a curve or a change with time, is no name. Three probabilities stay apart: that
something is missing, where, and in which form, the latter two among what was tried.

Everything here is a function of `Evidence`. No caller makes a verdict of its own.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import exp, log, log1p

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.discrepancy import Probabilities

Causes = tuple[str, ...]
"""Keys of causes that act together."""

MIN_NO_EFFECT = 0.9
"""Smallest probability of no effect with which nothing counts as found."""
MAX_NO_EFFECT = 0.05
"""Largest probability of no effect with which an effect counts as detected."""
MIN_NAMED = 0.97
"""Smallest probability of what is named: of one set of causes, or of all sets of an ambiguity."""
MIN_ALONE = 0.2
"""Smallest probability of the named causes without another one, which would else be missing in the answer."""
MIN_LISTED = 0.01
"""Smallest probability of a further set of causes in an ambiguity."""
MAX_AMBIGUOUS = 4
"""Largest number of sets of causes in an ambiguity; a longer list is no answer."""
MIN_EXPLAINED, MIN_EXPLAINED_WITH_FORMS = 0.5, 0.9
"""Smallest share of the excess that a cause explains alone, and with other forms of its effect."""
MAX_WORSE_SIGMA = 3.0
"""Largest increase of a held-out signal's error, in σ, that counts as noise."""
MAX_GROWTH = 1.0
"""Largest increase of a held-out signal's mean square error, relative to that by noise, that counts as noise."""
MAX_RATIO = 2.0
"""Ratio of a held-out signal's rms errors with and without an extension, above which it is no explanation at all."""
MIN_TRAINED = 0.02
"""Share of the avoidable error that a term removes in training, below which a split cannot test it."""
MIN_KEPT = 0.5
"""Smallest gain in held-out data, relative to that in training, with which a term extrapolates."""
MAX_LAG = 16
"""Parts over which products of errors may be correlated."""
WORST_FIRST = ("unexplained", "ambiguous", "cause", "incomplete", "undecided", "instrument", "none")
"""Verdicts, in the order in which that of one part of a recording decides that of the whole."""
NOTHING_FOUND = ("none", "instrument", "incomplete", "undecided")
"""Verdicts that name no error."""


@dataclass(frozen=True)
class HeldOutChange:
    """Change of χ² of one signal of a held-out group by an extension, and the standard deviation of it by noise.

    rms: errors without and with the extension, and by noise and jitter alone, in runs of this number. χ² counts what
    differs from run to run little, so an extension that predicts the shape of a response, and its height wrongly,
    lowers it.
    """

    group: str
    signal: str
    chi2: float
    noise: float
    rms: tuple[float, float, float] = (0.0, 0.0, 1.0)
    runs: int = 1

    @property
    def sigma(self) -> float:
        """Increase in σ, negative where the extension is better."""
        return self.chi2 / max(self.noise, 1e-12)

    @property
    def growth(self) -> float:
        """Increase of the mean square error, relative to that by noise and jitter."""
        before, after, noise = self.rms
        return (after**2 - before**2) / max(noise, 1e-12) ** 2


@dataclass(frozen=True)
class SplitGain:
    """Shares of the avoidable error that a term removes in fitted and in held-out data.

    split: what was held out, in words
    """

    split: str
    trained: float
    held_out: float


@dataclass(frozen=True)
class Alternative:
    """A fitted set of causes, or a form of a missing term.

    explained: shares of the excess that it explains alone and with other forms of its effect, None if not known;
    held_out: its changes, empty if nothing was held out; doubts: clauses on sizes whose intervals
    contain no effect, by cause; gains: of a term; nameless: why it is no name, "" if it is one
    """

    causes: Causes
    explained: tuple[float, float] | None = None
    held_out: tuple[HeldOutChange, ...] = ()
    doubts: Mapping[str, str] = field(default_factory=dict)
    gains: tuple[SplitGain, ...] = ()
    nameless: str = ""

    @property
    def name(self) -> str:
        """The causes in words."""
        return " and ".join(self.causes)


@dataclass(frozen=True)
class Evidence:
    """Evidence from a recording or a part of it.

    alternatives: the fitted sets of causes, most probable first; twins: causes by those that nothing in this recording
    tells from them, both ways; has_repeats: whether the noise is known; repeats_differ: by more than noise
    """

    probabilities: Probabilities
    alternatives: tuple[Alternative, ...]
    twins: Mapping[str, str] = field(default_factory=dict)
    has_repeats: bool = True
    repeats_differ: bool = False


@dataclass(frozen=True)
class Claim:
    """A verdict, the sets of causes that it names, and why it is not more definite, in sentences."""

    verdict: str
    sets: tuple[Causes, ...] = ()
    reasons: tuple[str, ...] = ()

    @property
    def causes(self) -> Causes:
        """All causes named, each once."""
        return tuple(dict.fromkeys(key for keys in self.sets for key in keys))


NOTHING_SHOWN, NOTHING_SOUGHT = Claim("none"), Claim("incomplete")
"""Claims of a discovery in which no candidate improves anything, and of one with too little data to begin with."""

NEAR_NOISE, FAR_FROM_NOISE = 1.1, 3.0
"""Errors in units of noise up to which nothing is missing, and above which something is for noise of any form."""


@dataclass(frozen=True)
class TermForm:
    """Form of a term that a simulation may lack.

    where: equation or output that it is added to; depends_on: its variable, and what multiplies it, if anything;
    probability: among the forms tried, given that something is missing; gain: the smallest in held-out data
    """

    where: str
    depends_on: tuple[str, ...]
    kind: str
    formula: str
    probability: float
    gain: float

    @property
    def place(self) -> str:
        """Place and variables in words. A constant depends on nothing."""
        if self.kind == "constant" and len(self.depends_on) == 1:
            return self.where
        return f"{self.where} on {' times '.join(self.depends_on)}"

    @property
    def name(self) -> str:
        """Form and place in words."""
        return f"{self.kind} in {self.place}"


@dataclass(frozen=True)
class TermClaim:
    """Verdict on one missing term.

    missing: probability that something is missing; forms: most probable first; chosen: that by which the simulation
    is extended; gains: its own; next_record: which record would decide, "" if nothing is open
    """

    claim: Claim
    missing: float
    forms: tuple[TermForm, ...]
    chosen: TermForm
    gains: tuple[SplitGain, ...]
    next_record: str = ""

    @property
    def is_sure(self) -> bool:
        """Whether the form is a name, and no other one is left."""
        return self.claim.verdict == "cause"

    @property
    def place_probability(self) -> float:
        """Probability of the chosen place and variables among those tried."""
        return min(1.0, sum(form.probability for form in self.forms if form.place == self.chosen.place))

    @property
    def rivals(self) -> tuple[TermForm, ...]:
        """Further forms that the data leaves."""
        return tuple(each for each in self.forms if each is not self.chosen and each.probability >= MIN_LISTED)


def sum_in_sigma(values: FloatArray, noise: FloatArray) -> tuple[float, float]:
    """Return the sum of values [parts] in its standard deviations, and to how many independent parts these amount.

    noise: [parts] values without the effect; neighbouring ones may be correlated (Newey & West 1987)
    """
    squares = float(noise @ noise)
    lags = range(1, min(MAX_LAG, len(noise) - 1) + 1)
    correlated = sum(2.0 * (1.0 - lag / (MAX_LAG + 1.0)) * float(noise[lag:] @ noise[:-lag]) for lag in lags)
    variance = max(squares + correlated, 0.1 * squares, 1e-300)
    return float(np.sum(values)) / variance**0.5, max(1.0, len(noise) * min(1.0, squares / variance))


def compute_no_effect(sigma: float, parts: float, tries: int = 1) -> float:
    """Return the probability of no effect.

    sigma: by how many σ the best of some tries is better; parts: independent ones that it was summed over

    The Bayes factor is that of a unit-information prior (Kass & Wasserman 1995), at even odds of any effect.
    """
    evidence = 0.5 * max(sigma, 0.0) ** 2 * parts / (1.0 + parts) - 0.5 * log1p(parts) - log(tries)
    return 1.0 / (1.0 + exp(min(evidence, 700.0)))


def weigh_forms(behind: Sequence[float], prior: Sequence[float]) -> list[float]:
    """Return the probabilities of forms among each other.

    behind: by how many σ each predicts held-out data worse than the best one; prior: relative weights
    """
    weights = [p * exp(-0.5 * max(sigma, 0.0) ** 2) for sigma, p in zip(behind, prior, strict=True)]
    return [weight / sum(weights) for weight in weights]


UNJUDGED = Claim("unexplained")
"""Claim of what nobody has judged yet."""


def claim(evidence: Evidence) -> Claim:
    """Return the strongest claim that the evidence permits."""
    probabilities = evidence.probabilities
    # First: the probabilities then are of nothing.
    if evidence.repeats_differ:
        return Claim("unexplained", reasons=("Repeats differ by more than noise, so nothing was compared.",))
    # Above 5 % nothing is named, however probable one cause is among the rest: between 5 and 90 % the answer is
    # "undecided".
    if probabilities.no_effect > MAX_NO_EFFECT:
        return _claim_nothing(probabilities)
    ranked = evidence.alternatives
    # No cause is named that is less probable than something unknown.
    if not ranked or probabilities.none_of_these > max(probabilities.causes[_sort(item.causes)] for item in ranked):
        return Claim("unexplained")
    # Probable is not enough: a cause that fails a condition is refused here, and its reason is part of the answer.
    certain = _find_certain(evidence)
    listed = _list_ambiguous(evidence) if certain is None else [certain]
    refusals = {item.causes: _list_refusals(item) for item in listed}
    sets = tuple(causes for causes, reasons in refusals.items() if not reasons)
    reasons = tuple(reason for each in refusals.values() for reason in each)
    if not sets:
        return Claim("unexplained", reasons=reasons)
    if certain is None:
        return Claim("ambiguous", sets, reasons)
    doubts = _list_doubts(certain)
    twins = _list_twins(certain.causes, evidence)
    reasons = (*doubts, *(f"No recording of this kind tells {key} from {twin}." for key, twin in twins.items()))
    sets = (certain.causes, *(tuple(twins.get(key, key) for key in certain.causes) for _ in twins))
    return Claim("ambiguous" if reasons else "cause", sets, reasons)


def _list_twins(causes: Causes, evidence: Evidence) -> dict[str, str]:
    """Return the twins of these causes, but for those that are among them or that are refused in their place."""
    fitted = {_sort(item.causes): item for item in evidence.alternatives}
    found = {}
    for key in causes:
        twin = evidence.twins.get(key, key)
        other = fitted.get(_sort(tuple(twin if each == key else each for each in causes)))
        if twin not in causes and (other is None or not _list_refusals(other)):
            found[key] = twin
    return found


def claim_nothing(error: float) -> Claim:
    """Return the claim where no candidate improves a simulation.

    error: of free runs of held-out data, in units of the noise, which may be larger than its estimate
    """
    if error <= NEAR_NOISE:
        return NOTHING_SHOWN
    reason = f"What was held out is predicted with {error:.2g} times the noise, and no term that was tried helps."
    return Claim("undecided" if error <= FAR_FROM_NOISE else "unexplained", reasons=(reason,))


def combine_claims(claims: Sequence[Claim], failures: Mapping[str, str], has_disturbances: bool) -> Claim:
    """Return the claim of a whole recording from those of its parts.

    failures: hypotheses that could not be computed; has_disturbances: of instruments, which were subtracted
    """
    verdicts = {item.verdict for item in claims}
    verdicts |= ({"incomplete"} if failures else set()) | ({"instrument"} if has_disturbances else set())
    # A failed hypothesis turns "none" into "incomplete", and leaves a named cause: what was not computed can only add
    # doubt.
    verdict = next(each for each in WORST_FIRST if each in verdicts)
    names = verdict in ("ambiguous", "cause")
    sets = tuple(keys for item in claims for keys in item.sets) if names else ()
    return Claim(verdict, sets, tuple(dict.fromkeys(reason for item in claims for reason in item.reasons)))


def _claim_nothing(probabilities: Probabilities) -> Claim:
    # "None" is a claim, too, and needs its own evidence: a recording with much noise shows nothing at all.
    if probabilities.no_effect >= MIN_NO_EFFECT:
        return Claim("none")
    reason = (
        f"No effect has a probability of {format_probability(probabilities.no_effect)}, where "
        f"{format_probability(MIN_NO_EFFECT)} would show that there is none and {format_probability(MAX_NO_EFFECT)} "
        "that there is one."
    )
    return Claim("undecided", reasons=(reason,))


def _find_certain(evidence: Evidence) -> Alternative | None:
    """Return the set of all causes that each act with `MIN_NAMED`, if it was fitted and noise is known."""
    probabilities = evidence.probabilities
    keys = {key for item in evidence.alternatives for key in item.causes}
    named = tuple(sorted(key for key in keys if probabilities.sum_of(key) >= MIN_NAMED))
    # Each key may be certain while the set is not: another cause, in most of the probability, is missing from it.
    if not evidence.has_repeats or probabilities.causes.get(named, 0.0) < MIN_ALONE:
        return None
    return next((item for item in evidence.alternatives if _sort(item.causes) == named), None)


def _list_ambiguous(evidence: Evidence) -> list[Alternative]:
    """Return the fewest sets that have `MIN_NAMED` together."""
    listed: list[Alternative] = []
    total = 0.0
    for item in evidence.alternatives[:MAX_AMBIGUOUS]:
        probability = evidence.probabilities.causes[_sort(item.causes)]
        # The first is listed always, so that an ambiguity names something.
        if total >= MIN_NAMED or (listed and probability < MIN_LISTED):
            break
        total += probability
        listed.append(item)
    return listed


def _list_refusals(item: Alternative) -> tuple[str, ...]:
    """Return why a set of causes must not be named at all, not even as one of several."""
    out = []
    if item.explained is not None and item.explained[0] < MIN_EXPLAINED:
        out.append(f"{item.name} explains {_format_share(item.explained[0])} of the excess, less than half.")
    total = _sum_changes(item.held_out)
    if total.sigma > MAX_WORSE_SIGMA:
        out.append(f"With {item.name}, the held-out runs are predicted worse, by {total.sigma:.1f} σ.")
    if any(each.growth > MAX_GROWTH and each.rms[1] > MAX_RATIO * each.rms[0] for each in item.held_out):
        out += _list_growths(item)
    if item.nameless:
        out.append(f"{item.name} is no name: {item.nameless}.")
    out += [
        f"With {item.name}, {each.split} is predicted worse, by {_format_share(-each.held_out)} of the avoidable error."
        for each in item.gains
        if each.held_out < 0.0
    ]
    return tuple(out)


def _sum_changes(changes: Sequence[HeldOutChange]) -> HeldOutChange:
    """Return the change of all held-out data together."""
    return HeldOutChange("", "", sum(each.chi2 for each in changes), sum(each.noise**2 for each in changes) ** 0.5)


def _list_growths(item: Alternative) -> list[str]:
    """Return the held-out signals of which an extension makes the rms error larger than noise and jitter explain."""
    return [
        f"With {item.name}, the rms error of {each.signal} of the held-out group {each.group} is "
        f"{each.rms[1] / max(each.rms[0], 1e-12):.1f} times that of the nominal model."
        for each in item.held_out
        if each.growth > MAX_GROWTH
    ]


def _list_doubts(item: Alternative) -> tuple[str, ...]:
    """Return why a probable set of causes that is not refused is not certain."""
    out = []
    for each in item.gains:
        if each.trained < MIN_TRAINED:
            out.append(f"Without {each.split}, no data shows {item.name}.")
        elif each.held_out < MIN_KEPT * each.trained:
            trained, held_out = _format_share(each.trained), _format_share(each.held_out)
            out.append(
                f"{item.name} removes {trained} of the avoidable error where it was fitted, {held_out} in {each.split}."
            )
    if item.explained is not None and item.explained[1] < MIN_EXPLAINED_WITH_FORMS:
        share = _format_share(item.explained[1])
        out.append(f"{item.name} explains {share} of the excess in all its forms, less than nine tenths.")
    out += [
        f"With {item.name}, {each.signal} of the held-out group {each.group} is predicted worse, by {each.sigma:.1f} σ."
        for each in item.held_out
        if each.sigma > MAX_WORSE_SIGMA
    ]
    out += _list_growths(item)
    if item.held_out and _sum_changes(item.held_out).chi2 >= 0.0:
        out.append(f"With {item.name}, the held-out runs together are predicted no better.")
    out += [f"{key} is not certain: {clause}." for key, clause in item.doubts.items()]
    return tuple(out)


def _sort(causes: Causes) -> Causes:
    return tuple(sorted(causes))


def _format_share(share: float) -> str:
    return f"{100.0 * share:.1f} %".replace("-", "−")


def format_probability(probability: float) -> str:
    """Return a probability in percent, never as certainty."""
    if probability < 1e-3:
        return "< 0.1 %"
    return "> 99.9 %" if probability > 1.0 - 1e-3 else f"{100.0 * probability:.1f} %"
