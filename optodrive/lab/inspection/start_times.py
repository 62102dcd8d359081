"""Start times of runs, as spreadsheets, loggers and programs write them.

Theory of operation

Only the differences between runs matter, so a time without zone is read as UTC, never in the zone of this computer,
whose clock may jump between two runs. A date whose day and month can be exchanged is read from the others of the same
recording; where they leave both orders open and the differences depend on it, the recording is refused.
"""

import itertools
import re
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta, timezone, tzinfo
from zoneinfo import ZoneInfo

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.measurements import DataFinding, Run

ATTRIBUTE, ZONE_ATTRIBUTES = "started_at", ("timezone", "time_zone", "tz")
KIND = "started_at"
ZONES_H = {"Z": 0, "UTC": 0, "GMT": 0, "CET": 1, "MEZ": 1, "CEST": 2, "MESZ": 2, "BST": 1, "EST": -5, "EDT": -4}
ZONES_H |= {"PST": -8, "PDT": -7, "JST": 9, "KST": 9}
MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
GERMAN_MONTHS = {"mär": 3, "mrz": 3, "mai": 5, "okt": 10, "dez": 12}
NUMERIC = re.compile(r"(\d{1,4})([./-])(\d{1,2})\2(\d{1,4})(?:[ ,T_]+(.*))?")
COMPACT = re.compile(r"(\d{4})(\d\d)(\d\d)[ T_-]?(\d\d)(\d\d)(\d\d(?:[.,]\d+)?)(.*)")
CLOCK = re.compile(r"(\d{1,2})[:.h](\d\d)(?:[:.](\d\d(?:[.,]\d+)?))?\s*([AaPp]\.?[Mm]\.?)?\s*(.*)")
OFFSET = re.compile(r"(?:UTC|GMT)?([+-])(\d\d):?(\d\d)?")
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
        return StartTimes(None, _refuse_reading(unreadable))
    return _combine(runs, [stamp for stamp in stamps if stamp is not None])


def _refuse_reading(runs: list[Run]) -> tuple[DataFinding, ...]:
    shown = str(runs[0].attributes[ATTRIBUTE])[:40]
    text = f"{ATTRIBUTE} {shown!r} cannot be read as a time; the order of the runs' names replaces it."
    return (_note(runs, text),)


def _note(runs: list[Run], text: str, action: str = "noted") -> DataFinding:
    return DataFinding(tuple(run.name for run in runs), "", KIND, text, action)


def _combine(runs: tuple[Run, ...], stamps: list[_Stamp]) -> StartTimes:
    """Decide the order of day and month and the zone, and return the times."""
    orders = {stamp.is_day_first for stamp in stamps} - {None}
    if len(orders) > 1:
        text = f"{ATTRIBUTE} has the day first in some runs and the month first in others; write 2026-11-28T10:03:05."
        return StartTimes(None, (_note(list(runs), text, "refused"),))
    open_runs = [run for run, stamp in zip(runs, stamps, strict=True) if stamp.swapped is not None]
    whens = [stamp.when for stamp in stamps]
    if open_runs and not orders:
        other = [stamp.swapped or stamp.when for stamp in stamps]
        if [when - whens[0] for when in whens] != [when - other[0] for when in other]:
            shown = str(open_runs[0].attributes[ATTRIBUTE])
            text = f"{ATTRIBUTE} {shown!r}: day and month can be exchanged, in every run; write 2026-11-28T10:03:05."
            return StartTimes(None, (_note(open_runs, text, "refused"),))
    elif open_runs and orders == {False}:
        whens = [stamp.swapped or stamp.when for stamp in stamps]
    zones = [stamp.zone or _find_zone(run) for run, stamp in zip(runs, stamps, strict=True)]
    if len({zone is None for zone in zones}) > 1:
        without = [run for run, zone in zip(runs, zones, strict=True) if zone is None]
        text = f"{ATTRIBUTE} has a zone in some runs and none in others; state it in all of them."
        return StartTimes(None, (_note(without, text, "refused"),))
    seconds, repeated = [], []
    for run, when, zone in zip(runs, whens, zones, strict=True):
        early, late = (when.replace(tzinfo=zone or UTC, fold=fold).timestamp() for fold in (0, 1))
        if late > early:
            repeated.append(run)
        seconds.append(early)
    if repeated:
        shown = str(repeated[0].attributes[ATTRIBUTE])
        text = (
            f"{ATTRIBUTE} {shown!r} occurs twice in its zone, where the clock was set back; state the offset, +01:00."
        )
        return StartTimes(None, (_note(repeated, text, "refused"),))
    times_s = np.array(seconds)
    if zones[0] is None and _is_set_back(whens):
        text = (
            f"{ATTRIBUTE} goes back within an hour on a Sunday in autumn and states no zone; state the offset, +01:00."
        )
        return StartTimes(None, (_note(list(runs), text, "refused"),))
    resolution_s = 1.0 if all(stamp.has_seconds for stamp in stamps) else 60.0
    said = []
    if open_runs:
        text = "can be exchanged, which changes no time between runs"
        if orders:
            text = f"are told by the other runs: the {'month' if orders == {False} else 'day'} comes first"
        said.append(_note(open_runs, f"{ATTRIBUTE}: day and month {text}."))
    if not any(stamp.has_date for stamp in stamps):
        said.append(
            _note(list(runs), f"{ATTRIBUTE} states a time without a date; all runs are taken to be of one day.")
        )
    return StartTimes(times_s, (*said, *_examine(runs, times_s, resolution_s)))


def _is_set_back(whens: list[datetime]) -> bool:
    """Return whether times in the order of the runs step back once, as clocks do on a Sunday in autumn."""
    steps_s = [(later - earlier).total_seconds() for earlier, later in itertools.pairwise(whens)]
    back = [at for at, step_s in enumerate(steps_s) if step_s < 0.0]
    return (
        len(back) == 1
        and steps_s[back[0]] > -HOUR_S
        and whens[back[0]].weekday() == SUNDAY
        and whens[back[0]].month in (10, 11)
    )


def _examine(runs: tuple[Run, ...], seconds: FloatArray, resolution_s: float) -> tuple[DataFinding, ...]:
    """Return contradictions with the order of the runs and with their durations."""
    found = []
    backwards = [later for later, step_s in zip(runs[1:], np.diff(seconds), strict=True) if step_s < 0.0]
    if len(runs) > 1 and not np.ptp(seconds):
        found.append(_note(list(runs), f"{ATTRIBUTE} is the same in all runs, so nothing can be said of their order."))
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
            said = _note(list(runs), f"{ATTRIBUTE} is read as {name}.")
            return StartTimes(seconds, (said, *_examine(runs, seconds, 1e-3)))
    return StartTimes(None, _refuse_reading(list(runs)))


def _parse_stamp(text: str) -> _Stamp | None:
    text = " ".join(text.strip().strip('"').split())
    for parse in (_parse_iso, _parse_numeric, _parse_named, _parse_compact, _parse_clock_alone):
        stamp = _try(parse, text)
        if stamp is not None:
            return stamp
    return None


def _try(parse: Callable[[str], _Stamp | None], text: str) -> _Stamp | None:
    try:
        return parse(text)
    except (ValueError, OverflowError, KeyError, OSError):
        return None


def _parse_iso(text: str) -> _Stamp | None:
    if not re.match(r"\d{4}-?\d\d-?\d\d", text):
        return None
    bracket = re.fullmatch(r"(.*)\[(.+)\]", text)
    zone = None if bracket is None else ZoneInfo(bracket[2])
    when = datetime.fromisoformat((text if bracket is None else bracket[1]).replace(" +", "+"))
    return _Stamp(when.replace(tzinfo=None), when.tzinfo or zone, has_seconds=text.count(":") > 1 or ":" not in text)


def _parse_numeric(text: str) -> _Stamp | None:
    match = NUMERIC.fullmatch(text)
    if match is None:
        return None
    first, third = int(match[1]), int(match[4])
    middle = int(match[3])
    clock, zone, has_seconds = _parse_clock(match[5] or "0:00:00")
    if len(match[1]) == 4:
        return _Stamp(datetime(first, middle, third) + clock, zone, has_seconds=has_seconds)
    year = third + 2000 if len(match[4]) <= 2 else third
    if match[2] == ".":  # written with points, the day comes first everywhere
        return _Stamp(datetime(year, middle, first) + clock, zone, is_day_first=True, has_seconds=has_seconds)
    if first > 12 or middle > 12:
        day, month = (first, middle) if first > 12 else (middle, first)
        return _Stamp(datetime(year, month, day) + clock, zone, None, first > 12, has_seconds)
    swapped = datetime(year, first, middle) + clock
    return _Stamp(datetime(year, middle, first) + clock, zone, swapped, None, has_seconds)


def _parse_named(text: str) -> _Stamp | None:
    """Read a date with the name of its month: 28 Nov 2026 10:03, Nov 28, 2026 3:04 PM, Sat Nov 28 10:03:05 2026."""
    month = next((number for word in re.findall(r"[^\W\d_]+", text) if (number := _find_month(word))), None)
    clock = re.search(r"\d{1,2}:\d\d.*", text)
    if month is None:
        return None
    before = text if clock is None else text[: clock.start()]
    tail = "0:00:00" if clock is None else clock[0]
    year = re.search(r"(?:19|20)\d\d", before) or re.search(r"(?:19|20)\d\d$", tail)
    if year is None:
        return None
    tail = tail.removesuffix(year[0]) if year.string is tail else tail
    day = re.search(r"(?<!\d)\d{1,2}(?!\d)", before)
    if day is None:
        return None
    span, zone, has_seconds = _parse_clock(tail.strip())
    return _Stamp(datetime(int(year[0]), month, int(day[0])) + span, zone, has_seconds=has_seconds)


def _find_month(word: str) -> int | None:
    key = word.lower()[:3]
    return MONTHS.index(key) + 1 if key in MONTHS else GERMAN_MONTHS.get(key)


def _parse_compact(text: str) -> _Stamp | None:
    match = COMPACT.fullmatch(text)
    if match is None:
        return None
    clock, zone, _ = _parse_clock(f"{match[4]}:{match[5]}:{match[6]} {match[7]}".strip())
    return _Stamp(datetime(int(match[1]), int(match[2]), int(match[3])) + clock, zone)


def _parse_clock_alone(text: str) -> _Stamp | None:
    clock, zone, has_seconds = _parse_clock(text)
    return _Stamp(datetime(2000, 1, 1) + clock, zone, has_seconds=has_seconds, has_date=False)


def _parse_clock(text: str) -> tuple[timedelta, tzinfo | None, bool]:
    """Return the time of day, the zone if any, and whether seconds are stated. Raise ValueError for anything else."""
    match = CLOCK.fullmatch(text.strip())
    if match is None:
        raise ValueError(text)
    hour, minute, second = int(match[1]), int(match[2]), float((match[3] or "0").replace(",", "."))
    if match[4]:
        if not 1 <= hour <= 12:
            raise ValueError(text)
        hour = hour % 12 + (12 if match[4][0] in "Pp" else 0)
    if hour > 23 or minute > 59 or second >= 61.0:
        raise ValueError(text)
    return timedelta(hours=hour, minutes=minute, seconds=second), _parse_zone(match[5].strip()), match[3] is not None


def _parse_zone(text: str) -> tzinfo | None:
    text = text.strip("()[] ")
    if not text:
        return None
    if text.upper() in ZONES_H:
        return timezone(timedelta(hours=ZONES_H[text.upper()]))
    offset = OFFSET.fullmatch(text)
    if offset is not None:
        span = timedelta(hours=int(offset[2]), minutes=int(offset[3] or 0))
        return timezone(span if offset[1] == "+" else -span)
    return ZoneInfo(text)  # raises KeyError or ValueError for what is none


def _find_zone(run: Run) -> tzinfo | None:
    """Return the zone that a run states beside its start."""
    stated = next((str(run.attributes[name]) for name in ZONE_ATTRIBUTES if name in run.attributes), "")
    try:
        return _parse_zone(stated)
    except (ValueError, KeyError, OSError):
        return None
