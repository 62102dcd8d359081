"""Diagnosis as narrative text and as JSON."""

from dataclasses import asdict
from importlib.metadata import version
from math import isfinite
from typing import Any

from optodrive.core.quantity import format_quantity
from optodrive.core.types.discrepancy import (
    CandidateCause,
    Discrepancy,
    Estimate,
    HeightError,
)
from optodrive.lab.inference.claim import NOTHING_FOUND, format_probability
from optodrive.lab.inference.sentences import (
    describe_claim,
    describe_disturbance,
    describe_gain,
    describe_probabilities,
)
from optodrive.lab.inspection.page import build_finding
from optodrive.physics.terms import discover_terms

MAX_RULED_OUT = 6


def _format_interval(item: Estimate) -> str:
    if item.at_limit:
        return f"no estimate: beyond its plausible range, which ends at {format_quantity(item.value, item.unit)}"
    value, low, high = (format_quantity(number, item.unit) for number in (item.value, item.low, item.high))
    return f"{value} (95 %: {low} to {high})"


def build_narrative(discrepancy: Discrepancy) -> list[str]:
    """Return the lines of the narrative: headline, causes, gain, rejected causes, next experiment and remarks."""
    lines = [*describe_claim(discrepancy, discover_terms()), *describe_omitted(discrepancy), ""]
    if discrepancy.causes:
        lines += [
            f"- {discover_terms()[key].label} ({key}); visible in {discover_terms()[key].signature}."
            for key in discrepancy.causes
        ]
        lines += [
            f"  {name} = {_format_interval(item)}" for name, item in discrepancy.parameters.items() if "." in name
        ]
        lines.append("")
    lines += [f"{describe_disturbance(item)}; it was subtracted." for item in discrepancy.disturbances]
    lines.append(describe_probabilities(discrepancy.probabilities))
    if discrepancy.verdict in ("cause", "ambiguous"):
        lines.append(f"This explains {discrepancy.explained_fraction:.1%} of the excess χ² of the nominal model.")
    lines.append(_describe_height_error(discrepancy))
    lines += _describe_locations(discrepancy)
    lines += describe_gain(discrepancy.gain, discrepancy.verdict, len(discrepancy.held_out_runs))
    lines += [f"To tell: {remedy}" for key in discrepancy.causes if (remedy := discover_terms()[key].remedy)]
    if discrepancy.failures:
        lines.append("Could not be computed, and may explain what was measured:")
        lines += [f"- {label}: {reason}" for label, reason in discrepancy.failures.items()]
    lines += [f"Left out, for it failed: {step} ({error})." for step, error in discrepancy.omissions.items()]
    if discrepancy.verdict in NOTHING_FOUND:
        lines += ["Detection limit of each effect:"]
        lines += [f"- {item.label}: {item.detection_limit}" for item in _deduplicate_by_label(discrepancy.candidates)]
    else:
        ruled_out = [item for item in discrepancy.candidates if item.verdict == "ruled out"]
        if ruled_out:
            lines += ["Ruled out:"]
            lines += [
                f"- {item.label}, {format_probability(item.probability)} (alone it reduces χ² by {item.statistic:.0f})"
                for item in ruled_out[:MAX_RULED_OUT]
            ]
        not_observable = [item.label for item in discrepancy.candidates if item.verdict == "not observable"]
        if not_observable:
            lines.append(f"Not observable in this data: {', '.join(not_observable)}.")
    if discrepancy.verdict == "ambiguous" and len(discrepancy.causes) > 1 and discrepancy.next_experiment is None:
        lines.append("No pulse or train, repeated up to 30 times, would separate them in any signal at this noise.")
    if discrepancy.next_experiment is not None:
        experiment = discrepancy.next_experiment
        lines += [
            "",
            f"Measure next: {experiment.description}; about {experiment.lab_time_s:.0f} s in the lab, "
            f"χ² {experiment.separation:.0f} between them.",
        ]
    lines += list(discrepancy.remarks)
    return lines


def describe_omitted(discrepancy: Discrepancy) -> list[str]:
    """Return the lines on data that the verdict does not rest on."""
    omitted = [f"- {item.text}" for item in discrepancy.omitted_data]
    failed = [f"- could not be inspected: {item}" for item in discrepancy.inspection_failures]
    return ["Not used (--use KIND of diagnose uses it):", *omitted] * bool(omitted) + failed


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


def _describe_locations(discrepancy: Discrepancy) -> list[str]:
    """Return the two groups with the largest change of residuals, or the largest residuals if unexplained."""
    if discrepancy.verdict in NOTHING_FOUND:
        return []
    rows = []
    for trace in discrepancy.residual_traces:
        nominal, extended = float((trace.nominal**2).mean()), float((trace.extended**2).mean())
        rows.append((nominal if discrepancy.verdict == "unexplained" else nominal - extended, nominal, extended, trace))
    rows.sort(key=lambda row: -row[0])
    return [
        f"Visible in {trace.signal} of {trace.group}: residuals of {nominal**0.5:.1f} σ per sample"
        + (f", {extended**0.5:.1f} σ with the cause." if discrepancy.causes else ".")
        for _, nominal, extended, trace in rows[:2]
        if nominal > 0
    ]


def _deduplicate_by_label(candidates: tuple[CandidateCause, ...]) -> list[CandidateCause]:
    """Return the first candidate of each label, sorted. Pixels come before mirrors."""
    first: dict[str, CandidateCause] = {}
    for item in candidates:
        first.setdefault(item.label, item)
    return [first[label] for label in sorted(first)]


def build_answer(discrepancy: Discrepancy) -> dict[str, Any]:
    """Return the diagnosis as JSON values."""
    gain, experiment = discrepancy.gain, discrepancy.next_experiment
    return {
        "verdict": discrepancy.verdict,
        "causes": list(discrepancy.causes),
        "reasons": list(discrepancy.reasons),
        "disturbances": [
            {
                "signal": item.signal,
                "form": item.form,
                "size": item.size,
                "unit": item.signal.rsplit("_", 1)[1],
                "frequency_hz": item.frequency_hz,
                "runs": item.runs,
            }
            for item in discrepancy.disturbances
        ],
        "data": [build_finding(item) for item in discrepancy.data_findings],
        "omitted": [build_finding(item) for item in discrepancy.omitted_data],
        "not_inspected": list(discrepancy.inspection_failures),
        "probabilities": {
            "no_effect": discrepancy.probabilities.no_effect,
            "none_of_these": discrepancy.probabilities.none_of_these,
            "causes": [
                {"causes": list(keys), "probability": probability}
                for keys, probability in discrepancy.probabilities.ranked
            ],
        },
        "parameters": {
            name: {"value": item.value, "unit": item.unit, "ci95": None if item.at_limit else [item.low, item.high]}
            for name, item in discrepancy.parameters.items()
        },
        "explained_fraction": discrepancy.explained_fraction,
        "doubts": discrepancy.doubts,
        "failures": discrepancy.failures,
        "omissions": discrepancy.omissions,
        "height_error": {
            "held_out": _height_error_to_json(discrepancy.height_error_held_out),
            "fitted": _height_error_to_json(discrepancy.height_error_fitted),
        },
        "gain": None
        if gain is None
        else {
            "heldout_rmse_nominal": gain.nominal,
            "heldout_rmse_extended": gain.extended,
            "noise_floor": gain.noise_floor,
            "reduction": gain.reduction,
            "ci95": None if gain.interval is None else list(gain.interval),
        },
        "candidates": [
            {
                "cause": item.cause,
                "hypothesis": item.label,
                "statistic": item.statistic if isfinite(item.statistic) else None,
                "probability": item.probability,
                "heldout_gain": item.heldout_gain,
                "verdict": item.verdict,
                "detection_limit": item.detection_limit,
            }
            for item in discrepancy.candidates
        ],
        "rivals": [
            {
                "causes": list(item.causes),
                "hypothesis": item.label,
                "chi2_above_best": item.chi2,
                "log_evidence": item.log_evidence,
                "probability": item.probability,
                "heldout_gain": item.heldout_gain,
                "chosen": item.is_chosen,
                "parameters": {name: {"value": value, "unit": unit} for name, (value, unit) in item.parameters.items()},
            }
            for item in discrepancy.rivals
        ],
        "held_out": [
            {
                "group": item.group,
                "signal": item.signal,
                "runs": item.runs,
                "rmse_nominal": item.nominal,
                "rmse_extended": item.extended,
                "noise_floor": item.noise_floor,
            }
            for item in discrepancy.held_out_errors
        ],
        "next_experiment": None
        if experiment is None
        else {
            "description": experiment.description,
            "pulses": experiment.pulses.tolist(),
            "pixel": experiment.pixel,
            "repeats": experiment.repeats,
            "signals": list(experiment.signals),
            "expected_separation": experiment.separation,
            "duration_s": experiment.lab_time_s,
        },
        "runs": {"fitted": list(discrepancy.fitted_runs), "held_out": list(discrepancy.held_out_runs)},
        "remarks": list(discrepancy.remarks),
        "elapsed_s": discrepancy.elapsed_s,
        "version": version("optodrive"),
    }


def _height_error_to_json(error: HeightError | None) -> dict[str, Any] | None:
    return None if error is None else asdict(error)
