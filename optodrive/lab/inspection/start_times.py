"""Start times of runs, as spreadsheets, loggers and programs write them.

Theory of operation

Only the differences between runs matter, so a time without zone is read as UTC, never in the zone of this computer,
whose clock may jump between two runs. A date whose day and month can be exchanged is read from the others of the same
recording; where they leave both orders open and the differences depend on it, the recording is refused.
"""

import itertools
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, tzinfo
from typing import ClassVar
from zoneinfo import ZoneInfo

import numpy as np
from dateutil.parser import parse, parserinfo

from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.measurements import DataFinding, Run

ATTRIBUTE, ZONE_ATTRIBUTES = "started_at", ("timezone", "time_zone", "tz")
KIND = "started_at"
ZONES_H = {"Z": 0, "UTC": 0, "GMT": 0, "CET": 1, "MEZ": 1, "CEST": 2, "MESZ": 2, "BST": 1, "EST": -5, "EDT": -4}
ZONES_H |= {"PST": -8, "PDT": -7, "JST": 9, "KST": 9}


class _Info(parserinfo):  # type: ignore[misc]  # dateutil states no types
    """Names of months, with the German ones."""

    MONTHS: ClassVar = [
        *[("Jan", "January", "Januar"), ("Feb", "February", "Februar"), ("Mar", "March", "Mär", "März", "Mrz")],
        *[("Apr", "April"), ("May", "Mai"), ("Jun", "June", "Juni"), ("Jul", "July", "Juli"), ("Aug", "August")],
        *[("Sep", "Sept", "September"), ("Oct", "October", "Okt", "Oktober"), ("Nov", "November")],
        ("Dec", "December", "Dez", "Dezember"),
    ]


INFO = _Info()
DOTTED_CLOCK = re.compile(r"(?<= )\d{1,2}\.\d\d(?:\.\d\d)?$")
EPOCHS = (
    (1e8, 3.2e9, 1.0, 0.0, "Unix time in s"),
    (3.2e9, 4.6e9, 1.0, -2_082_844_800.0, "seconds since 1904"),
    (1e11, 1e13, 1e-3, 0.0, "Unix time in ms"),
    (1e14, 1e16, 1e-6, 0.0, "Unix time in µs"),
    (1e17, 1e19, 1e-9, 0.0, "Unix time in ns"),
    (30_000.0, 80_000.0, 86_400.0, -25_569.0 * 86_400.0, "a spreadsheet's days since 1899-12-30"),
    (700_000.0, 800_000.0, 86_400.0, -719_529.0 * 86_400.0, "days since the year 0"),
    (0.0, 1e8, 1.0, 0.0, "seconds since any instant"),
)
"""Smallest and largest number, seconds of one, Unix time of 0, s, and what the numbers are."""
HOUR_S, SUNDAY, LARGEST_NUMBER = 3600.0, 6, 1e30


@dataclass(frozen=True)
class _Stamp:
    """Start time as written.

    swapped: with day and month exchanged, where both orders are possible
    """

    when: datetime
    zone: tzinfo | None
    swapped: datetime | None = None
    is_day_first: bool | None = None
    has_seconds: bool = True
    has_date: bool = True


@dataclass(frozen=True, eq=False)
class StartTimes:
    """Start times of runs.

    seconds: [n] since any instant, or None where the order of the runs has to replace them
    """

    seconds: FloatArray | None
    findings: tuple[DataFinding, ...]


def read_start_times(runs: tuple[Run, ...]) -> StartTimes:
    """Read the start times of the runs, with their contradictions."""
    stated = [run for run in runs if ATTRIBUTE in run.attributes]
    if not stated:
        return StartTimes(None, ())
    if len(stated) < len(runs):
        missing = [run for run in runs if ATTRIBUTE not in run.attributes]
        text = f"{ATTRIBUTE} is stated in {len(stated)} of {len(runs)} runs; the order of their names replaces it."
        return StartTimes(None, (_note(missing, text),))
    values = [run.attributes[ATTRIBUTE] for run in runs]
    numbers = [_parse_number(value) for value in values]
    if all(number is not None for number in numbers):
        return _read_numbers(runs, np.array([number for number in numbers if number is not None]))
    stamps = [_parse_stamp(str(value)) for value in values]
    unreadable = [run for run, stamp in zip(runs, stamps, strict=True) if stamp is None]
    if unreadable:
        return _leave_unread(unreadable)
    return _combine(runs, [stamp for stamp in stamps if stamp is not None])


def _leave_unread(runs: Sequence[Run]) -> StartTimes:
    shown = str(runs[0].attributes[ATTRIBUTE])[:40]
    text = f"{ATTRIBUTE} {shown!r} cannot be read as a time; the order of the runs' names replaces it."
    return StartTimes(None, (_note(runs, text),))


def _refuse(runs: Iterable[Run], text: str) -> StartTimes:
    return StartTimes(None, (_note(runs, f"{ATTRIBUTE} {text}", "refused"),))


def _note(runs: Iterable[Run], text: str, action: str = "noted") -> DataFinding:
    return DataFinding(tuple(run.name for run in runs), "", KIND, text, action)


def _combine(runs: tuple[Run, ...], stamps: list[_Stamp]) -> StartTimes:
    """Decide the order of day and month and the zone, and return the times."""
    orders = {stamp.is_day_first for stamp in stamps} - {None}
    if len(orders) > 1:
        return _refuse(runs, "has the day first in some runs and the month first in others; write 2026-11-28T10:03:05.")
    open_runs = [run for run, stamp in zip(runs, stamps, strict=True) if stamp.swapped is not None]
    whens = [stamp.when for stamp in stamps]
    if open_runs and not orders:
        other = [stamp.swapped or stamp.when for stamp in stamps]
        if [when - whens[0] for when in whens] != [when - other[0] for when in other]:
            shown = str(open_runs[0].attributes[ATTRIBUTE])
            text = "day and month can be exchanged, in every run; write 2026-11-28T10:03:05."
            return _refuse(open_runs, f"{shown!r}: {text}")
    elif open_runs and orders == {False}:
        whens = [stamp.swapped or stamp.when for stamp in stamps]
    zones = [stamp.zone or _find_zone(run) for run, stamp in zip(runs, stamps, strict=True)]
    if len({zone is None for zone in zones}) > 1:
        without = [run for run, zone in zip(runs, zones, strict=True) if zone is None]
        return _refuse(without, "has a zone in some runs and none in others; state it in all of them.")
    seconds, repeated = [], []
    for run, when, zone in zip(runs, whens, zones, strict=True):
        early, late = (when.replace(tzinfo=zone or UTC, fold=fold).timestamp() for fold in (0, 1))
        if late > early:
            repeated.append(run)
        seconds.append(early)
    if repeated:
        shown = str(repeated[0].attributes[ATTRIBUTE])
        text = "occurs twice in its zone, where the clock was set back; state the offset, +01:00."
        return _refuse(repeated, f"{shown!r} {text}")
    times_s = np.array(seconds)
    if zones[0] is None and _is_set_back(whens):
        text = "goes back within an hour on a Sunday in autumn and states no zone; state the offset, +01:00."
        return _refuse(runs, text)
    resolution_s = 1.0 if all(stamp.has_seconds for stamp in stamps) else 60.0
    said = []
    if open_runs:
        text = "can be exchanged, which changes no time between runs"
        if orders:
            text = f"are told by the other runs: the {'month' if orders == {False} else 'day'} comes first"
        said.append(_note(open_runs, f"{ATTRIBUTE}: day and month {text}."))
    if not any(stamp.has_date for stamp in stamps):
        said.append(_note(runs, f"{ATTRIBUTE} states a time without a date; all runs are taken to be of one day."))
    return StartTimes(times_s, (*said, *_examine(runs, times_s, resolution_s)))


def _is_set_back(whens: list[datetime]) -> bool:
    """Return whether times in the order of the runs step back once, as clocks do on a Sunday in autumn."""
    steps_s = [(later - earlier).total_seconds() for earlier, later in itertools.pairwise(whens)]
    back = [at for at, step_s in enumerate(steps_s) if step_s < 0.0]
    is_once = len(back) == 1 and steps_s[back[0]] > -HOUR_S
    return is_once and whens[back[0]].weekday() == SUNDAY and whens[back[0]].month in (10, 11)


def _examine(runs: tuple[Run, ...], seconds: FloatArray, resolution_s: float) -> tuple[DataFinding, ...]:
    """Return contradictions with the order of the runs and with their durations."""
    found = []
    backwards = [later for later, step_s in zip(runs[1:], np.diff(seconds), strict=True) if step_s < 0.0]
    if len(runs) > 1 and not np.ptp(seconds):
        found.append(_note(runs, f"{ATTRIBUTE} is the same in all runs, so nothing can be said of their order."))
    elif backwards:
        text = f"{ATTRIBUTE} of {len(backwards)} runs is before that of the run that precedes it by name; times count."
        found.append(_note(backwards, text))
    order = np.argsort(seconds, kind="stable").tolist()
    ends_s = [max((float(signal.t_s[-1]) for signal in run.signals.values()), default=0.0) for run in runs]
    overlapping = [
        runs[later]
        for earlier, later in itertools.pairwise(order)
        if seconds[earlier] + ends_s[earlier] > seconds[later] + resolution_s
    ]
    if overlapping and np.ptp(seconds):
        text = f"{len(overlapping)} runs start before the one before them ends, by {ATTRIBUTE}: there is one beam."
        found.append(_note(overlapping, text))
    return tuple(found)


def _parse_number(value: str | float) -> float | None:
    if not isinstance(value, str):
        return float(value) if abs(value) < LARGEST_NUMBER else None
    text = value.strip()
    if not re.fullmatch(r"\d+(?:[.,]\d+)?", text) or re.fullmatch(r"(19|20)\d{6}(\d{6})?", text):
        return None
    return float(text.replace(",", "."))


def _read_numbers(runs: tuple[Run, ...], values: FloatArray) -> StartTimes:
    """Return Unix times of numbers that are all of one kind, or small ones as elapsed seconds."""
    for low, high, factor_s, zero_s, name in EPOCHS:
        if values.min() >= low and values.max() < high:
            seconds = np.asarray(values * factor_s + zero_s)
            said = _note(runs, f"{ATTRIBUTE} is read as {name}.")
            return StartTimes(seconds, (said, *_examine(runs, seconds, 1e-3)))
    return _leave_unread(runs)


def _parse_stamp(text: str) -> _Stamp | None:
    """Return a date and time, or a time of the day alone, None for anything else."""
    text = " ".join(re.sub(r'[_"()\[\]]', " ", text).split())
    text = DOTTED_CLOCK.sub(lambda match: match[0].replace(".", ":"), re.sub(r"(?:UTC|GMT)(?=[+-])", "", text))
    named = re.search(r"[A-Za-z]+/[\w/+-]+$", text)
    try:
        return _parse(text, None) if named is None else _parse(text[: named.start()], ZoneInfo(named[0]))
    except (ValueError, OverflowError, KeyError, OSError, TypeError):  # the last one for some texts of no meaning
        return None


def _parse(text: str, zone: tzinfo | None) -> _Stamp:
    when, has_date, has_seconds = _complete(text, day_first=not text[:4].isdigit())
    zone, when = when.tzinfo or zone, when.replace(tzinfo=None)
    numeric = re.match(r"(\d{1,2})([./-])(\d{1,2})\2", text)
    if numeric is None or numeric[2] == ".":  # written with points, the day comes first everywhere
        return _Stamp(when, zone, None, None if numeric is None else True, has_seconds, has_date)
    first, second = int(numeric[1]), int(numeric[3])
    if max(first, second) > 12:
        return _Stamp(when, zone, None, first > 12, has_seconds, has_date)
    swapped = _complete(text, day_first=False)[0].replace(tzinfo=None)
    return _Stamp(when, zone, swapped, None, has_seconds, has_date)


def _complete(text: str, day_first: bool) -> tuple[datetime, bool, bool]:
    """Return a time, whether its date is written, and whether its seconds are.

    What is not written differs with what is given for it. Raises ValueError where only a part of the date is written.
    """
    first, second = (
        parse(text, INFO, dayfirst=day_first, default=missing, tzinfos=_find_offset)
        for missing in (datetime(2000, 1, 1), datetime(2001, 2, 2, 1, 1, 1))
    )
    is_written = [getattr(first, name) == getattr(second, name) for name in ("year", "month", "day")]
    if any(is_written) and not all(is_written):
        raise ValueError(text)
    if not any(is_written) and first.hour != second.hour:
        raise ValueError(text)
    return first, all(is_written), first.second == second.second or first.hour != second.hour


def _find_offset(name: str | None, offset_s: int | None) -> int | None:
    """Return the seconds by which a zone is ahead of UTC, None without one. Raises KeyError for an unknown name."""
    return ZONES_H[name.upper()] * 3600 if offset_s is None and name is not None else offset_s


def _find_zone(run: Run) -> tzinfo | None:
    """Return the zone that a run states beside its start."""
    stated = next((str(run.attributes[name]) for name in ZONE_ATTRIBUTES if name in run.attributes), "")
    stamp = _parse_stamp(f"2000-01-01 0:00:00 {stated}")
    return None if stamp is None else stamp.zone
