"""Judge of the diagnosis's answers: claims by the answers' own residuals, and sentences by the numbers beside them.

It shares no code with the diagnosis, whose text and JSON it reads. Noise is that of the residuals of the better model,
and of the repeats.
"""

import json
import re
from dataclasses import dataclass
from math import isfinite

import numpy as np

from optodrive.lab.diagnosis.narrative import build_answer, build_narrative
from optodrive.physics.terms import discover_terms

EXPLAINED_MIN = 0.5
WORSE_SIGMA = 5.0
"""Increase of a held-out signal's squared error that is beyond noise, in σ of a rougher estimate than the diagnosis's:
it knows neither the colours of the noise nor the jitters of single runs."""


@dataclass(frozen=True)
class Change:
    """Squared errors of one signal of a group with both models, in squares of the noise of a sample.

    noise: standard deviation of the extended one's minus the nominal one's, by the residuals of the better model;
    repeat_noise: the same by repeats, in which no model has a part; floor: expected square of noise alone, with its
    standard deviation in floor_noise
    """

    group: str
    signal: str
    nominal: float
    extended: float
    noise: float
    repeat_noise: float
    floor: float
    floor_noise: float

    @property
    def sigma(self):
        return (self.extended - self.nominal) / max(self.noise, self.repeat_noise, 1e-9)


def measure_changes(traces, measurement):
    """Return the changes of traces, but for errors of gain and zero, in which the runs of one experiment differ."""
    changes = []
    for trace in traces:
        remove = build_projection(trace)
        nominal, extended = remove(trace.nominal), remove(trace.extended)
        step = nominal - extended
        floor, spread = compare_repeats(trace, step, remove, measurement)
        better = min(nominal, extended, key=lambda each: float(each @ each))
        noises = (2.0 * each**0.5 for each in (compute_variance(step, better), spread))
        squares = (float(each @ each) for each in (nominal, extended))
        # Of coloured noise, about one sample in four is independent; that of the trace itself adds to the repeats'.
        floor_noise = 2.0 * floor * (2.0 / max(len(step) / 4.0, 1.0)) ** 0.5
        changes.append(Change(trace.group, trace.signal, *squares, *noises, floor, floor_noise))
    return changes


def build_projection(trace):
    """Return a function that takes from [t] what is proportional to the rise of a trace, or constant."""
    columns = np.column_stack([np.ones(len(trace.measured)), trace.measured - trace.measured[:3].mean()])
    directions, _ = np.linalg.qr(columns)
    return lambda values: values - directions @ (directions.T @ values)


def compute_variance(step, residual):
    """Return the variance of step · noise, with the autocovariance of a residual, whose far lags are tapered."""
    count = len(residual)
    lags = min(count, max(2, count // 4))
    full = np.correlate(residual, residual, "full")[count - 1 : count - 1 + lags] / count
    steps = np.correlate(step, step, "full")[count - 1 : count - 1 + lags]
    taper = 1.0 - np.arange(lags) / lags
    terms = full * steps * taper
    return max(float(terms[0] + 2.0 * terms[1:].sum()), float(terms[0]))


def compare_repeats(trace, step, remove, measurement):
    """Return the sum of squares of noise in a trace, and the variance of step · noise, by the repeats of its run."""
    middle = 0.5 * (trace.t_s[1:] + trace.t_s[:-1])
    edges = np.concatenate([[-np.inf], middle, [np.inf]])
    rows = []
    for run in measurement.runs:
        if run.attributes.get("group") == trace.group and trace.signal in run.signals:
            signal = run.signals[trace.signal]
            is_there = np.isfinite(signal.value)
            place = np.searchsorted(edges, signal.t_s[is_there]) - 1
            count = np.bincount(place, minlength=len(trace.t_s))
            total = np.bincount(place, signal.value[is_there], minlength=len(trace.t_s))
            rows.append(np.where(count > 0, total / np.maximum(count, 1), np.nan))
    table = np.array(rows) / trace.sigma
    if len(rows) < 2:
        return 0.0, 0.0
    off = table - np.nanmean(table, axis=0)
    off = np.array([remove(np.where(np.isfinite(row), row, 0.0)) for row in off])
    projected = off @ step
    return float(np.sum(off**2)) / (len(rows) - 1), float(projected @ projected) / (len(rows) - 1)


def list_faults_of_claim(found, measurement):
    """Return why a verdict `cause` is contradicted by the answer's own residuals, in sentences, none if it is."""
    if found.verdict != "cause":
        return []
    faults = []
    for change in measure_changes(found.held_out_traces, measurement):
        if change.sigma > WORSE_SIGMA:
            faults.append(f"{change.signal} of {change.group} is worse by {change.sigma:.1f} σ")
    acting = [t for t in found.residual_traces if np.any(t.nominal != t.extended)]
    places = {trace.signal.startswith("mirror") for trace in acting}
    changes = measure_changes(
        [t for t in found.residual_traces if t.signal.startswith("mirror") in places], measurement
    )
    gained = sum(change.nominal - change.extended for change in changes)
    excess = sum(max(change.nominal - change.floor, 0.0) for change in changes)
    noise = sum((change.repeat_noise or change.noise) ** 2 for change in changes) ** 0.5
    excess_noise = sum(change.floor_noise**2 for change in changes) ** 0.5
    if gained < EXPLAINED_MIN * excess - WORSE_SIGMA * np.hypot(noise, EXPLAINED_MIN * excess_noise):
        faults.append(f"{' and '.join(found.causes)} explains {gained:.0f} ± {noise:.0f} of {excess:.0f}")
    return faults


TOPICS = {
    "Probabilities:": ("probabilities",),
    "This explains": ("explained_fraction",),
    "Heights planned": ("height_error",),
    "Visible in": ("visible",),
    "On ": ("gain", "runs"),
    "Measure next:": ("next_experiment",),
}
"""First words of a line, and the keys of JSON whose numbers it may state."""
NUMBER = re.compile(
    r"(?P<sign>[<>] )?(?<![\w.])(?P<value>\d+(?:\.\d+)?)(?:×10(?P<power>[⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+))?(?!/)"
    r" ?(?P<unit>%|[A-Za-zµΩ]+)?"
)
PLAIN = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")
PREFIXES = {"p": 1e12, "n": 1e9, "µ": 1e6, "m": 1e3, "k": 1e-3, "M": 1e-6}
STATIC_TEXTS = tuple(
    text for term in discover_terms().values() for text in (term.label, term.signature, term.remedy or "")
)
"""Texts with numbers that all answers share."""
BOUNDS = ("< 0.1", "> 99.9")
"""How probabilities near 0 and 1 are given, in percent."""
CONSTANTS = ("95 %", "repeated up to 30 times")


def list_leaves(value):
    """Return the numbers, the lengths of lists and the strings of JSON values."""
    if isinstance(value, dict):
        return [leaf for key, item in value.items() for leaf in (key, *list_leaves(item))]
    if isinstance(value, list):
        return [len(value), *(leaf for item in value for leaf in list_leaves(item))]
    return [] if value is None or isinstance(value, bool) else [value]


def select_topic(line, answer):
    for start, keys in TOPICS.items():
        if line.startswith(start):
            return [answer.get(key) for key in keys]
    name, is_parameter, _ = line.strip().partition(" = ")
    if is_parameter and name in answer["parameters"]:
        return answer["parameters"][name]
    if answer["gain"] and re.match(r"  \w+: RMSE", line):
        return answer["gain"]
    return answer


def is_stated(match, numbers):
    """Return whether a number of a text is one of these, in a unit with a prefix or in percent."""
    text, unit = match["value"], match["unit"] or ""
    scale = 100.0 if unit == "%" else 1.0
    if match["sign"]:
        bound = float(text) / scale
        return match["sign"] + text in BOUNDS and any((n < bound) == (match["sign"] == "< ") for n in numbers)
    scales = [scale, *([PREFIXES[unit[0]]] if len(unit) > 1 and unit[0] in PREFIXES else [])]
    power = 10.0 ** int((match["power"] or "0").translate(PLAIN))
    half = 0.5000001 * 10.0 ** -len(text.partition(".")[2]) * power
    if "." not in text and len(text) > 3:
        half *= 10.0 ** (len(text) - 3)  # three digits
    return any(abs(abs(n) * each - float(text) * power) <= half for n in numbers for each in scales)


def list_faults_of_text(lines, answer, known=()):
    """Return the numbers of an answer's lines that its JSON does not state. known: texts that all answers share."""
    answer = json.loads(json.dumps(answer))
    leaves = (*list_leaves(answer), *known)
    texts = {leaf for leaf in leaves if isinstance(leaf, str) and len(leaf) > 5 and re.search(r"\d", leaf)}
    faults = []
    for line in lines:
        numbers = [n for n in list_leaves(select_topic(line, answer)) if not isinstance(n, str) and isfinite(n)]
        rest = line
        for text in sorted((*texts, *CONSTANTS), key=len, reverse=True):
            rest = rest.replace(text, " ")
        faults += [f"{match[0]!r} in {line!r}" for match in NUMBER.finditer(rest) if not is_stated(match, numbers)]
    return faults


def list_faults(found, measurement):
    """Return what is wrong with an answer: its claim by its residuals, and its text by its JSON."""
    text = list_faults_of_text(build_narrative(found), build_answer(found), STATIC_TEXTS)
    return [*list_faults_of_claim(found, measurement), *text]
