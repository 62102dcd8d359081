"""The answer in plain words, and as the JSON of the format."""

from importlib.metadata import version
from math import isfinite
from typing import Any

from optodrive.core.types.discrepancy import CandidateCause, Discrepancy, Estimate
from optodrive.physics.terms import known_terms

WORDS = {
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
SCALES = ((1e-6, 1e6, "µ"), (1e-3, 1e3, "m"), (1.0, 1.0, ""))
PLAIN = ("", "1", "1/K", "1/s", "m^2", "Hz", "K", "K/W")
SHOWN = 6


def quantity(value: float, unit: str) -> str:
    """With a prefix where the unit takes one."""
    if unit in PLAIN or value == 0.0:
        return f"{value:.3g} {unit}".removesuffix(" 1").rstrip()
    for limit, scale, prefix in SCALES:
        if abs(value) < 1e3 * limit:
            return f"{value * scale:.3g} {prefix}{unit}"
    return f"{value:.3g} {unit}"


def _between(item: Estimate) -> str:
    return (
        f"{quantity(item.value, item.unit)} (95 %: {quantity(item.low, item.unit)} to {quantity(item.high, item.unit)})"
    )


def story(found: Discrepancy) -> list[str]:
    """What was wrong, where it shows, what causes it, how sure, what was ruled out, what it gains, what to measure."""
    lines = [_headline(found), ""]
    if found.causes and found.verdict != "none":
        lines += [f"- {WORDS.get(key, key)} ({key}); it shows in {known_terms()[key].suspect}." for key in found.causes]
        lines += [f"  {name} = {_between(item)}" for name, item in found.parameters.items() if "." in name]
        lines.append("")
    if found.verdict in ("cause", "ambiguous"):
        lines.append(f"It explains {found.explained:.1%} of what the nominal model gets wrong.")
    lines += _where(found)
    lines += _gained(found)
    if found.verdict == "none":
        lines += ["The smallest effect of each kind that would have been seen:"]
        lines += [f"- {item.label}: {item.smallest}" for item in _once(found.candidates)]
    else:
        out = [item for item in found.candidates if item.verdict == "ruled out"]
        if out:
            lines += ["Ruled out, because with it the residuals stay:"]
            lines += [f"- {item.label} (it alone would explain χ² {item.statistic:.0f})" for item in out[:SHOWN]]
        unseen = [item.label for item in found.candidates if item.verdict == "this data cannot show it"]
        if unseen:
            lines.append(f"This data cannot show: {', '.join(unseen)}.")
    if found.verdict == "ambiguous" and found.next_experiment is None:
        lines.append("No pulse or train on a pixel, repeated up to 30 times, would tell them apart at this noise.")
    if found.next_experiment is not None:
        ask = found.next_experiment
        lines += [
            "",
            f"Measure next: {ask.why}; about {ask.seconds:.0f} s in the lab, χ² {ask.separation:.0f} between them.",
        ]
    lines += list(found.remarks)
    return lines


def _headline(found: Discrepancy) -> str:
    names = [WORDS.get(key, key) for key in found.causes]
    if found.verdict == "none":
        return "Nothing found: the nominal model, refitted, agrees with this recording within its noise."
    if found.verdict == "cause":
        return f"The nominal model is wrong because {' and '.join(names)}."
    if found.verdict == "ambiguous" and names:
        return f"Something is wrong, and this data cannot tell which of these it is: {'; or '.join(names)}."
    return "Something is wrong, and none of the known causes explains it."


def _where(found: Discrepancy) -> list[str]:
    """The groups in which residuals fell, or stay, the most."""
    if found.verdict == "none":
        return []
    rows = []
    for course in found.courses:
        before, after = float((course.before**2).mean()), float((course.after**2).mean())
        rows.append((before if found.verdict == "unexplained" else before - after, before, after, course))
    rows.sort(key=lambda row: -row[0])
    return [
        f"It shows in {course.signal} of {course.group}: residuals of {before**0.5:.1f} σ a sample"
        + (f", {after**0.5:.1f} σ with the cause." if found.causes else ".")
        for _, before, after, course in rows[:2]
        if before > 0
    ]


def _gained(found: Discrepancy) -> list[str]:
    gain = found.gain
    if gain is None:
        if found.verdict in ("cause", "ambiguous"):
            return ["What it gains cannot be measured: no held-out run shows the effect."]
        return []
    lines = [
        f"On {len(found.held_out)} runs held out before naming, {gain.reduction:.0%} of the avoidable error goes "
        f"(95 %: {gain.low:.0%} to {gain.high:.0%})."
    ]
    for name, before in gain.before.items():
        unit = name.rsplit("_", 1)[1]
        after, floor = gain.after[name], gain.floor[name]
        lines.append(
            f"  {name}: RMSE {quantity(before, unit)} before, {quantity(after, unit)} after, "
            f"noise {quantity(floor, unit)}"
        )
    return lines


def _once(candidates: tuple[CandidateCause, ...]) -> list[CandidateCause]:
    """By label, each once: what pixels and mirrors both show is said of the pixels."""
    first: dict[str, CandidateCause] = {}
    for item in candidates:
        first.setdefault(item.label, item)
    return [first[label] for label in sorted(first)]


def answer(found: Discrepancy) -> dict[str, Any]:
    """The JSON of the format."""
    gain, ask = found.gain, found.next_experiment
    return {
        "verdict": found.verdict,
        "causes": list(found.causes),
        "parameters": {
            name: {"value": item.value, "unit": item.unit, "ci95": [item.low, item.high]}
            for name, item in found.parameters.items()
        },
        "explained": found.explained,
        "gain": None
        if gain is None
        else {
            "heldout_rmse_before": gain.before,
            "heldout_rmse_after": gain.after,
            "noise_floor": gain.floor,
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
                "smallest_detectable": item.smallest,
            }
            for item in found.candidates
        ],
        "next_experiment": None
        if ask is None
        else {
            "why": ask.why,
            "pulses": ask.pulses.tolist(),
            "pixel": ask.pixel,
            "repeats": ask.repeats,
            "signals": list(ask.signals),
            "expected_separation": ask.separation,
            "seconds": ask.seconds,
        },
        "runs": {"fitted": list(found.fitted), "held_out": list(found.held_out)},
        "remarks": list(found.remarks),
        "seconds": found.seconds,
        "version": version("optodrive"),
    }
