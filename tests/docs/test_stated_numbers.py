"""Numbers in the prose on stimuli are those that a plan states."""

import json
import re
from pathlib import Path

import pytest

from displays import DISPLAYS
from optodrive.planning.feasibility.check import check_feasibility
from optodrive.planning.plan_summary import summarize_plan
from optodrive.planning.stimuli.sequence_file import parse_sequence

DOCS = Path(__file__).parents[2] / "docs"
PAGES = ("how-to/show-stimuli.md", "reference/formats/frames-json.md")
TEXT = " ".join(" ".join((DOCS / page).read_text().split()) for page in PAGES)
DISPLAY = DISPLAYS["display-437"]


def plan(heights_um, **frame):
    """Return the summary of a plan of one frame on the cold display."""
    targets_um = {str(pixel): height_um for pixel, height_um in heights_um.items()}
    body = {"frames": [{"show_at_s": 0.0, "duration_s": 2.0, "target_um": targets_um, **frame}]}
    sequence = parse_sequence(json.dumps(body).encode(), DISPLAY.config, "FRAMES.json")
    return summarize_plan(*check_feasibility(DISPLAY, sequence, *DISPLAY.build_cold_state()))


def find_square(side):
    """Return the pixels of a square in the middle of the display."""
    rows, columns = DISPLAY.layout.row, DISPLAY.layout.column
    return [k for k in range(len(rows)) if 9 <= rows[k] < 9 + side and 9 <= columns[k] < 9 + side]


def read_numbers(pattern):
    """Return the numbers that a pattern finds in the pages, where it stands once."""
    (numbers,) = re.findall(pattern, TEXT)
    return [float(each) for each in ([numbers] if isinstance(numbers, str) else numbers)]


def test_the_time_of_a_pulse_by_height():
    pattern = r"about ([\d.]+) ms to 50 µm, ([\d.]+) ms to 100 µm, ([\d.]+) ms to 150 µm and ([\d.]+) ms to 518 µm"
    for height_um, stated_ms in zip((50, 100, 150, 518), read_numbers(pattern), strict=True):
        assert 1e3 * plan({218: height_um}).beam_on_s == pytest.approx(stated_ms, abs=0.05)


def test_the_time_of_all_pixels():
    (stated_s,) = read_numbers(r"All 437 pixels at 50 µm take ([\d.]+) s")
    assert plan(dict.fromkeys(range(437), 50)).duration_s == pytest.approx(stated_s, abs=0.005)


def test_the_simultaneity_of_neighbours():
    single, best = read_numbers(r"Four neighbours in a square at 100 µm improve from ([\d.]+) to ([\d.]+);")
    (four,) = plan(dict.fromkeys(find_square(2), 100), simultaneous=True).frames
    assert four.simultaneous.simultaneity_single_pulse == pytest.approx(single, abs=0.005)
    assert four.simultaneous.simultaneity == pytest.approx(best, abs=0.005)
    alone_ms, largest = read_numbers(
        r"of nine at 200 µm, which take ([\d.]+) ms .*? no number of rounds exceeds ([\d.]+)\."
    )
    (nine,) = plan(dict.fromkeys(find_square(3), 200), simultaneous=True).frames
    assert nine.simultaneous.simultaneity == pytest.approx(largest, abs=0.005)
    assert 1e3 * plan(dict.fromkeys(find_square(3), 200)).duration_s == pytest.approx(alone_ms, abs=5)
