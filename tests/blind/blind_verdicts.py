"""What a truthful answer is allowed to say about a recording with faults of its instruments, in one table.

Marks: **right**, as `ALLOWED` states, or an ambiguity that holds the hidden cause; **allowed**, less than could be said
and nothing false; **missed**, a suspicion of something that is not there, or of nothing named; **wrong**, a cause named
that was not simulated, "none" with heights that are off by more than the answer states, or a traceback.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from blind_display import DISPLACEMENT, Physics, simulate_signals

INSTRUMENT_TERMS = frozenset(
    (
        *("sensor_lag", "clock_offset", "sensor_scale", "ambient_drift", "time_rate", "smoothing", "high_pass"),
        "run_gain",
    )
)
"""Terms of the catalogue that are not in the pixel."""
LAGS = frozenset(("sensor_lag", "clock_offset", "smoothing"))
FEW_RUNS = 4
"""Largest number of touched runs of which a text must name one, rather than the signal."""
HEIGHTS_OFF = 0.02
"""Error of heights that an answer need not state, relative."""


@dataclass(frozen=True)
class Allowed:
    """Truthful answers to one kind of fault.

    names: terms that are the fault; near: terms of instruments that may stand for it; twins: causes that no recording
    of this kind tells from it, allowed in an ambiguity with one of the names; words: expression that the answer's text
    must hold beside a touched run or signal, empty where nothing need be said; refusal: whether it may be refused, by
    the name of a run or a signal
    """

    names: frozenset[str] = frozenset()
    near: frozenset[str] = frozenset()
    twins: frozenset[str] = frozenset()
    words: str = ""
    refusal: bool = False


def _set(*keys: str) -> frozenset[str]:
    return frozenset(keys)


ALLOWED: dict[str, Allowed] = {
    # Verdict as without these runs, which are left out by name.
    "flat": Allowed(
        words=r"flat|dead|constant|loose|stuck|noise only|no response|does not (?:follow|respond)|left out"
    ),
    # Verdict as without the clipped samples, which are left out by name.
    "ceiling": Allowed(words=r"clip|ceiling|floor|saturat|plateau|end of (?:its|the) range", refusal=True),
    "time_rate": Allowed(_set("time_rate"), _set("clock_offset"), refusal=True),
    # A trailing mean is a delay and a symmetrical mean; a lag of the sensor has this form, too.
    "moving_mean": Allowed(_set("smoothing", "sensor_lag"), LAGS, refusal=True),
    "zero_phase": Allowed(_set("smoothing"), LAGS, refusal=True),
    # Held values are late by half their period and smoothed.
    "hold": Allowed(_set(), LAGS, words=r"\bheld\b|repeated|interpolat|lines between|resampl|\bhold", refusal=True),
    "high_pass": Allowed(_set("high_pass"), twins=_set("gas_leak", "wall_heating", "membrane_creep"), refusal=True),
    "signal_clock": Allowed(_set("clock_offset"), _set("sensor_lag", "smoothing")),
    "outliers": Allowed(words=r"outlier|deviat|spike|off by|left out"),
    "slow_drift": Allowed(_set(), _set("ambient_drift")),
    "quantised": Allowed(refusal=True),
    "coloured": Allowed(),
    "free_running": Allowed(),
    # Start times that can be read are read; what is ambiguous is refused or said.
    "stamps": Allowed(words=r"started_at|start time|time ?stamp|zone|month", refusal=True),
    "sentinel": Allowed(words=r"impossible|sentinel|no measured|cannot|outlier|left out|likely|expected", refusal=True),
    "exchanged": Allowed(words=r"exchang|resembl|swap|each other|left out|better", refusal=True),
    "trigger": Allowed(
        words=r"trigger|\blate\b|\bearly\b|clock|shift|(?:after|before) the light|left out", refusal=True
    ),
    "sign": Allowed(words=r"\bsign\b|invert|negativ|revers|turned|−1|falls while", refusal=True),
    "gain_run": Allowed(_set("run_gain"), words=r"gain|scale|power|left out"),
    "gap": Allowed(_set(), _set("clock_offset")),
}
"""Kind of fault → truthful answers, beside nothing and beside every cause."""


@dataclass(frozen=True)
class Said:
    """An answer as the command line gave it: its JSON, else its message."""

    answer: dict[str, Any]
    message: str
    elapsed_s: float = 0.0

    @property
    def is_refusal(self) -> bool:
        """Whether the recording is refused in one line."""
        return bool(self.message) and "Traceback" not in self.message and self.message.startswith("optodrive: ")

    @property
    def omissions(self) -> list[Any]:
        """What the answer did not use."""
        return [item for item in self.answer.get("data") or () if item.get("action") == "left out"]

    @property
    def texts(self) -> list[str]:
        """Every statement about the data, each as one text."""
        if self.message:
            return [self.message]
        keys = ("data", "reasons", "disturbances", "doubts", "failures", "remarks")
        parts: list[Any] = []
        for key in keys:
            held = self.answer.get(key) or ()
            parts += [held] if isinstance(held, str) else list(held.items() if isinstance(held, dict) else held)
        return [part if isinstance(part, str) else json.dumps(part, ensure_ascii=False) for part in parts]


@dataclass(frozen=True)
class Outcome:
    """Mark of an answer, with its reason.

    keeps_verdict: whether the verdict is that of the recording without the fault; accuses_pixel: whether the answer
    says that something is wrong with the pixel; heights: error of predicted heights, and the one that is stated
    """

    mark: str
    why: str
    keeps_verdict: bool = False
    accuses_pixel: bool = False
    heights: tuple[float, float] | None = field(default=None)


def is_named(fault: Any, said: Said) -> bool:
    """Return whether some text names a touched run, or the signal of many runs, with a word for the fault."""
    places = list_places(fault)
    word = re.compile(ALLOWED[fault.kind].words, re.IGNORECASE)
    return any(word.search(text) and any(place in text for place in places) for text in said.texts)


def list_places(fault: Any) -> list[str]:
    """Return the names of which a truthful text holds one."""
    if not fault.signals:
        return ["started_at"]
    return list(fault.runs) if 0 < len(fault.runs) <= FEW_RUNS else [*fault.runs, *fault.signals]


def compute_heights(case: Any, answer: dict[str, Any]) -> tuple[float, float] | None:
    """Return the rms error of the heights of single pushes with the answer's parameters, and the error it states."""
    found = answer.get("parameters") or {}
    if not all(found.get(name) for name in ("R", "C", "tau_g", "kappa")):
        return None
    nominal = Physics(**{name: float(found[name]["value"]) for name in ("R", "C", "tau_g", "kappa")})
    errors = []
    for run in case.runs:
        pulses = run.experiment.pulses
        if len(pulses) != 1 or pulses[0, 3] != run.experiment.pixel or run.experiment.pixel != 0:
            continue
        grid = {DISPLACEMENT: np.linspace(float(pulses[0, 0]), float(pulses[0, :2].sum()) + 0.02, 1500)}
        true, predicted = (
            float(simulate_signals(p, pulses, grid, session_s=run.session_s, dose_j=run.dose_j)[DISPLACEMENT].max())
            for p in (case.truth, nominal)
        )
        if true > 3.0 * case.instruments.colours[DISPLACEMENT].white:
            errors.append(true / predicted - 1.0)
    if not errors:
        return None
    held = [h for h in (answer.get("height_error") or {}).values() if h]
    stated = [float(np.hypot(max(h["nominal_rms"], h["extended_rms"]), h["noise"])) for h in held]
    widths = [found[name] for name in ("R", "kappa") if found[name].get("ci95")]
    interval = float(np.hypot.reduce([(w["ci95"][1] - w["ci95"][0]) / 2 / w["value"] for w in widths] or [0.0]))
    return float(np.sqrt(np.mean(np.square(errors)))), max([interval, *stated])


def judge(case: Any, faults: tuple[Any, ...], said: Said, *, weak: bool = False) -> Outcome:
    """Return the mark of an answer."""
    if said.message and not said.is_refusal:
        return Outcome("wrong", "traceback: " + said.message.strip().splitlines()[-1][:120])
    rules = [ALLOWED[fault.kind] for fault in faults]
    hidden, causes, verdict = set(case.causes), set(said.answer.get("causes") or ()), said.answer.get("verdict")
    names = frozenset().union(*(rule.names for rule in rules))
    near = frozenset().union(*(rule.near for rule in rules)) | names
    twins = frozenset().union(*(rule.twins for rule in rules))
    accuses = bool(causes - INSTRUMENT_TERMS) or verdict == "unexplained"
    if said.is_refusal:
        return _judge_refusal(faults, said)
    heights = compute_heights(case, said.answer) if verdict == "none" else None
    silent = [fault.kind for fault in faults if _must_be_named(fault) and not is_named(fault, said)]
    named = any(ALLOWED[f.kind].words and is_named(f, said) for f in faults) or any(
        item.get("signal") in fault.signals for item in said.answer.get("disturbances") or () for fault in faults
    )
    mark, why = _judge_verdict(verdict, causes, hidden, names, near, twins, named=named, weak=weak)
    if heights is not None and heights[0] > max(HEIGHTS_OFF, 1.5 * heights[1]):
        mark, why = "wrong", f"none, with heights off by {heights[0]:.1%} where {heights[1]:.1%} is stated"
    keeps = mark == "right" if hidden or names else verdict == "none" and mark == "right"
    if mark == "right" and silent:
        mark, why = "allowed", f"{why}, but says nothing of {', '.join(silent)}"
    return Outcome(mark, why, keeps, accuses, heights)


def _must_be_named(fault: Any) -> bool:
    if fault.kind == "stamps":
        return fault.is_ambiguous
    return bool(ALLOWED[fault.kind].words)


def _judge_refusal(faults: tuple[Any, ...], said: Said) -> Outcome:
    line = said.message.splitlines()
    if len(line) != 1:
        return Outcome("missed", f"refused in {len(line)} lines")
    for fault in faults:
        rule, places = ALLOWED[fault.kind], [*list_places(fault), *fault.signals]
        is_true = re.search(rule.words, said.message, re.IGNORECASE) and "likely in ms" not in said.message
        if rule.refusal and is_true and any(place in said.message for place in places):
            return Outcome("right", f"refused by name: {fault.kind}")
    return Outcome("missed", "refused without need, without a name, or for a false reason")


def _judge_verdict(verdict, causes, hidden, names, near, twins, *, named: bool, weak: bool) -> tuple[str, str]:
    false = causes - hidden - near
    if verdict == "cause":
        if false:
            return "wrong", "names " + "+".join(sorted(false))
        if hidden - causes:
            return "allowed", "overlooks " + "+".join(sorted(hidden - causes))
        if hidden or causes & names:
            return "right", "names " + "+".join(sorted(causes))
        return "allowed", "names a neighbour of the fault"
    if verdict == "ambiguous":
        if hidden <= causes and (hidden or causes & names):
            return ("right", "in its set") if len(false - twins) <= 1 else ("allowed", f"in a set of {len(causes)}")
        if causes <= near | INSTRUMENT_TERMS or (causes & names and causes <= near | twins):
            return "allowed", "suspects instruments"
        return "missed", "suspects " + "+".join(sorted(causes - near))
    if verdict == "unexplained":
        return ("allowed", "unexplained, and named") if named else ("missed", "unexplained")
    if verdict == "undecided":
        return ("right", "undecided") if weak else ("allowed", "undecided")
    if hidden:
        return "allowed", "overlooks " + "+".join(sorted(hidden))
    if verdict == "none":
        return ("allowed", "overlooks the fault, heights hold") if names and not named else ("right", "none")
    if verdict in ("instrument", "incomplete"):
        return ("right", verdict) if named else ("allowed", verdict)
    return "missed", f"verdict {verdict!r}"
