"""Score of an answer (`diagnosis.json`) against the ground truth of a case, and the table of scores.

    s = score_answer(case, answer, after=second_answer)      # after: the answer with the proposed experiment included
    print(format_table(scores))

Rules that the design leaves open: without a hidden effect every verdict but "none" is a false alarm. A set counts only
if the verdict is "ambiguous" or names one cause. Naming anything for a mechanism outside the catalogue is misnaming, an
ambiguous set included. `sensor_scale` is not observable without a reference: naming it alone is wrong, "none" is right
and so is a set that holds it; it has its own row.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

UNNAMEABLE = "sensor_scale"
BASE = ("R", "C", "tau_g", "kappa", "phi")
# Causes under which R and C depend on the convention for ε P.
BASE_BY_CONVENTION = ("power_nonlinearity", "sensor_scale", "beam_misalignment", "absorber_ageing")

# Names of a size in an answer; only these are compared, and only for the textbook form.
NAMES: dict[str, tuple[str, ...]] = {
    "bridge_conductivity.n": ("n", "exponent"),
    "heat_capacity.c": ("c", "slope"),
    "radiation.eps_A": ("eps_A", "eps_a", "area", "emitting_area", "epsilon_A"),
    "wall_heating.R_w": ("R_w", "r_w", "R", "resistance"),
    "wall_heating.tau_w": ("tau_w", "tau"),
    "neighbour_crosstalk.kappa_x": ("kappa_x", "share"),
    "laser_turn_on.tau": ("tau", "tau_L", "tau_l", "time"),
    "laser_droop.depth": ("depth", "fraction", "size", "share"),
    "laser_droop.tau": ("tau", "tau_d", "time"),
    "sensor_lag.tau": ("tau", "tau_s", "time"),
    "membrane_creep.J": ("J", "j", "share"),
    "membrane_creep.tau": ("tau", "tau_c", "time"),
    "gas_leak.rate": ("rate", "leak_rate"),
    "clock_offset.offset": ("offset", "t_d", "delay", "temperature", "displacement", "force"),
    "mirror_lag.hz": ("hz", "frequency", "f_n", "natural_hz"),
    "mirror_lag.zeta": ("zeta", "damping"),
}

# Sizes with another unit in the answer: c per 100 K is a slope per kelvin.
UNITS = {"heat_capacity.slope": 0.01}


@dataclass(frozen=True)
class Score:
    """Score of one case. A mark is None where a question does not apply."""

    block: str
    seed: int
    causes: tuple[str, ...]
    verdict: str
    named: tuple[str, ...]
    effect_sigma: float = 0.0
    false_alarm: bool | None = None
    alone: bool | None = None
    in_set: bool | None = None
    right: bool | None = None
    unexplained: bool | None = None
    misnamed: bool | None = None
    both: bool | None = None
    some_none_false: bool | None = None
    scale_right: bool | None = None
    base_inside: dict[str, bool] = field(default_factory=dict)
    term_inside: dict[str, bool] = field(default_factory=dict)
    gain: float | None = None
    worse: bool | None = None
    resolved: bool | None = None
    seconds: float | None = None


def _inside(parameters: Mapping[str, Any], name: str, truth: float) -> bool | None:
    entry = parameters.get(name)
    if not entry or entry.get("ci95") is None:
        return None
    low, high = entry["ci95"]
    return bool(low <= truth <= high)


def _covered(case: Any, answer: Mapping[str, Any]) -> tuple[dict[str, bool], dict[str, bool]]:
    parameters = answer.get("parameters") or {}
    base: dict[str, bool] = {}
    if not set(case.causes) & set(BASE_BY_CONVENTION):
        for name in BASE:
            held = _inside(parameters, name, case.base[name])
            if held is not None:
                base[name] = held
    terms: dict[str, bool] = {}
    for effect in case.effects:
        if not effect.textbook:
            continue
        for size, truth in effect.sizes.items():
            for alias in NAMES.get(f"{effect.key}.{size}", ()):
                name = f"{effect.key}.{alias}"
                held = _inside(parameters, name, truth * UNITS.get(name, 1.0))
                if held is not None:
                    terms[f"{effect.key}.{size}"] = held
                    break
    return base, terms


def score_answer(
    case: Any, answer: Mapping[str, Any], *, after: Mapping[str, Any] | None = None, known: float | None = None
) -> Score:
    """Score one answer. `known` is the gain of a fit with the known cause, default 1 (down to the noise)."""
    verdict = str(answer.get("verdict"))
    named = tuple(answer.get("causes") or ())
    truth = set(case.causes)
    marks: dict[str, Any] = {}
    correct = False
    if case.block == "none":
        marks["false_alarm"] = verdict != "none"
        correct = verdict == "none"
    elif case.block == "unknown":
        marks["unexplained"] = verdict == "unexplained"
        marks["misnamed"] = verdict in ("cause", "ambiguous")
    elif case.block == "pair":
        said = verdict in ("cause", "ambiguous") and bool(named)
        marks["both"] = verdict == "cause" and set(named) == truth
        marks["some_none_false"] = said and set(named) <= truth
        marks["misnamed"] = verdict == "cause" and not set(named) <= truth
        correct = marks["both"]
    elif UNNAMEABLE in truth:
        marks["scale_right"] = verdict == "none" or (verdict == "ambiguous" and UNNAMEABLE in named)
        marks["misnamed"] = verdict == "cause"
    else:
        marks["alone"] = verdict == "cause" and set(named) == truth
        held = verdict in ("cause", "ambiguous") and truth <= set(named)
        marks["in_set"] = marks["alone"] or (held and verdict == "ambiguous" and len(named) <= 2)
        marks["misnamed"] = verdict == "cause" and not marks["alone"]
        if verdict == "cause" and len(named) == 1:
            marks["right"] = marks["alone"]
        correct = marks["alone"]
    if correct:
        marks["base_inside"], marks["term_inside"] = _covered(case, answer)
    reduction = (answer.get("gain") or {}).get("reduction")
    if reduction is not None and verdict == "cause" and case.block in ("single", "pair"):
        marks["gain"] = float(reduction) / known if known else float(reduction)
    if reduction is not None and verdict in ("cause", "ambiguous"):
        marks["worse"] = float(reduction) < 0.0
    if after is not None and verdict == "ambiguous":
        final = tuple(after.get("causes") or ())
        marks["resolved"] = after.get("verdict") == "cause" and set(final) == truth
    seconds = answer.get("elapsed_s")
    return Score(
        block=case.block,
        seed=case.seed,
        causes=tuple(case.causes),
        verdict=verdict,
        named=named,
        effect_sigma=float(case.effect_sigma),
        seconds=None if seconds is None else float(seconds),
        **marks,
    )


def wilson(hits: int, count: int, z: float = 1.959964) -> tuple[float, float]:
    """Return the 95 % Wilson interval of a proportion."""
    if count == 0:
        return 0.0, 1.0
    p, zz = hits / count, z * z
    centre = (p + zz / (2 * count)) / (1 + zz / count)
    half = z / (1 + zz / count) * math.sqrt(p * (1 - p) / count + zz / (4 * count * count))
    return max(0.0, centre - half), min(1.0, centre + half)


def _row(block: str, what: str, values: Iterable[bool | None], aim: str) -> str:
    values = [v for v in values if v is not None]
    if not values:
        return f"| {block} | {what} | – | – | – | {aim} |"
    hits = sum(values)
    low, high = wilson(hits, len(values))
    return (
        f"| {block} | {what} | {hits}/{len(values)} | {100 * hits / len(values):.1f} % "
        f"| {100 * low:.1f} to {100 * high:.1f} % | {aim} |"
    )


def _quantile(values: list[float], q: float) -> float:
    ranked = sorted(values)
    at = q * (len(ranked) - 1)
    low = math.floor(at)
    high = min(low + 1, len(ranked) - 1)
    return ranked[low] + (at - low) * (ranked[high] - ranked[low])


def format_table(scores: Iterable[Score]) -> str:
    """Return the table of docs/explanation/blind-tests.md, then each cause and mechanism by itself."""
    every = list(scores)
    lines = ["| block | score | hits | share | 95 % interval | aim |", "|---|---|---|---|---|---|"]

    def row(block: str, what: str, mark: str, aim: str, only: str | None = None) -> None:
        chosen = [getattr(s, mark) for s in every if only is None or s.block == only]
        lines.append(_row(block, what, chosen, aim))

    row("no hidden effect", "false alarms", "false_alarm", "≤ 1 %")
    row("one cause", "alone or in a set of ≤ 2", "in_set", "≥ 95 %", "single")
    row("one cause", "alone", "alone", "≥ 85 %", "single")
    row("one cause", "named alone: right", "right", "≥ 98 %", "single")
    row("one cause", "a false name given", "misnamed", "", "single")
    row("sensor_scale", "none, or a set holding it", "scale_right", "", "single")
    row("outside the catalogue", "unexplained", "unexplained", "≥ 90 %", "unknown")
    row("outside the catalogue", "misnamed", "misnamed", "≤ 5 %", "unknown")
    row("two causes", "both", "both", "≥ 75 %", "pair")
    row("two causes", "at least one, none false", "some_none_false", "≥ 95 %", "pair")
    base = [held for s in every for held in s.base_inside.values()]
    lines.append(_row("parameters", "base inside ci95", base, "90 to 98 %"))
    for name in BASE:
        lines.append(_row("parameters", f"{name} inside ci95", [s.base_inside.get(name) for s in every], ""))
    terms = [held for s in every for held in s.term_inside.values()]
    lines.append(_row("parameters", "term inside ci95", terms, "90 to 98 %"))
    row("held-out gain", "worse than before", "worse", "≤ 1 %")
    row("next experiment", "ambiguity resolved", "resolved", "≥ 80 %")
    gains = [s.gain for s in every if s.gain is not None]
    if gains:
        spread = f"{_quantile(gains, 0.05):.3f} to {_quantile(gains, 0.95):.3f} (5 to 95 %)"
        lines.append(f"| held-out gain | median | {len(gains)} | {_quantile(gains, 0.5):.3f} | {spread} | ≥ 0.95 |")
    spent = [s.seconds for s in every if s.seconds is not None]
    if spent:
        lines.append(
            f"| time | median, largest | {len(spent)} | {_quantile(spent, 0.5):.1f} s | {max(spent):.1f} s | ≤ 30 s |"
        )
    lines += ["", "| hidden | cases | what was said |", "|---|---|---|"]
    hidden: dict[str, list[Score]] = {}
    for s in every:
        name = s.causes[-1] if s.block in ("single", "unknown") else s.block
        hidden.setdefault(f"{s.block}: {name}" if s.causes else "none", []).append(s)
    for name, some in sorted(hidden.items()):
        said: dict[str, int] = {}
        for s in some:
            words = s.verdict + (" " + "+".join(s.named) if s.named else "")
            said[words] = said.get(words, 0) + 1
        answers = ", ".join(f"{n} × {w}" for w, n in sorted(said.items(), key=lambda item: -item[1]))
        lines.append(f"| {name} | {len(some)} | {answers} |")
    return "\n".join(lines) + "\n"
