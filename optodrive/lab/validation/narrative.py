"""What the paper's facts say of Text S1, in plain words and as JSON."""

from collections.abc import Sequence
from typing import Any

from optodrive.lab.diagnosis.narrative import format_quantity
from optodrive.lab.validation.candidate_causes import index_causes
from optodrive.lab.validation.cause_search import AICC_INDISTINGUISHABLE, CAUSE_COST
from optodrive.lab.validation.measured_facts import EXCLUDED, READING_ERROR
from optodrive.lab.validation.study import (
    UNEXPLAINED_SIGMA,
    LeaveOutPrediction,
    NamedCause,
    StudyResult,
    UnchosenCause,
    compute_error_factor,
)

SCALED_UNITS = {"m^3/Pa": (1e12, "µL/kPa"), "m^2": (1e6, "mm²")}
"""Units whose prefixes are powers."""
HEADINGS = ("left out", "causes chosen without", "literal", "extended", "off by")


def format_value(key: str, value: float) -> str:
    """A cause's number in readable units."""
    unit = index_causes()[key].unit
    scale, name = SCALED_UNITS.get(unit, (1.0, ""))
    return f"{value * scale:.3g} {name}" if name else format_quantity(value, unit)


def describe_findings(result: StudyResult) -> list[str]:
    """What is wrong, what causes it, what the facts refuse by themselves, what is not it."""
    facts = len(result.data)
    lines = [
        f"Text S1 as it stands ({result.base}) misses {facts} measured facts by a factor of "
        f"{compute_error_factor(result.nominal_ratios):.2f}, χ² {result.nominal_fit.chi2:.0f}."
    ]
    if not result.named:
        lines.append("No cause earns its place: within the facts' errors nothing is wrong with it.")
    else:
        lines += ["", "What it gets wrong:"]
        lines += [line for item in result.named for line in _describe_named(item)]
        lines += [
            "",
            f"With {'it' if len(result.named) == 1 else 'these'} the factor is {compute_error_factor(result.extended_ratios):.3g}, "
            f"χ² {result.fit.chi2:.1f} with {facts - len(result.named)} degrees of freedom.",
        ]
    if result.unexplained:
        lines.append(
            f"Unexplained, by more than {UNEXPLAINED_SIGMA:g} standard errors: {', '.join(result.unexplained)}."
        )
    lines += _describe_contradictions(result)
    lines += _describe_ruled_out(result.unchosen)
    return lines


def _describe_named(item: NamedCause) -> list[str]:
    cause = index_causes()[item.key]
    numbers = f"{format_value(item.key, item.value)} (95 %: {format_value(item.key, item.low)} to {format_value(item.key, item.high)})"
    lines = [
        f"- {cause.description} ({item.key}).",
        f"  {cause.symbol} = {numbers}; without it χ² grows by {item.chi2_reduction:.0f}.",
    ]
    lines += [
        f"  Or: {index_causes()[other].description} ({other}). The facts cannot tell." for other in item.alternatives
    ]
    if len(item.evidence) == 1:
        lines.append(f"  It rests on one number, {item.evidence[0]}: another explanation of that one would do.")
    else:
        lines.append(f"  It rests on {', '.join(item.evidence)}.")
    return lines


def _describe_contradictions(result: StudyResult) -> list[str]:
    lines = [f"- {item.description}." for item in result.contradictions]
    if lines:
        lines = ["", "What the facts refuse by themselves, whatever is fitted:", *lines]
    unchosen = {item.key: item for item in result.unchosen}
    membrane, plate = unchosen.get("gas_membrane"), unchosen.get("membrane_plate")
    if result.contradictions and membrane and membrane.verdict == "as good" and membrane.value is not None:
        best_factor = "" if plate is None or plate.value is None else f", {plate.value:.2f} times it would be best"
        lines.append(
            f"  No height shows it, for Text S1's displacement per kelvin is right by chance{best_factor}. The other way, "
            f"{index_causes()['gas_membrane'].description}, with a gas at {membrane.value:.2f} of the absorber's rise, does as "
            f"well (gas_membrane, χ² {-membrane.chi2_reduction_added:+.1f})."
        )
    return lines


def _describe_ruled_out(candidates: Sequence[UnchosenCause]) -> list[str]:
    ruled_out = [item for item in candidates if item.verdict == "ruled out"]
    lines = []
    if ruled_out:
        lines += [
            "",
            "Ruled out: each takes much of χ² alone or in a named cause's place, but leaves much and adds nothing:",
        ]
        lines += [
            f"- {index_causes()[item.key].description} ({item.key}): {max(0.0, item.chi2_reduction_alone):.0f} alone"
            + (
                f", {100 * item.replaced_fraction:.0f} % of what {item.replaces} takes in its place"
                if item.replaces
                else ""
            )
            + f", {abs(item.chi2_reduction_added):.1f} beside them"
            for item in ruled_out
        ]
    for verdict, words in (("not needed", "Not needed"), ("not shown", "These facts cannot show")):
        keys = [item.key for item in candidates if item.verdict == verdict]
        if keys:
            lines.append(f"{words}: {', '.join(keys)}.")
    return lines


def build_rows(result: StudyResult) -> list[tuple[str, ...]]:
    """The predictions as text under HEADINGS."""
    return [_build_row(item) for item in (*result.group_predictions, *result.fact_predictions)]


def _build_row(item: LeaveOutPrediction) -> tuple[str, ...]:
    causes = ", ".join(item.causes) or "none"
    ratios = (" ".join(f"{ratio:.2f}" for ratio in side) for side in (item.nominal, item.extended))
    return (
        item.label,
        causes,
        *ratios,
        f"{compute_error_factor(item.nominal):.2f} → {compute_error_factor(item.extended):.2f}",
    )


def describe_predictions(result: StudyResult) -> list[str]:
    """The gain, where nothing can be predicted, and what would settle the rest."""
    groups, each = compute_overall_factors(result.group_predictions), compute_overall_factors(result.predictions)
    lines = [f"Predicted without having been seen, all groups: off by {groups[0]:.2f} before, {groups[1]:.2f} after."]
    for item in result.unpredictable:
        lost = ", ".join(item.unobservable)
        lines.append(f"Only {item.label} show {lost}: without them nothing mends it.")
    lines += [
        f"Of these, {item.label} alone shows {', '.join(item.unobservable)}."
        for item in result.fact_predictions
        if item.unobservable
    ]
    if result.unpredictable:
        lines.append(f"Those fact by fact, the others by groups: off by {each[0]:.2f} before, {each[1]:.2f} after.")
    measurements: dict[str, None] = {}
    for cause in result.named:
        if cause.alternatives or len(cause.evidence) == 1:
            measurements[index_causes()[cause.key].deciding_measurement] = None
    for candidate in result.unchosen:
        if candidate.verdict == "as good":
            measurements[index_causes()[candidate.key].deciding_measurement] = None
    if measurements:
        lines += ["", "Measure next:", *(f"- {words}." for words in measurements)]
    return lines


def compute_overall_factors(left_out: Sequence[LeaveOutPrediction]) -> tuple[float, float]:
    """The factor over all facts, before and after."""
    nominal = [ratio for item in left_out for ratio in item.nominal]
    return compute_error_factor(nominal), compute_error_factor([ratio for item in left_out for ratio in item.extended])


def describe_assumptions(result: StudyResult) -> list[str]:
    """How well the facts are taken to be known."""
    scatter = result.data[0].scatter
    return [
        f"Errors: {100 * scatter:.0f} % from sample to sample (the scatter of R and C in Table S3), and of reading "
        f"what the paper states, else {100 * READING_ERROR:.0f} %; the two laws of Fig. 3D by their r².",
        f"A cause is named if it lowers AICc by {CAUSE_COST:.1f}; explanations within {AICC_INDISTINGUISHABLE:.1f} cannot be told apart.",
    ]


def build_study_answer(result: StudyResult) -> dict[str, Any]:
    """The same as JSON, SI units; temperatures as rises, K."""
    groups, each = compute_overall_factors(result.group_predictions), compute_overall_factors(result.predictions)
    sides = zip(result.data, result.nominal_ratios, result.extended_ratios, result.errors_sigma, strict=True)
    return {
        "nominal": result.base,
        "facts": [
            {
                "id": datum.id,
                "group": datum.group,
                "value": datum.value,
                "relative_error": datum.sigma,
                "reading": {"relative_error": datum.reading_error, "source": datum.source},
                "literal_ratio": before,
                "extended_ratio": after,
                "misses_by_sigma": miss,
            }
            for datum, before, after, miss in sides
        ],
        "not_data": dict(EXCLUDED),
        "chi2": {
            "literal": result.nominal_fit.chi2,
            "extended": result.fit.chi2,
            "degrees_of_freedom": len(result.data) - len(result.named),
        },
        "factor": {
            "literal": compute_error_factor(result.nominal_ratios),
            "extended": compute_error_factor(result.extended_ratios),
        },
        "named_from_aicc": CAUSE_COST,
        "alike_within_aicc": AICC_INDISTINGUISHABLE,
        "causes": [
            {
                "cause": item.key,
                "words": index_causes()[item.key].description,
                "parameter": index_causes()[item.key].symbol,
                "value": item.value,
                "unit": index_causes()[item.key].unit,
                "ci95": [item.low, item.high],
                "chi2_taken": item.chi2_reduction,
                "rests_on": list(item.evidence),
                "alike": list(item.alternatives),
                "settled_by": index_causes()[item.key].deciding_measurement,
            }
            for item in result.named
        ],
        "candidates": [
            {
                "cause": item.key,
                "words": index_causes()[item.key].description,
                "verdict": item.verdict,
                "value": item.value,
                "unit": index_causes()[item.key].unit,
                "chi2_taken_alone": item.chi2_reduction_alone,
                "chi2_taken_beside": item.chi2_reduction_added,
                "best_in_place_of": item.replaces,
                "chi2_share_there": item.replaced_fraction,
            }
            for item in result.unchosen
        ],
        "contradictions": [
            {"assumption": item.key, "words": item.description, "ratio": item.ratio} for item in result.contradictions
        ],
        "unexplained": list(result.unexplained),
        "gain": {
            "groups": [_prediction_to_json(item) for item in result.group_predictions],
            "facts": [_prediction_to_json(item) for item in result.fact_predictions],
            "factor_groups": {"before": groups[0], "after": groups[1]},
            "factor_each": {"before": each[0], "after": each[1]},
        },
    }


def _prediction_to_json(item: LeaveOutPrediction) -> dict[str, Any]:
    return {
        "left_out": item.label,
        "facts": list(item.facts),
        "causes": list(item.causes),
        "lost": list(item.unobservable),
        "before_ratio": list(item.nominal),
        "after_ratio": list(item.extended),
        "before": compute_error_factor(item.nominal),
        "after": compute_error_factor(item.extended),
    }
