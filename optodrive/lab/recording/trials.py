"""Trials of a session: every plan with its labels, requested and executed onset, and outcome."""

import csv
import json
import re
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any

from optodrive.core.errors import InputError, Unquoted
from optodrive.core.numeric_tables import escape_formula
from optodrive.lab.recording.hdf5 import Hdf5Tree
from optodrive.lab.recording.reader import open_tree
from optodrive.lab.recording.storage import PLAN_TABLES, PLAN_TEXTS, Attributes, convert_errors, natural_sort_key

CLOCKS = ("board_s", "monotonic_s", "unix_s")
"""Clocks of an onset: the board's, the host's monotonic one, and Unix time."""
KINDS = ("requested", "executed")
TIME_MAX_S = 1e11
LABEL_PREFIX = "label_"
SURROGATE = re.compile("[\ud800-\udfff]")


@dataclass(frozen=True)
class Trial:
    """One plan of a session.

    status: as in a plan's report, with the error, if any; run: of the recording, empty without a pulse; labels: of the
    caller; parameters: of the pattern; requested, executed: onset by clock, s, None where it is not known; requested is
    the earliest time that the request stated
    """

    plan: str
    name: str
    run: str
    status: str
    error: str
    labels: dict[str, Any]
    parameters: dict[str, Any]
    requested: dict[str, float | None]
    executed: dict[str, float | None]
    planned_pulses: int
    executed_pulses: int


def read_trials(path: Path) -> list[Trial]:
    """Read the trials of a session in their order. Raise InputError if the file is none of a session."""
    trials = read_trials_if_any(path)
    if not trials:
        expected = "the file of a session with at least one ended plan, output of `serve --record-session`"
        raise InputError(str(path), Unquoted("no plans"), expected)
    return trials


def read_trials_if_any(path: Path) -> list[Trial]:
    """Read the trials of a recording. Return none if it is not of a session."""
    with open_tree(path) as tree, convert_errors(str(path), "a readable session"):
        if not isinstance(tree, Hdf5Tree):
            return []
        return [_read_trial(tree, path, plan) for plan in sorted(tree.list_plans(), key=natural_sort_key)]


def format_csv(trials: list[Trial]) -> str:
    """Return a table with one row per trial and one column per label, of which a spreadsheet runs nothing."""
    keys = list(dict.fromkeys(key for trial in trials for key in trial.labels))
    onsets = [f"{kind}_{clock}" for kind in KINDS for clock in CLOCKS]
    head = ["plan", "name", "run", "status", "error", *onsets, "planned_pulses", "executed_pulses"]
    out = StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow([*head, *(LABEL_PREFIX + key for key in keys)])
    for trial in trials:
        times = [onset[clock] for onset in (trial.requested, trial.executed) for clock in CLOCKS]
        cells = [trial.plan, trial.name, trial.run, trial.status, trial.error, *times]
        labels = [json.dumps(value) if isinstance(value := trial.labels.get(key), bool) else value for key in keys]
        writer.writerow(map(escape_formula, [*cells, trial.planned_pulses, trial.executed_pulses, *labels]))
    return out.getvalue()


def _read_trial(tree: Hdf5Tree, path: Path, plan: str) -> Trial:
    place = f"{path}: /plans/{plan}"
    attributes, texts, tables = tree.read_plan(plan)
    name, run, status, error = (str(attributes.get(key, "")) for key in ("name", "run", "status", "error"))
    labels, parameters = (_read_object(f"{place}/{key}", texts.get(key, "{}")) for key in PLAN_TEXTS)
    requested, executed = (
        {clock: _read_time_s(place, attributes, f"{kind}_{clock}") for clock in CLOCKS} for kind in KINDS
    )
    counts = (len(tables.get(key, ())) for key in PLAN_TABLES)
    return Trial(plan, name, run, status, error, labels, parameters, requested, executed, *counts)


def _read_time_s(place: str, attributes: Attributes, name: str) -> float | None:
    value = attributes.get(name)
    if value is None:
        return None
    if isinstance(value, str) or not abs(value) <= TIME_MAX_S:
        raise InputError(f"{place}/{name}", value, f"a time up to {TIME_MAX_S:g} s")
    return float(value)


def _read_object(place: str, text: str) -> dict[str, Any]:
    with convert_errors(place, "one JSON object"):
        value = json.loads(text, parse_constant=lambda name: _refuse_constant(place, name))
        if SURROGATE.search(json.dumps(value, ensure_ascii=False)):
            raise InputError(place, Unquoted("half of a surrogate pair"), "Unicode text, which a file can hold")
        if not isinstance(value, dict):
            raise InputError(place, Unquoted(f"a {type(value).__name__}"), "one JSON object")
        return value


def _refuse_constant(place: str, name: str) -> None:
    raise InputError(place, Unquoted(name), "finite numbers")
