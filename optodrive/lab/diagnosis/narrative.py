"""The answer in plain words, and as the JSON of the format."""

from importlib.metadata import version
from math import isfinite
from typing import Any

from optodrive.core.types.discrepancy import CandidateCause, Discrepancy, Estimate
from optodrive.physics.terms import discover_terms

CAUSE_PHRASES = {
    "bridge_conductivity": "the bridges conduct worse when hot",
    "heat_capacity": "the absorber stores more heat when hot",
    "radiation": "the hot absorber radiates",
    "wall_heating": "the wall at the bridges' far end warms",
    "neighbour_crosstalk": "pixels warm the pixels beside them",
    "laser_turn_on": "the laser takes time to reach its power",
    "laser_droop": "the laser's power falls while it is on",
    "power_nonlinearity": "the laser's power is not proportional to what is commanded",
    "sensor_lag": "the thermometer is slow",
    "sensor_scale": "the thermometer's scale is off",
    "membrane_creep": "the membrane creeps",
    "membrane_stiffening": "the membrane stiffens as it rises",
    "gas_leak": "gas leaks out of the warm cell",
    "absorber_ageing": "the absorber absorbs less with the light it has had",
    "beam_misalignment": "on one pixel part of the beam misses the absorber",
    "ambient_drift": "the room's temperature is not what was stated",
    "clock_offset": "an instrument's clock is offset",
    "mirror_lag": "the mirrors follow late",
}
UNIT_PREFIXES = ((1e-6, 1e6, "µ"), (1e-3, 1e3, "m"), (1.0, 1.0, ""))
UNPREFIXED_UNITS = ("", "1", "1/K", "1/s", "m^2", "Hz", "K", "K/W")
MAX_RULED_OUT = 6


def format_quantity(value: float, unit: str) -> str:
    """With a prefix where the unit takes one."""
    if unit in UNPREFIXED_UNITS or value == 0.0:
        return f"{value:.3g} {unit}".removesuffix(" 1").rstrip()
    for limit, scale, prefix in UNIT_PREFIXES:
        if abs(value) < 1e3 * limit:
            return f"{value * scale:.3g} {prefix}{unit}"
    return f"{value:.3g} {unit}"


def _format_interval(item: Estimate) -> str:
    return f"{format_quantity(item.value, item.unit)} (95 %: {format_quantity(item.low, item.unit)} to {format_quantity(item.high, item.unit)})"


def build_narrative(discrepancy: Discrepancy) -> list[str]:
    """What was wrong, where it shows, what causes it, how sure, what was ruled out, what it gains, what to measure."""
    lines = [_build_headline(discrepancy), ""]
    if discrepancy.causes and discrepancy.verdict != "none":
        lines += [
            f"- {CAUSE_PHRASES.get(key, key)} ({key}); it shows in {discover_terms()[key].signature}."
            for key in discrepancy.causes
        ]
        lines += [
            f"  {name} = {_format_interval(item)}" for name, item in discrepancy.parameters.items() if "." in name
        ]
        lines.append("")
    if discrepancy.verdict in ("cause", "ambiguous"):
        lines.append(f"It explains {discrepancy.explained_fraction:.1%} of what the nominal model gets wrong.")
    lines += _describe_locations(discrepancy)
    lines += _describe_gain(discrepancy)
    if discrepancy.verdict == "none":
        lines += ["The smallest effect of each kind that would have been seen:"]
        lines += [f"- {item.label}: {item.detection_limit}" for item in _deduplicate_by_label(discrepancy.candidates)]
    else:
        ruled_out = [item for item in discrepancy.candidates if item.verdict == "ruled out"]
        if ruled_out:
            lines += ["Ruled out, because with it the residuals stay:"]
            lines += [
                f"- {item.label} (it alone would explain χ² {item.statistic:.0f})" for item in ruled_out[:MAX_RULED_OUT]
            ]
        not_observable = [item.label for item in discrepancy.candidates if item.verdict == "this data cannot show it"]
        if not_observable:
            lines.append(f"This data cannot show: {', '.join(not_observable)}.")
    if discrepancy.verdict == "ambiguous" and discrepancy.next_experiment is None:
        lines.append("No pulse or train on a pixel, repeated up to 30 times, would tell them apart at this noise.")
    if discrepancy.next_experiment is not None:
        experiment = discrepancy.next_experiment
        lines += [
            "",
            f"Measure next: {experiment.rationale}; about {experiment.lab_time_s:.0f} s in the lab, χ² {experiment.separation:.0f} between them.",
        ]
    lines += list(discrepancy.remarks)
    return lines


def _build_headline(discrepancy: Discrepancy) -> str:
    names = [CAUSE_PHRASES.get(key, key) for key in discrepancy.causes]
    if discrepancy.verdict == "none":
        return "Nothing found: the nominal model, refitted, agrees with this recording within its noise."
    if discrepancy.verdict == "cause":
        return f"The nominal model is wrong because {' and '.join(names)}."
    if discrepancy.verdict == "ambiguous" and names:
        return f"Something is wrong, and this data cannot tell which of these it is: {'; or '.join(names)}."
    return "Something is wrong, and none of the known causes explains it."


def _describe_locations(discrepancy: Discrepancy) -> list[str]:
    """The groups in which residuals fell, or stay, the most."""
    if discrepancy.verdict == "none":
        return []
    rows = []
    for trace in discrepancy.residual_traces:
        nominal, extended = float((trace.nominal**2).mean()), float((trace.extended**2).mean())
        rows.append((nominal if discrepancy.verdict == "unexplained" else nominal - extended, nominal, extended, trace))
    rows.sort(key=lambda row: -row[0])
    return [
        f"It shows in {course.signal} of {course.group}: residuals of {before**0.5:.1f} σ a sample"
        + (f", {after**0.5:.1f} σ with the cause." if discrepancy.causes else ".")
        for _, before, after, course in rows[:2]
        if before > 0
    ]


def _describe_gain(discrepancy: Discrepancy) -> list[str]:
    gain = discrepancy.gain
    if gain is None:
        if discrepancy.verdict in ("cause", "ambiguous"):
            return ["What it gains cannot be measured: no held-out run shows the effect."]
        return []
    lines = [
        f"On {len(discrepancy.held_out_runs)} runs held out before naming, {gain.reduction:.0%} of the avoidable error goes "
        f"(95 %: {gain.low:.0%} to {gain.high:.0%})."
    ]
    for name, nominal in gain.nominal.items():
        unit = name.rsplit("_", 1)[1]
        extended, floor = gain.extended[name], gain.noise_floor[name]
        lines.append(
            f"  {name}: RMSE {format_quantity(nominal, unit)} before, {format_quantity(extended, unit)} after, "
            f"noise {format_quantity(floor, unit)}"
        )
    return lines


def _deduplicate_by_label(candidates: tuple[CandidateCause, ...]) -> list[CandidateCause]:
    """By label, each once: what pixels and mirrors both show is said of the pixels."""
    first: dict[str, CandidateCause] = {}
    for item in candidates:
        first.setdefault(item.label, item)
    return [first[label] for label in sorted(first)]


def build_answer(discrepancy: Discrepancy) -> dict[str, Any]:
    """The JSON of the format."""
    gain, experiment = discrepancy.gain, discrepancy.next_experiment
    return {
        "verdict": discrepancy.verdict,
        "causes": list(discrepancy.causes),
        "parameters": {
            name: {"value": item.value, "unit": item.unit, "ci95": [item.low, item.high]}
            for name, item in discrepancy.parameters.items()
        },
        "explained": discrepancy.explained_fraction,
        "gain": None
        if gain is None
        else {
            "heldout_rmse_before": gain.nominal,
            "heldout_rmse_after": gain.extended,
            "noise_floor": gain.noise_floor,
            "reduction": gain.reduction,
            "ci95": [gain.low, gain.high],
        },
        "candidates": [
            {
                "cause": item.cause,
                "hypothesis": item.label,
                "statistic": item.statistic if isfinite(item.statistic) else None,
                "p_value": item.p_value,
                "heldout_gain": item.heldout_gain,
                "verdict": item.verdict,
                "smallest_detectable": item.detection_limit,
            }
            for item in discrepancy.candidates
        ],
        "next_experiment": None
        if experiment is None
        else {
            "why": experiment.rationale,
            "pulses": experiment.pulses.tolist(),
            "pixel": experiment.pixel,
            "repeats": experiment.repeats,
            "signals": list(experiment.signals),
            "expected_separation": experiment.separation,
            "seconds": experiment.lab_time_s,
        },
        "runs": {"fitted": list(discrepancy.fitted_runs), "held_out": list(discrepancy.held_out_runs)},
        "remarks": list(discrepancy.remarks),
        "seconds": discrepancy.elapsed_s,
        "version": version("optodrive"),
    }
