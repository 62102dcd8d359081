"""Comparison of Text S1 with the paper's facts as text and as JSON."""

from collections.abc import Sequence
from typing import Any

from optodrive.core.document import to_json
from optodrive.core.quantity import format_quantity
from optodrive.lab.inference.claim import format_probability
from optodrive.lab.inference.sentences import MIN_SHOWN, describe_probabilities, describe_sufficiency
from optodrive.lab.validation.causes import AICC_INDISTINGUISHABLE, CAUSE_COST, CAUSES_BY_KEY
from optodrive.lab.validation.facts import EXCLUDED, READING_ERROR
from optodrive.lab.validation.study import (
    UNEXPLAINED_SIGMA,
    HeldOutPrediction,
    NamedCause,
    StudyResult,
    UnchosenCause,
    compute_error_factor,
)

SCALED_UNITS = {"m^3/Pa": (1e12, "µL/kPa"), "m^2": (1e6, "mm²")}
"""Units whose prefixes are raised to powers."""
SIDES = ("nominal", "extended")
HEADINGS = ("held out", "causes chosen without", "nominal", "extended", "error factor")


def format_value(key: str, value: float) -> str:
    """Return the parameter of a cause in readable units."""
    unit = CAUSES_BY_KEY[key].parameter.unit
    scale, name = SCALED_UNITS.get(unit, (1.0, ""))
    return f"{value * scale:.3g} {name}" if name else format_quantity(value, unit)


def describe_findings(result: StudyResult) -> list[str]:
    """Return the lines on the claim, the chosen causes, contradictions among the facts and the other causes."""
    facts, labels = len(result.data), {key: key for key in CAUSES_BY_KEY}
    lines = [
        *describe_sufficiency(result.claim, result.probabilities, f"Text S1 as it stands ({result.base})", labels),
        describe_probabilities(result.probabilities),
        f"It misses {facts} measured facts by a factor of {compute_error_factor(result.nominal_ratios):.2f}, "
        f"χ² {result.nominal_fit.chi2:.0f}.",
    ]
    if result.named:
        lines += ["", "Causes of the best set:"]
        lines += [line for item in result.named for line in _describe_named_cause(item)]
        lines += [
            "",
            f"With {'it' if len(result.named) == 1 else 'these'} the factor is "
            f"{compute_error_factor(result.extended_ratios):.3g}, "
            f"χ² {result.fit.chi2:.1f} with {facts - len(result.named)} degrees of freedom.",
        ]
    if result.unexplained:
        facts_shown = ", ".join(result.unexplained)
        lines.append(f"Unexplained, by more than {UNEXPLAINED_SIGMA:g} standard errors: {facts_shown}.")
    return [*lines, *_describe_contradictions(result), *_describe_others(result.unchosen)]


def _describe_named_cause(item: NamedCause) -> list[str]:
    cause = CAUSES_BY_KEY[item.key]
    value, low, high = (format_value(item.key, number) for number in (item.value, item.low, item.high))
    lines = [
        f"- {cause.description} ({item.key}).",
        f"  {cause.parameter.symbol} = {value} (95 %: {low} to {high}); "
        f"without it χ² grows by {item.chi2_reduction:.0f}.",
    ]
    lines += [
        f"  Or: {CAUSES_BY_KEY[other].description} ({other}); the facts cannot decide." for other in item.alternatives
    ]
    if len(item.evidence) == 1:
        lines.append(f"  Evidence: {item.evidence[0]} alone; another explanation of that value would suffice.")
    else:
        lines.append(f"  Evidence: {', '.join(item.evidence)}.")
    return lines


def _describe_contradictions(result: StudyResult) -> list[str]:
    lines = [f"- {item.description}." for item in result.contradictions]
    if lines:
        lines = ["", "Assumptions contradicted by the facts alone, independent of any fit:", *lines]
    unchosen = {item.key: item for item in result.unchosen}
    membrane, plate = unchosen.get("gas_membrane"), unchosen.get("membrane_plate")
    law = CAUSES_BY_KEY["gas_membrane"].description
    if result.contradictions and membrane and membrane.is_alternative_law and membrane.value is not None:
        best_factor = "" if plate is None or plate.value is None else f", {plate.value:.2f} times it fits best"
        lines.append(
            "  The heights do not show it, because the displacement per kelvin of Text S1 is right by "
            f"chance{best_factor}. The alternative law, {law}, with a gas at {membrane.value:.2f} of the absorber's "
            f"rise, fits as well (gas_membrane, χ² {-membrane.chi2_reduction_added:+.1f})."
        )
    return lines


def _describe_others(candidates: Sequence[UnchosenCause]) -> list[str]:
    """Return lines on the other causes, each with its reductions of χ²."""
    lines = ["", "Other causes, with the reduction of χ² alone, in place of a cause above, and in addition:"]
    for item in (item for item in candidates if item.is_observable):
        place = f"{item.replaced_fraction:.0%} of that by {item.replaces}" if item.replaces else "none"
        lines.append(
            f"- {CAUSES_BY_KEY[item.key].description} ({item.key}, {format_probability(item.probability)}): "
            f"{max(0.0, item.chi2_reduction_alone):.0f}, {place}, {abs(item.chi2_reduction_added):.1f}"
        )
    hidden = [item.key for item in candidates if not item.is_observable]
    return [*lines, *([f"Not observable in these facts: {', '.join(hidden)}."] if hidden else [])]


def build_rows(result: StudyResult) -> list[tuple[str, ...]]:
    """Return the held-out predictions as text under HEADINGS."""
    return [_build_row(item) for item in (*result.group_predictions, *result.fact_predictions)]


def _build_row(item: HeldOutPrediction) -> tuple[str, ...]:
    causes = ", ".join(item.causes) or "none"
    ratios = (" ".join(f"{ratio:.2f}" for ratio in values) for values in (item.nominal, item.extended))
    factors = f"{compute_error_factor(item.nominal):.2f} → {compute_error_factor(item.extended):.2f}"
    return item.label, causes, *ratios, factors


def describe_predictions(result: StudyResult) -> list[str]:
    """Return the lines on the gain, on unpredictable facts and on measurements to make."""
    groups, each = compute_overall_factors(result.group_predictions), compute_overall_factors(result.predictions)
    lines = [f"Held-out predictions, all groups: error factor {groups[0]:.2f} nominal, {groups[1]:.2f} extended."]
    for item in result.unpredictable:
        unobservable = ", ".join(item.unobservable)
        lines.append(f"Only {item.label} show {unobservable}: it cannot be predicted without them.")
    lines += [
        f"Of these, {item.label} alone shows {', '.join(item.unobservable)}."
        for item in result.fact_predictions
        if item.unobservable
    ]
    if result.unpredictable:
        factor = f"error factor {each[0]:.2f} nominal, {each[1]:.2f} extended"
        lines.append(f"These fact by fact, the others by groups: {factor}.")
    measurements: dict[str, None] = {}
    for cause in result.named:
        if cause.alternatives or len(cause.evidence) == 1:
            measurements[CAUSES_BY_KEY[cause.key].deciding_measurement] = None
    for candidate in result.unchosen:
        if candidate.is_alternative_law:
            measurements[CAUSES_BY_KEY[candidate.key].deciding_measurement] = None
    if measurements:
        lines += ["", "Measure next:", *(f"- {measurement}." for measurement in measurements)]
    return lines


def compute_overall_factors(predictions: Sequence[HeldOutPrediction]) -> tuple[float, float]:
    """Return the error factors over all facts, nominal and extended."""
    nominal, extended = ([ratio for item in predictions for ratio in getattr(item, side)] for side in SIDES)
    return compute_error_factor(nominal), compute_error_factor(extended)


def describe_assumptions(result: StudyResult) -> list[str]:
    """Return the lines on the errors assumed for the facts."""
    scatter = result.data[0].scatter
    return [
        f"Errors: {100 * scatter:.0f} % between samples (the scatter of R and C in Table S3), and of reading as stated "
        f"in the paper, else {100 * READING_ERROR:.0f} %; the two laws of Fig. 3D by their r².",
        f"A cause costs {CAUSE_COST:.1f} of AICc, its prior odds; explanations within {AICC_INDISTINGUISHABLE:.1f} are "
        "indistinguishable.",
    ]


def build_study_answer(result: StudyResult) -> dict[str, Any]:
    """Return the result as JSON values, SI units, temperatures as rises, K."""
    groups, each = compute_overall_factors(result.group_predictions), compute_overall_factors(result.predictions)
    factors = compute_error_factor(result.nominal_ratios), compute_error_factor(result.extended_ratios)
    sides = zip(result.data, result.nominal_ratios, result.extended_ratios, result.errors_sigma, strict=True)
    probable = [keys for keys, probability in result.probabilities.ranked if probability >= MIN_SHOWN]
    return {
        "parameter_set": result.base,
        **to_json(result.claim),
        "probabilities": {
            "no_effect": result.probabilities.no_effect,
            "none_of_these": result.probabilities.none_of_these,
            "causes": [{"causes": list(keys), "probability": result.probabilities.causes[keys]} for keys in probable],
        },
        "facts": [
            {**to_json(datum), "relative_error": datum.sigma}
            | {"nominal_ratio": nominal, "extended_ratio": extended, "error_sigma": error}
            for datum, nominal, extended, error in sides
        ],
        "excluded": EXCLUDED,
        "chi2": _state_factors((result.nominal_fit.chi2, result.fit.chi2))
        | {"degrees_of_freedom": len(result.data) - len(result.named)},
        "factor": _state_factors(factors),
        "aicc_per_cause": CAUSE_COST,
        "aicc_indistinguishable": AICC_INDISTINGUISHABLE,
        "causes": [_state_cause(item) for item in result.named],
        "candidates": [_state_cause(item) for item in result.unchosen],
        "contradictions": to_json(result.contradictions, key="assumption"),
        "unexplained": list(result.unexplained),
        "gain": {
            "groups": to_json(result.group_predictions, label="held_out"),
            "facts": to_json(result.fact_predictions, label="held_out"),
            "factor_groups": _state_factors(groups),
            "factor_each": _state_factors(each),
        },
    }


def _state_factors(factors: tuple[float, float]) -> dict[str, float]:
    return dict(zip(SIDES, factors, strict=True))


def _state_cause(item: NamedCause | UnchosenCause) -> dict[str, Any]:
    cause, stated = CAUSES_BY_KEY[item.key], to_json(item, key="cause")
    about = {"parameter": cause.parameter.symbol, "unit": cause.parameter.unit}
    return {**stated, "description": cause.description, **about, "deciding_measurement": cause.deciding_measurement}
