"""The report of a study: results by participant and of the group, as numbers, as lines and as one HTML page."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from math import exp, log
from typing import Any

import numpy as np

from optodrive.core.document import Document, Figure, Markup, Section, Table, to_json
from optodrive.core.provenance import Provenance
from optodrive.core.svg_plot import Axis, Series, draw_plot
from optodrive.study.results import Accuracy
from optodrive.study.trial_table import (
    MISSING,
    GroupMean,
    ThresholdResult,
    Trial,
    TrialTable,
    compute_group_mean,
    count_correct,
)

CURVES_MAX = 60
"""Largest number of curves that are drawn; all are in the table."""
CURVE_POINTS = 60
PLOT_HEIGHT = 230


class StudyResults:
    """Results of one task.

    thresholds: by participant, session and block; magnitudes: geometric means by participant and level
    """

    def __init__(self, table: TrialTable) -> None:
        self.table = table
        self.participants = [table.judge_participant(name) for name in table.participants]
        self.thresholds = list(table.list_thresholds())
        self.magnitudes = dict(_list_magnitudes(table))
        shares = [one.accuracy.share for one in self.participants if one.accuracy is not None]
        self.accuracy = compute_group_mean(shares) if shares else None
        if self.accuracy is not None and self.accuracy.low is not None and self.accuracy.high is not None:
            low, high = max(self.accuracy.low, 0.0), min(self.accuracy.high, 1.0)
            self.accuracy = self.accuracy._replace(low=low, high=high)

    @property
    def group_thresholds(self) -> dict[str, GroupMean]:
        """Geometric mean of the participants' thresholds in each block, '' of a single one. Bounds do not enter."""
        values: dict[str, dict[str, list[float]]] = {}
        for one in self.thresholds:
            level = one.equality if one.estimate is None else one.estimate.threshold
            if level is not None:
                values.setdefault(one.block, {}).setdefault(one.participant, []).append(log(level))
        found = {}
        for block, people in values.items():
            mean = compute_group_mean([float(np.mean(each)) for each in people.values()])
            low, high = (None if end is None else exp(end) for end in (mean.low, mean.high))
            found[block] = GroupMean(exp(mean.mean), low, high, mean.participants)
        return found

    def to_document(self) -> dict[str, Any]:
        """Return the results as JSON values."""
        table = self.table
        participants = {
            one.participant: {
                "counts": one.counts,
                "accuracy": _describe_accuracy(one.accuracy),
                "catch_trials": _describe_accuracy(one.catch),
                "median_response_time_s": one.response_time_s,
                "flags": list(one.flags),
            }
            for one in self.participants
        }
        thresholds = [
            {
                "participant": one.participant,
                "session": one.session or None,
                "block": one.block or None,
                **({} if one.estimate is None else one.estimate._asdict()),
                **({} if one.equality is None else {"equality": one.equality}),
            }
            for one in self.thresholds
        ]
        confusion = (
            {"answers": table.answers, "counts": table.count_confusions(table.main)} if self._is_choice else None
        )
        return dict(
            to_json(
                {
                    "task": table.task,
                    "guess_rate": table.guess_rate,
                    "level": table.analysis["Level"],
                    "participants": participants,
                    "thresholds": thresholds,
                    "confusion": confusion,
                    "magnitudes": self.magnitudes,
                    "group": {
                        "accuracy": None if self.accuracy is None else self.accuracy._asdict(),
                        "thresholds": {block: mean._asdict() for block, mean in self.group_thresholds.items()},
                    },
                    "execution": _describe_execution(table.trials),
                }
            )
        )

    @property
    def _is_choice(self) -> bool:
        return len(self.table.answers) > 1 and bool(self.table.correct_answers)

    def list_lines(self) -> Iterator[str]:
        """Yield the lines of a person's summary, the headline first."""
        table, counts = self.table, [one.counts for one in self.participants]
        total = {kind: sum(each[kind] for each in counts) for kind in counts[0]}
        yield f"{table.task}: {len(counts)} participants, {total['main']} trials"
        left = ", ".join(f"{number} {kind}" for kind, number in total.items() if kind != "main" and number)
        if left:
            yield f"- Do not enter: {left}."
        if self.accuracy is not None:
            chance = "" if table.guess_rate is None else f" (by guessing {100 * table.guess_rate:.1f} %)"
            yield f"- Correct answers: {_format_mean(self.accuracy, 100.0, ' %')}{chance}."
        for block, mean in self.group_thresholds.items():
            yield f"- {self._name_level()}{block and f', {block}'}: {_format_mean(mean, 1.0, '')}."
        if bounds := sum(one.estimate is not None and one.estimate.threshold is None for one in self.thresholds):
            yield f"- {bounds} of {len(self.thresholds)} thresholds are bounds or not determined, and do not enter."
        yield from (f"- {name} is flagged {flag}: {flag.explanation}." for name, flag in self._list_flags())

    def _name_level(self) -> str:
        word = "Equality" if self.table.analysis["EqualInterval"] else "Threshold"
        return f"{word} of {self.table.analysis['Level']}"

    def _list_flags(self) -> Iterator[tuple[str, Any]]:
        for person in self.participants:
            yield from ((person.participant, flag) for flag in person.flags)
        for one in self.thresholds:
            known = next(person.flags for person in self.participants if person.participant == one.participant)
            flags = () if one.estimate is None else one.estimate.flags
            yield from ((_name(one), flag) for flag in flags if flag not in known)

    def to_html(self, provenance: Provenance | None = None) -> str:
        """Return the report as one HTML page."""
        table = self.table
        sections = [Section("Participants", [self._build_participants()])]
        if self.thresholds:
            sections.append(Section(f"{self._name_level()} by participant", self._build_thresholds()))
        if self._is_choice and len(table.correct_answers) > 1:
            text = "Number of main trials of all participants. Rows: the correct answer; columns: the answer given."
            sections.append(Section("Confusions", [text, self._build_confusions()]))
        factors = [name for name in table.analysis["Factors"] if any(name in trial.cells for trial in table.main)]
        if table.answers and factors:
            text = "Number of main trials of all participants with each answer, and the share that is correct."
            sections.append(Section("Answers by factor", [text, *(self._build_factor(name) for name in factors)]))
        if self.magnitudes:
            sections.append(Section("Magnitudes", self._build_magnitudes()))
        sections.append(Section("Stimuli as requested and as executed", [self._build_execution()]))
        title = str(table.description.get("TaskDescription", table.task))
        verdict = "flagged" if any(self._list_flags()) else "results"
        if provenance is not None:
            origin = [(name, Markup(f"<code>{escape(text)}</code>")) for name, text in provenance.to_rows()]
            rows = [row for row in origin if row[0] != "configuration"]
            sections.append(Section("Provenance", [Table("Provenance", ("entry", "value"), rows)]))
        return Document(title, verdict, list(self.list_lines()), sections).to_html()

    def _build_participants(self) -> Table:
        rows = [
            (
                one.participant,
                *(str(one.counts[kind]) for kind in ("main", "practice", "catch", "excluded")),
                *_format_accuracy(one.accuracy),
                "" if one.catch is None else f"{one.catch.correct} of {one.catch.trials}",
                "" if one.response_time_s is None else f"{one.response_time_s:.2f} s",
                ", ".join(one.flags),
            )
            for one in self.participants
        ]
        head = ["participant", "trials", "practice", "catch", "excluded", "correct", "95 % interval"]
        head += ["catch correct", "median time", "flags"]
        return Table("Participants", head, rows, range(1, 9))

    def _build_thresholds(self) -> Iterator[str | Table | Sequence[Figure]]:
        yield (
            "Only main trials enter. A threshold is a number within the tested levels only; an interval that the "
            "levels do not close is open, and a threshold beyond them is a bound."
        )
        rows = [
            (
                _name(one),
                str(len(one.answered)),
                f"{one.equality:.3g}" if one.estimate is None else str(one.estimate),
                "" if one.estimate is None else ", ".join(one.estimate.flags),
            )
            for one in self.thresholds
        ]
        yield Table("Thresholds", ("participant", "trials", str(self.table.analysis["Level"]), "flags"), rows, {1})
        yield [self._draw_curve(one) for one in self.thresholds[:CURVES_MAX]]
        if len(self.thresholds) > CURVES_MAX:
            yield f"The first {CURVES_MAX} of {len(self.thresholds)} curves are drawn."

    def _draw_curve(self, one: ThresholdResult) -> Figure:
        levels, level_name = self.table.levels, str(self.table.analysis["Level"])
        trials, correct = np.zeros(len(levels)), np.zeros(len(levels))
        for level, is_correct in one.answered:
            trials[level] += 1.0
            correct[level] += is_correct
        x = np.union1d(np.geomspace(levels[0], levels[-1], CURVE_POINTS), np.array(levels))
        shares = np.full(len(x), np.nan)
        at = np.searchsorted(x, np.array(levels))
        shares[at] = np.divide(correct, trials, out=np.full(len(levels), np.nan), where=trials > 0.0)
        series = [Series(shares, "measured", is_dotted=True)]
        estimate = one.estimate
        if estimate is not None and estimate.threshold is not None:
            series.append(Series(self.table.model.compute_curve(one.answered, x.tolist()), "extended"))
        axis = Axis("share named" if estimate is None else "share correct", "")
        plot = draw_plot(
            f"{_name(one)}: {axis.quantity} by {level_name}",
            x,
            Axis(level_name, "", 0.0, True),
            axis,
            series,
            PLOT_HEIGHT,
        )
        found = f"{one.equality:.3g}" if estimate is None else str(estimate)
        flags = "" if estimate is None or not estimate.flags else f"; flagged {', '.join(estimate.flags)}"
        return Figure(plot, f"{_name(one)}: {level_name} {found}, {len(one.answered)} trials{flags}")

    def _build_confusions(self) -> Table:
        table = self.table
        matrix = table.count_confusions(table.main)
        rows = [
            (answer, *(f"{count:.0f}" for count in row), f"{100.0 * row[k] / max(row.sum(), 1.0):.0f} %")
            for k, (answer, row) in enumerate(zip(table.answers, matrix, strict=True))
            if row.sum()
        ]
        head = ("correct answer", *table.answers, "correct")
        return Table("Confusions", head, rows, range(1, len(head)))

    def _build_factor(self, factor: str) -> Table:
        table, rows = self.table, []
        levels = dict.fromkeys(trial.cells.get(factor, MISSING) for trial in table.main)
        for level, _ in sorted(levels.items(), key=_sort_level):
            own = [trial for trial in table.main if trial.cells.get(factor, MISSING) == level]
            answers = Counter(trial.cells["answer"] for trial in own)
            accuracy = count_correct(own)
            rows.append((level, *(str(answers[each]) for each in table.answers), *_format_accuracy(accuracy)))
        head = (factor, *table.answers, "correct", "95 % interval")
        return Table(f"Answers by {factor}", head, rows, range(1, len(head)))

    def _build_magnitudes(self) -> Iterator[str | Table]:
        yield "Geometric mean of a participant's answers by level, divided by that of all levels."
        levels = list(next(iter(self.magnitudes.values())))
        rows = [
            (name, *(f"{means[level]:.3g}" if level in means else "" for level in levels))
            for name, means in self.magnitudes.items()
        ]
        yield Table("Magnitudes", ("participant", *levels), rows, range(1, 1 + len(levels)))

    def _build_execution(self) -> Table:
        rows = [
            (name.replace("_", " "), text) for name, text in _format_execution(_describe_execution(self.table.trials))
        ]
        return Table("Stimuli", ("quantity", "value"), rows, {1})


def _list_magnitudes(table: TrialTable) -> Iterator[tuple[str, dict[str, float]]]:
    """Yield each participant's relative geometric mean of numeric answers by the levels of the first factor."""
    factor = next(iter(table.analysis["Factors"]), None)
    if table.answers or factor is None:
        return
    for participant in table.participants:
        logs: dict[str, list[float]] = {}
        for trial in table.main:
            answer = trial.read_number("answer")
            if trial.participant == participant and answer is not None and answer > 0.0:
                logs.setdefault(trial.cells[factor], []).append(log(answer))
        if logs:
            means = {level: float(np.mean(values)) for level, values in sorted(logs.items(), key=_sort_level)}
            grand = float(np.mean(list(means.values())))
            yield participant, {level: exp(mean - grand) for level, mean in means.items()}


def _sort_level(item: tuple[str, object]) -> tuple[float, str]:
    try:
        return float(item[0]), ""
    except ValueError:
        return float("inf"), item[0]


def _name(one: ThresholdResult) -> str:
    return " ".join(filter(None, (one.participant, one.session and f"session {one.session}", one.block)))


def _describe_accuracy(accuracy: Accuracy | None) -> dict[str, Any] | None:
    if accuracy is None:
        return None
    return {**accuracy._asdict(), "share": accuracy.share, "interval": list(accuracy.interval)}


def _format_accuracy(accuracy: Accuracy | None) -> tuple[str, str]:
    if accuracy is None:
        return "", ""
    low, high = accuracy.interval
    share = f"{accuracy.correct} of {accuracy.trials}, {100 * accuracy.share:.1f} %"
    return share, f"{100 * low:.1f} to {100 * high:.1f} %"


def _format_mean(mean: GroupMean, factor: float, unit: str) -> str:
    text = f"{factor * mean.mean:.4g}{unit}, mean of {mean.participants} participants"
    if mean.low is None or mean.high is None:
        return text
    return f"{text} (95 % interval {factor * mean.low:.4g} to {factor * mean.high:.4g}{unit})"


def _describe_execution(trials: Sequence[Trial]) -> dict[str, Any]:
    """Return the largest differences between requested and executed times, and the range of height ratios."""

    def list_pairs(executed: str, requested: str) -> Iterator[tuple[float, float]]:
        for trial in trials:
            pair = trial.read_number(executed), trial.read_number(requested)
            if pair[0] is not None and pair[1] is not None:
                yield pair[0], pair[1]

    onsets = [abs(a - b) for a, b in list_pairs("stimulus_onset", "requested_onset")]
    durations = [abs(a - b) for a, b in list_pairs("stimulus_duration", "requested_duration")]
    ratios = [a / b for a, b in list_pairs("stimulus_height", "requested_height") if b > 0.0]
    heights_um = [height for trial in trials if (height := trial.read_number("stimulus_height")) is not None]
    return {
        "onset_error_max_s": max(onsets, default=None),
        "duration_error_max_s": max(durations, default=None),
        "height_ratio_min": min(ratios, default=None),
        "height_ratio_max": max(ratios, default=None),
        "height_min_um": min(heights_um, default=None),
        "height_max_um": max(heights_um, default=None),
    }


def _format_execution(found: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    for name, value in found.items():
        stem, _, unit = name.rpartition("_")
        if value is None:
            yield name, "not recorded"
        elif unit == "s":
            yield stem, f"{1e6 * value:.1f} µs"
        elif unit == "um":
            yield stem, f"{value:.1f} µm"
        else:
            yield name, f"{value:.4f}"
