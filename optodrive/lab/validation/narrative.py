"""What the paper's facts say of Text S1, in plain words and as JSON."""

from collections.abc import Sequence
from typing import Any

from optodrive.lab.diagnosis.narrative import quantity
from optodrive.lab.validation.candidate_causes import catalogue
from optodrive.lab.validation.cause_search import APART, NAMED
from optodrive.lab.validation.measured_facts import LEFT_OUT, READING
from optodrive.lab.validation.study import MISSED, Answer, Candidate, LeftOut, Named, factor

UNITS = {"m^3/Pa": (1e12, "µL/kPa"), "m^2": (1e6, "mm²")}
"""Units whose prefixes are powers."""
HEADINGS = ("left out", "causes chosen without", "literal", "extended", "off by")


def shown(key: str, value: float) -> str:
    """A cause's number in readable units."""
    unit = catalogue()[key].unit
    scale, name = UNITS.get(unit, (1.0, ""))
    return f"{value * scale:.3g} {name}" if name else quantity(value, unit)


def before_table(found: Answer) -> list[str]:
    """What is wrong, what causes it, what the facts refuse by themselves, what is not it."""
    facts = len(found.data)
    lines = [
        f"Text S1 as it stands ({found.base}) misses {facts} measured facts by a factor of "
        f"{factor(found.nominal):.2f}, χ² {found.before.chi2:.0f}."
    ]
    if not found.named:
        lines.append("No cause earns its place: within the facts' errors nothing is wrong with it.")
    else:
        lines += ["", "What it gets wrong:"]
        lines += [line for item in found.named for line in _named(item)]
        lines += [
            "",
            f"With {'it' if len(found.named) == 1 else 'these'} the factor is {factor(found.extended):.3g}, "
            f"χ² {found.chosen.chi2:.1f} with {facts - len(found.named)} degrees of freedom.",
        ]
    if found.unexplained:
        lines.append(f"Unexplained, by more than {MISSED:g} standard errors: {', '.join(found.unexplained)}.")
    lines += _refused(found)
    lines += _not_it(found.candidates)
    return lines


def _named(item: Named) -> list[str]:
    cause = catalogue()[item.key]
    numbers = f"{shown(item.key, item.value)} (95 %: {shown(item.key, item.low)} to {shown(item.key, item.high)})"
    lines = [
        f"- {cause.words} ({item.key}).",
        f"  {cause.symbol} = {numbers}; without it χ² grows by {item.taken:.0f}.",
    ]
    lines += [f"  Or: {catalogue()[other].words} ({other}). The facts cannot tell." for other in item.alike]
    if len(item.rests_on) == 1:
        lines.append(f"  It rests on one number, {item.rests_on[0]}: another explanation of that one would do.")
    else:
        lines.append(f"  It rests on {', '.join(item.rests_on)}.")
    return lines


def _refused(found: Answer) -> list[str]:
    lines = [f"- {item.words}." for item in found.contradicted]
    if lines:
        lines = ["", "What the facts refuse by themselves, whatever is fitted:", *lines]
    beside = {item.key: item for item in found.candidates}
    membrane, plate = beside.get("gas_membrane"), beside.get("membrane_plate")
    if found.contradicted and membrane and membrane.verdict == "as good" and membrane.value is not None:
        best = "" if plate is None or plate.value is None else f", {plate.value:.2f} times it would be best"
        lines.append(
            f"  No height shows it, for Text S1's displacement per kelvin is right by chance{best}. The other way, "
            f"{catalogue()['gas_membrane'].words}, with a gas at {membrane.value:.2f} of the absorber's rise, does as "
            f"well (gas_membrane, χ² {-membrane.beside:+.1f})."
        )
    return lines


def _not_it(candidates: Sequence[Candidate]) -> list[str]:
    out = [item for item in candidates if item.verdict == "ruled out"]
    lines = []
    if out:
        lines += [
            "",
            "Ruled out: each takes much of χ² alone or in a named cause's place, but leaves much and adds nothing:",
        ]
        lines += [
            f"- {catalogue()[item.key].words} ({item.key}): {max(0.0, item.alone):.0f} alone"
            + (f", {100 * item.regained:.0f} % of what {item.place} takes in its place" if item.place else "")
            + f", {abs(item.beside):.1f} beside them"
            for item in out
        ]
    for verdict, words in (("not needed", "Not needed"), ("not shown", "These facts cannot show")):
        keys = [item.key for item in candidates if item.verdict == verdict]
        if keys:
            lines.append(f"{words}: {', '.join(keys)}.")
    return lines


def rows(found: Answer) -> list[tuple[str, ...]]:
    """The predictions as text under HEADINGS."""
    return [_row(item) for item in (*found.groups, *found.singles)]


def _row(item: LeftOut) -> tuple[str, ...]:
    causes = ", ".join(item.causes) or "none"
    ratios = (" ".join(f"{ratio:.2f}" for ratio in side) for side in (item.before, item.after))
    return (item.label, causes, *ratios, f"{factor(item.before):.2f} → {factor(item.after):.2f}")


def after_table(found: Answer) -> list[str]:
    """The gain, where nothing can be predicted, and what would settle the rest."""
    groups, each = overall(found.groups), overall(found.predictions)
    lines = [f"Predicted without having been seen, all groups: off by {groups[0]:.2f} before, {groups[1]:.2f} after."]
    for item in found.unpredicted:
        lost = ", ".join(item.lost)
        lines.append(f"Only {item.label} show {lost}: without them nothing mends it.")
    lines += [f"Of these, {item.label} alone shows {', '.join(item.lost)}." for item in found.singles if item.lost]
    if found.unpredicted:
        lines.append(f"Those fact by fact, the others by groups: off by {each[0]:.2f} before, {each[1]:.2f} after.")
    settle: dict[str, None] = {}
    for cause in found.named:
        if cause.alike or len(cause.rests_on) == 1:
            settle[catalogue()[cause.key].settle] = None
    for candidate in found.candidates:
        if candidate.verdict == "as good":
            settle[catalogue()[candidate.key].settle] = None
    if settle:
        lines += ["", "Measure next:", *(f"- {words}." for words in settle)]
    return lines


def overall(left_out: Sequence[LeftOut]) -> tuple[float, float]:
    """The factor over all facts, before and after."""
    before = [ratio for item in left_out for ratio in item.before]
    return factor(before), factor([ratio for item in left_out for ratio in item.after])


def assumptions(found: Answer) -> list[str]:
    """How well the facts are taken to be known."""
    scatter = found.data[0].scatter
    return [
        f"Errors: {100 * scatter:.0f} % from sample to sample (the scatter of R and C in Table S3), and of reading "
        f"what the paper states, else {100 * READING:.0f} %; the two laws of Fig. 3D by their r².",
        f"A cause is named if it lowers AICc by {NAMED:.1f}; explanations within {APART:.1f} cannot be told apart.",
    ]


def answer(found: Answer) -> dict[str, Any]:
    """The same as JSON, SI units; temperatures as rises, K."""
    groups, each = overall(found.groups), overall(found.predictions)
    sides = zip(found.data, found.nominal, found.extended, found.misses, strict=True)
    return {
        "nominal": found.base,
        "facts": [
            {
                "id": datum.id,
                "group": datum.group,
                "value": datum.value,
                "relative_error": datum.sigma,
                "reading": {"relative_error": datum.reading, "source": datum.source},
                "literal_ratio": before,
                "extended_ratio": after,
                "misses_by_sigma": miss,
            }
            for datum, before, after, miss in sides
        ],
        "not_data": dict(LEFT_OUT),
        "chi2": {
            "literal": found.before.chi2,
            "extended": found.chosen.chi2,
            "degrees_of_freedom": len(found.data) - len(found.named),
        },
        "factor": {"literal": factor(found.nominal), "extended": factor(found.extended)},
        "named_from_aicc": NAMED,
        "alike_within_aicc": APART,
        "causes": [
            {
                "cause": item.key,
                "words": catalogue()[item.key].words,
                "parameter": catalogue()[item.key].symbol,
                "value": item.value,
                "unit": catalogue()[item.key].unit,
                "ci95": [item.low, item.high],
                "chi2_taken": item.taken,
                "rests_on": list(item.rests_on),
                "alike": list(item.alike),
                "settled_by": catalogue()[item.key].settle,
            }
            for item in found.named
        ],
        "candidates": [
            {
                "cause": item.key,
                "words": catalogue()[item.key].words,
                "verdict": item.verdict,
                "value": item.value,
                "unit": catalogue()[item.key].unit,
                "chi2_taken_alone": item.alone,
                "chi2_taken_beside": item.beside,
                "best_in_place_of": item.place,
                "chi2_share_there": item.regained,
            }
            for item in found.candidates
        ],
        "contradictions": [
            {"assumption": item.key, "words": item.words, "ratio": item.ratio} for item in found.contradicted
        ],
        "unexplained": list(found.unexplained),
        "gain": {
            "groups": [_plain(item) for item in found.groups],
            "facts": [_plain(item) for item in found.singles],
            "factor_groups": {"before": groups[0], "after": groups[1]},
            "factor_each": {"before": each[0], "after": each[1]},
        },
    }


def _plain(item: LeftOut) -> dict[str, Any]:
    return {
        "left_out": item.label,
        "facts": list(item.facts),
        "causes": list(item.causes),
        "lost": list(item.lost),
        "before_ratio": list(item.before),
        "after_ratio": list(item.after),
        "before": factor(item.before),
        "after": factor(item.after),
    }
