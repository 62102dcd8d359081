"""A core with small tables: pulses that it cannot account for are not emitted."""

from functools import partial

import pytest
from bench import PATIENT, Bench, here
from job_scenarios import reported
from virtual_board import VirtualKind

from c_core import SeededCBoard

SIZES = ("BOARD_CELLS=4", "BOARD_PULSES=8", "BOARD_QUEUE_POINTS=24", "BOARD_RECORDS=16")


@pytest.fixture
def ready(libraries, tmp_path):
    """Return a function of limits for a host that has armed the core with small tables."""
    bench = Bench(VirtualKind("c", partial(SeededCBoard, libraries(0, *SIZES))), tmp_path)
    return partial(bench.ready, queue_points=24, **PATIENT)


def row(count, dark_us=0):
    return [here(100, x=1000 + 2000 * k, duty=999, dark_us=dark_us) for k in range(count)]


@pytest.mark.parametrize(
    ("limits", "points", "fault", "emitted"),
    [
        pytest.param({"spot_leak_uw": 0}, row(5), ["SPOT"], 4, id="more warm cells than accounts"),
        pytest.param({}, row(6, dark_us=5000), [], 6, id="accounts of cooled cells are given back"),
        pytest.param({}, [here(100, duty=99, dark_us=1000)] * 9, ["MEAN_POWER"], 8, id="more pulses in a second"),
    ],
)
def test_more_than_the_tables_hold_is_a_fault(ready, limits, points, fault, emitted):
    host = ready(**limits)
    host.play(*points)
    host.wait(lambda: host.board.states()[-1][1] in ("fault", "job done"), "the end")
    assert host.board.faults() == fault
    assert len(host.board.pulse_numbers()) == emitted


def test_reports_come_before_their_records_are_overwritten(ready):
    host = ready()
    host.play(*[here(0, dark_us=400, duty=0)] * 24)
    host.pause(0.05)
    assert list(reported(host)) == list(range(24))
