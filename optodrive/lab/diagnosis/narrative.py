"""Diagnosis as narrative text, as JSON, and as a parameter file that planner and daemon load unchanged."""

from collections.abc import Mapping, Sequence
from typing import Any

from optodrive import __version__
from optodrive.core.document import to_json
from optodrive.core.quantity import format_quantity
from optodrive.core.types.discrepancy import Discrepancy, Estimate, HeightError, ResidualTrace
from optodrive.lab.inference.claim import NOTHING_FOUND, format_probability
from optodrive.lab.inference.sentences import (
    describe_claim,
    describe_disturbance,
    describe_gain,
    describe_probabilities,
)
from optodrive.lab.inspection.page import build_finding
from optodrive.physics.discovered_term import KEY, DiscoveredTerm
from optodrive.physics.term import TermValues
from optodrive.physics.terms import discover_terms

MAX_RULED_OUT = 6
MORE_REPEATS = (
    "Measure next: every experiment again, each twice as often. The noise is known by repeats alone, and with few of "
    "them no small effect can be told from it."
)


def _format_interval(item: Estimate) -> str:
    if item.at_limit:
        return f"no estimate: beyond its plausible range, which ends at {format_quantity(item.value, item.unit)}"
    value, low, high = (format_quantity(number, item.unit) for number in (item.value, item.low, item.high))
    return f"{value} (95 %: {low} to {high})"


def build_narrative(found: Discrepancy) -> list[str]:
    """Return the lines of the narrative: headline, causes, gain, rejected causes, next experiment and remarks."""
    terms = discover_terms()
    lines = [*describe_claim(found, terms), *_describe_omitted(found), ""]
    if found.causes:
        lines += [f"- {terms[key].label} ({key}); visible in {terms[key].signature}." for key in found.causes]
        lines += [f"  {name} = {_format_interval(item)}" for name, item in found.parameters.items() if "." in name]
        lines.append("")
    lines += [f"{describe_disturbance(item)}; it was subtracted." for item in found.disturbances]
    lines.append(describe_probabilities(found.probabilities))
    if found.verdict in ("cause", "ambiguous"):
        lines.append(f"This explains {found.explained_fraction:.1%} of the excess χ² of the nominal model.")
    lines.append(_describe_height_error(found))
    lines += _describe_locations(found)
    lines += describe_gain(found.gain, found.verdict, len(found.held_out_runs))
    lines += [f"To tell: {remedy}" for key in found.causes if (remedy := terms[key].remedy)]
    failures = [f"- {label}: {reason}" for label, reason in found.failures.items()]
    lines += _list_under("Could not be computed, and may explain what was measured:", failures)
    lines += [f"Left out, for it failed: {step} ({error})." for step, error in found.omissions.items()]
    lines += _describe_candidates(found)
    experiment = found.next_experiment
    if experiment is not None:
        lines += [
            "",
            f"Measure next: {experiment.description}; about {experiment.lab_time_s:.0f} s in the lab, "
            f"χ² {experiment.separation:.0f} between them.",
        ]
    elif found.verdict == "ambiguous" and len(found.causes) > 1:
        lines.append("No pulse or train, repeated up to 30 times, would separate them in any signal at this noise.")
    elif found.verdict == "undecided":
        lines.append(MORE_REPEATS)
    return [*lines, *found.remarks]


def _list_under(heading: str, items: list[str]) -> list[str]:
    return [heading, *items] if items else []


def _describe_omitted(found: Discrepancy) -> list[str]:
    """Return the lines on data that the verdict does not rest on."""
    omitted = [f"- {item.text}" for item in found.omitted_data]
    failed = [f"- could not be inspected: {item}" for item in found.inspection_failures]
    return _list_under("Not used (--use KIND of diagnose uses it):", omitted) + failed


def _describe_candidates(found: Discrepancy) -> list[str]:
    """Return the detection limits if no error was found, else the causes that are ruled out or not observable."""
    if found.verdict in NOTHING_FOUND:
        limits: dict[str, str] = {}
        for item in found.candidates:
            limits.setdefault(item.label, item.detection_limit)  # pixels come before mirrors
        return ["Detection limit of each effect:", *(f"- {label}: {limits[label]}" for label in sorted(limits))]
    ruled_out = [
        f"- {item.label}, {format_probability(item.probability)} (alone it reduces χ² by {item.statistic:.0f})"
        for item in found.candidates
        if item.verdict == "ruled out"
    ]
    unseen = [item.label for item in found.candidates if item.verdict == "not observable"]
    lines = _list_under("Ruled out:", ruled_out[:MAX_RULED_OUT])
    return [*lines, f"Not observable in this data: {', '.join(unseen)}."] if unseen else lines


def _describe_height_error(discrepancy: Discrepancy) -> str:
    """Return the error of heights planned with the model, on pushes that it did not see and on those that it did."""
    held_out, fitted = discrepancy.height_error_held_out, discrepancy.height_error_fitted
    error = held_out or fitted
    if error is None or fitted is None:
        return "The error of heights planned with this model is unknown: no measured push is clear of the noise."
    nominal = f" ({error.nominal_rms:.1%}, {error.nominal_max:.1%} nominal)" if discrepancy.terms else ""
    text = f"Heights planned with this model are off by {error.extended_rms:.1%} rms, {error.extended_max:.1%} at most"
    text += f"{nominal}, on {_count_pushes(error)}"
    if held_out is None:
        text += " that were fitted"
    else:
        text += f" held out of the fit; on all {_count_pushes(fitted)}, {fitted.extended_rms:.1%} and"
        text += f" {fitted.extended_max:.1%}"
    return f"{text}; their noise is {error.noise:.1%}. Pushes unlike the recorded ones may be further off."


def _count_pushes(error: HeightError) -> str:
    pushes = f"{error.pushes} push{'es' if error.pushes > 1 else ''}"
    return f"{pushes} of {error.experiments} experiment{'s' if error.experiments > 1 else ''}"


def _list_visible(found: Discrepancy) -> list[tuple[ResidualTrace, float, float]]:
    """Return the two traces with the largest change of residuals, or the largest residuals if unexplained.

    With each the rms residuals of the nominal and the extended model, in units of the noise of one sample.
    """
    if found.verdict in NOTHING_FOUND:
        return []
    rows = []
    for trace in found.residual_traces:
        nominal, extended = float((trace.nominal**2).mean()), float((trace.extended**2).mean())
        rows.append((nominal if found.verdict == "unexplained" else nominal - extended, trace, nominal, extended))
    rows.sort(key=lambda row: -row[0])
    return [(trace, nominal**0.5, extended**0.5) for _, trace, nominal, extended in rows[:2] if nominal > 0]


def _describe_locations(found: Discrepancy) -> list[str]:
    """Return where the error is visible."""
    return [
        f"Visible in {trace.signal} of {trace.group}: residuals of {nominal:.1f} σ per sample"
        + (f", {extended:.1f} σ with the cause." if found.causes else ".")
        for trace, nominal, extended in _list_visible(found)
    ]


def build_answer(found: Discrepancy) -> dict[str, Any]:
    """Return the diagnosis as JSON values."""
    probabilities = found.probabilities
    return {
        "verdict": found.verdict,
        "causes": list(found.causes),
        "reasons": list(found.reasons),
        "disturbances": [to_json(item) | {"unit": item.signal.rsplit("_", 1)[1]} for item in found.disturbances],
        "data": [build_finding(item) for item in found.data_findings],
        "omitted": [build_finding(item) for item in found.omitted_data],
        "not_inspected": list(found.inspection_failures),
        "probabilities": {
            "no_effect": probabilities.no_effect,
            "none_of_these": probabilities.none_of_these,
            "causes": [{"causes": list(keys), "probability": value} for keys, value in probabilities.ranked],
        },
        "parameters": {
            name: {"value": item.value, "unit": item.unit, "ci95": None if item.at_limit else [item.low, item.high]}
            for name, item in found.parameters.items()
        },
        "explained_fraction": found.explained_fraction,
        "doubts": found.doubts,
        "failures": found.failures,
        "omissions": found.omissions,
        "visible": [
            {"group": trace.group, "signal": trace.signal, "rms_sigma_nominal": nominal, "rms_sigma_extended": extended}
            for trace, nominal, extended in _list_visible(found)
        ],
        "height_error": {
            "held_out": to_json(found.height_error_held_out),
            "fitted": to_json(found.height_error_fitted),
        },
        "gain": to_json(found.gain, nominal="heldout_rmse_nominal", extended="heldout_rmse_extended", interval="ci95"),
        "candidates": to_json(found.candidates, label="hypothesis"),
        "rivals": [
            to_json(item, label="hypothesis", chi2="chi2_above_best", is_chosen="chosen")
            | {"parameters": {name: {"value": value, "unit": unit} for name, (value, unit) in item.parameters.items()}}
            for item in found.rivals
        ],
        "held_out": to_json(found.held_out_errors, nominal="rmse_nominal", extended="rmse_extended"),
        "next_experiment": to_json(found.next_experiment, separation="expected_separation", lab_time_s="duration_s"),
        "runs": {"fitted": list(found.fitted_runs), "held_out": list(found.held_out_runs)},
        "remarks": list(found.remarks),
        "elapsed_s": found.elapsed_s,
        "version": __version__,
    }


BASE_PARAMETER_SET = "surroundings"
VALUE_UNITS = {"tau_g": "s", "kappa": "m/K", "phi": "N/K"}


def build_model_toml(
    base: Mapping[str, float],
    terms: Mapping[str, TermValues],
    verdict: str,
    recording: str,
    width_m: float,
    estimator: str = "",
    discovered: Sequence[DiscoveredTerm] = (),
) -> str:
    """Return TOML of format optodrive-parameters, version 1.

    base, terms, verdict: as of `Discrepancy`; width_m: bridge width of the recorded pixel; estimator: how values were
    combined, where they are not of a single fit; discovered: functions that heights are planned with too
    """
    source = f'source = "fitted on {_sanitize(recording)}"'
    claim = "; ".join(part for part in (f"Fitted on {_sanitize(recording)}", estimator, f"verdict: {verdict}") if part)
    planned = ", ".join(f'"{key}"' for key in (*terms, *((KEY,) if discovered else ())))
    lines = [
        'format = "optodrive-parameters"',
        "version = 1",
        'name = "diagnosed"',
        f'base = "{BASE_PARAMETER_SET}"',
        f"planner_terms = [{planned}]",
        f'claims = "{claim}. For other bridge widths: R by 1 / width."',
        "",
    ]
    rows = [(name, base[name], unit) for name, unit in VALUE_UNITS.items()]
    rows += [("R_width_product", base["R"] * width_m, "m K/W"), ("C_mean", base["C"], "J/K")]
    lines += [line for row in rows for line in (*_format_quantity(*row), source, "")]
    lines += ["[[bridge]]", f"width_m = {width_m!r}"]
    for name, unit in (("R", "K/W"), ("C", "J/K")):
        lines += [*_format_quantity(f"bridge.{name}", base[name], unit), source]
    for key, values in terms.items():
        for item in discover_terms()[key].parameters:
            quantity = _format_quantity(f"terms.{key}.{item.name}", float(values[item.name]), item.unit)
            lines += ["", *quantity, source]
    for term in discovered:
        lines += ["", "[[discovered]]", source]
        lines += [f'{name} = "{getattr(term, name)}"' for name in ("where", "depends_on", "unit", "formula")]
        lines += [f"{name} = {getattr(term, name)!r}" for name in ("low", "high")]
        optional = {name: getattr(term, name) for name in ("memory_time_s", "max_power_w")}
        lines += [f"{name} = {value!r}" for name, value in optional.items() if value is not None]
        lines.append(f"values = [{', '.join(f'{value:.9g}' for value in term.values)}]")
    return "\n".join(lines) + "\n"


def _format_quantity(table: str, value: float, unit: str) -> list[str]:
    return [f"[{table}]", f"value = {value!r}", f'unit = "{unit}"']


def _sanitize(text: str) -> str:
    return "".join(letter for letter in text if letter.isprintable() and letter not in '"\\')
