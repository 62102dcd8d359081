"""Start times of runs are read in the forms of spreadsheets and loggers, or what is wrong with them is stated."""

from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from optodrive.core.types.measurements import Run, Signal
from optodrive.lab.inspection.start_times import read_start_times

T_S = np.arange(10) / 100.0


def build_runs(stamps, **attributes):
    """Return runs of a tenth of a second with these stamps, None for none."""
    runs = []
    for number, stamp in enumerate(stamps):
        stated = {} if stamp is None else {"started_at": stamp}
        signals = {"displacement_m": Signal(0, T_S, T_S)}
        runs.append(Run(f"r{number}", 293.0, np.array([[0.0, 0.01, 1.0, 0.0]]), signals, stated | attributes))
    return tuple(runs)


FORMS = {
    "german": "%d.%m.%Y %H:%M:%S",
    "german without seconds": "%d.%m.%Y %H:%M",
    "american": "%m/%d/%Y %I:%M:%S %p",
    "british": "%d/%m/%Y %H:%M:%S",
    "dashes": "%d-%m-%Y %H:%M:%S",
    "iso": "%Y-%m-%dT%H:%M:%S",
    "iso utc": "%Y-%m-%dT%H:%M:%SZ",
    "iso fraction": "%Y-%m-%d %H:%M:%S.%f",
    "iso offset": "%Y-%m-%d %H:%M:%S +0100",
    "year first": "%Y/%m/%d %H:%M:%S",
    "compact": "%Y%m%d_%H%M%S",
    "month's name": "%d %b %Y %H:%M:%S",
    "month first": "%b %d, %Y %I:%M:%S %p",
    "ctime": "%a %b %d %H:%M:%S %Y",
    "two digits": "%d.%m.%y %H:%M:%S",
    "zone": "%d.%m.%Y %H:%M:%S CET",
}


@pytest.mark.parametrize("form", FORMS.values(), ids=FORMS)
@settings(max_examples=20, deadline=None)
@given(
    start=st.datetimes(datetime(2020, 1, 1), datetime(2035, 1, 1)), minutes=st.lists(st.integers(1, 600), min_size=4)
)
def test_differences_are_those_written(form, start, minutes):
    start = start.replace(second=0, microsecond=0, day=28)  # the day tells the order of day and month
    whens = [start + timedelta(minutes=sum(minutes[:count])) for count in range(len(minutes))]
    times = read_start_times(build_runs([when.strftime(form) for when in whens]))
    expected = [(when - start).total_seconds() for when in whens]
    assert times.seconds is not None
    assert np.allclose(times.seconds - times.seconds[0], expected)
    assert not [item for item in times.findings if item.action == "refused"]


@pytest.mark.parametrize(
    ("to_number", "resolution_s"),
    [
        (lambda s: s, 1e-3),
        (lambda s: 1e3 * s, 1e-3),
        (lambda s: 1e9 * s, 1e-3),
        (lambda s: s + 2_082_844_800.0, 1e-3),
        (lambda s: s / 86400.0 + 25569.0, 1e-3),
        (lambda s: f"{s / 86400.0 + 25569.0:.8f}".replace(".", ","), 2e-3),
        (lambda s: s / 86400.0 + 719529.0, 0.1),
        (lambda s: s - 1_795_860_000.0, 1e-3),
    ],
    ids=["unix", "ms", "ns", "1904", "spreadsheet", "comma", "matlab", "elapsed"],
)
def test_numbers_are_times(to_number, resolution_s):
    unix_s = np.array([1_795_860_000.0, 1_795_860_060.0, 1_795_869_000.5])
    times = read_start_times(build_runs([to_number(float(item)) for item in unix_s]))
    assert np.allclose(np.diff(times.seconds), np.diff(unix_s), atol=resolution_s)
    (found,) = times.findings
    assert "is read as" in found.text


def test_day_and_month_are_told_by_any_other_run():
    times = read_start_times(build_runs(["03/04/2026 10:00", "13/04/2026 10:00"]))
    assert np.diff(times.seconds) == [10 * 86400.0]
    times = read_start_times(build_runs(["04/03/2026 10:00", "04/13/2026 10:00"]))
    assert np.diff(times.seconds) == [10 * 86400.0]


def test_an_open_order_is_refused_only_where_it_matters():
    same_day = read_start_times(build_runs(["03/04/2026 10:00", "03/04/2026 11:00"]))
    assert np.diff(same_day.seconds) == [3600.0]
    other_days = read_start_times(build_runs(["03/04/2026 10:00", "04/04/2026 11:00"]))
    assert other_days.seconds is None
    (found,) = other_days.findings
    assert (found.action, found.runs) == ("refused", ("r0", "r1"))
    assert "day and month" in found.text


@pytest.mark.parametrize(
    ("stamps", "part"),
    [
        (["28/11/2026 10:00", "11/29/2026 10:00"], "day first in some"),
        (["2026-11-28T10:00:00", "2026-11-28T10:05:00+01:00"], "a zone in some runs"),
    ],
)
def test_contradictions_between_runs_are_refused(stamps, part):
    (found,) = read_start_times(build_runs(stamps)).findings
    assert found.action == "refused"
    assert part in found.text


def test_naive_times_do_not_depend_on_the_computers_zone(monkeypatch):
    from time import tzset

    monkeypatch.setenv("TZ", "Europe/Berlin")
    tzset()
    try:
        times = read_start_times(build_runs(["2026-10-25T01:30:00", "2026-10-25T03:30:00"]))
    finally:
        monkeypatch.undo()
        tzset()
    assert np.diff(times.seconds) == [7200.0]


def test_the_repeated_hour_of_a_stated_zone_is_refused():
    runs = build_runs(["2026-10-25T01:30:00", "2026-10-25T02:30:00"], timezone="Europe/Berlin")
    (found,) = read_start_times(runs).findings
    assert (found.action, found.runs) == ("refused", ("r1",))
    runs = build_runs(["2026-10-25T01:30:00", "2026-10-25T03:30:00"], timezone="Europe/Berlin")
    assert np.diff(read_start_times(runs).seconds) == [3 * 3600.0]


@pytest.mark.parametrize(
    "stamps", [["2026-11-28T10:00:00", None, "x"], ["yesterday", "today"], ["2026-13-45", "2026-11-28"]]
)
def test_what_cannot_be_read_is_said(stamps):
    times = read_start_times(build_runs(stamps))
    assert times.seconds is None
    (found,) = times.findings
    assert found.action == "noted"
    assert "order of" in found.text


def test_nothing_is_said_without_stamps():
    assert read_start_times(build_runs([None, None])).findings == ()


def test_order_and_overlap_are_noted():
    (found,) = read_start_times(build_runs(["2026-11-28T10:05:00", "2026-11-28T10:00:00"])).findings
    assert (found.runs, found.action) == (("r1",), "noted")
    start = datetime(2026, 11, 28, tzinfo=UTC).timestamp()
    _, found = read_start_times(build_runs([start, start + 0.05])).findings
    assert "before the one before them ends" in found.text


@settings(max_examples=200, deadline=None)
@given(st.lists(st.one_of(st.text(max_size=30), st.floats(), st.integers(), st.none()), min_size=1, max_size=4))
def test_any_stamp_is_read_or_said(stamps):
    stamps = [item.replace("\0", "") if isinstance(item, str) else item for item in stamps]
    times = read_start_times(build_runs(stamps))
    assert times.seconds is not None or times.findings or all(item is None for item in stamps)
