"""A core with small tables: pulses that it cannot account for are not emitted."""

import re
from functools import partial
from pathlib import Path

import pytest
from bench import PATIENT, Bench, here
from job_scenarios import reported
from virtual_board import VirtualKind

from c_core import SeededCBoard
from displays import DISPLAYS
from optodrive.link.board_setup import build_board_requirements

PICO = Path(__file__).parents[2] / "firmware_protocol" / "ports" / "rp2040" / "Makefile"
SIZES = ("BOARD_CELLS=4", "BOARD_PULSES=8", "BOARD_QUEUE_POINTS=24", "BOARD_RECORDS=16")


@pytest.fixture
def ready(libraries, tmp_path):
    """Return a function of limits for a host that has armed the core with small tables."""
    bench = Bench(VirtualKind("c", partial(SeededCBoard, libraries(0, *SIZES))), tmp_path)
    return partial(bench.ready, **PATIENT)


def row(count, dark_us=0):
    return [here(100, x=1000 + 2000 * k, duty=999, dark_us=dark_us) for k in range(count)]


@pytest.mark.parametrize(
    ("limits", "points", "fault", "emitted"),
    [
        pytest.param({"spot_leak_uw": 0}, row(5), ["CELLS"], 4, id="more warm cells than accounts"),
        pytest.param({}, row(6, dark_us=5000), [], 6, id="accounts of cooled cells are given back"),
        pytest.param({}, [here(100, duty=99, dark_us=1000)] * 9, ["PULSES"], 8, id="more pulses in a second"),
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


def test_the_picos_tables_hold_the_display_of_1511_pixels_at_2000_pulses_a_second(libraries, tmp_path):
    sizes = re.findall(r"-D(BOARD_\w+=\d+)u", PICO.read_text())
    assert len(sizes) == 4
    display = DISPLAYS["display-1511"]
    requirements = build_board_requirements(display.config)
    angles_rad = display.scan_head.field.angles_rad(display.layout.x_m, display.layout.y_m)
    x_codes, y_codes = (requirements.scale.to_codes(angle_rad).tolist() for angle_rad in angles_rad)
    bench = Bench(VirtualKind("c", partial(SeededCBoard, libraries(0, *sizes))), tmp_path)
    limits = dict(spot_leak_uw=0, settle_us=0, settle_ns_per_code=0, cell_codes=requirements.cell_max_codes, **PATIENT)
    host = bench.ready(queue_points=2048, **limits)
    frame = [here(100, x=x, y=y, duty=99, dark_us=400) for x, y in zip(x_codes, y_codes, strict=True)]
    host.play(*frame, *frame[:500])
    host.wait(lambda: host.board.states()[-1][1] in ("fault", "job done"), "the end")
    assert host.board.faults() == []
    pulses = host.board.of("pulse")
    assert len(pulses) == 2011
    assert pulses[2000]["on_us"] - pulses[0]["on_us"] == 1_000_000
