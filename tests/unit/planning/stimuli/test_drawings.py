"""SVG drawings: lines on the lattice at three heights, which stay three classes on the membrane."""

from itertools import pairwise

import numpy as np
import pytest

from optodrive.core import extras
from optodrive.core.errors import InputError
from optodrive.core.types.stimuli import FrameSequence, TactileFrame
from optodrive.device.config_file import load_config
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.pipeline import plan_sequence
from optodrive.planning.stimuli.drawings import HEIGHT_BY_CLASS, build_drawing, compute_lattice_heights
from optodrive.planning.stimuli.pixel_lattice import Lattice

SVG = '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {} {}">{}</svg>'
GRAPH = """
<g class="grid" stroke="#ccc"><path d="M0 5H20M0 15H20M5 0V20M15 0V20"/></g>
<g class="fine axes"><path d="M0 10H20"/><line x1="10" y1="0" x2="10" y2="20"/></g>
<g class="plot" transform="translate(10 10)"><path d="M-9 8C-3 8 3 -8 9 -8" fill="none"/></g>
<text x="3" y="3">y</text>
"""


def draw(body, width=20, height=20, name="display-437"):
    """Return the shares of height on the lattice, [rows from the bottom, columns]."""
    lattice = Lattice.from_config(load_config(name))
    heights = compute_lattice_heights(SVG.format(width, height, body).encode(), lattice, "t: file")
    whole = np.full(lattice.index.shape, np.nan)
    whole[lattice.layout.row, lattice.layout.column] = heights
    return whole


@pytest.mark.parametrize(
    ("body", "places"),
    [
        ('<path d="M0 {0}H{1}"/>', [(4, column) for column in range(9)]),
        ('<line x1="{0}" y1="0" x2="{0}" y2="{1}"/>', [(row, 4) for row in range(9)]),
        ('<path d="M0 0L{1} {1}"/>', [(8 - k, k) for k in range(9)]),
    ],
)
def test_a_line_rises_where_it_runs(body, places):
    """On a lattice of 9 × 9 places, of which all exist."""
    from optodrive.device.config import PixelLayout

    row, column = np.divmod(np.arange(81), 9)
    lattice = Lattice.from_layout("nine", PixelLayout(column * 1e-3, row * 1e-3, row, column))
    heights = compute_lattice_heights(SVG.format(9, 9, body.format(4.5, 9)).encode(), lattice, "t: file")
    assert {divmod(int(pixel), 9) for pixel in np.flatnonzero(heights)} == set(places)


def test_classes_are_heights_and_the_highest_line_wins():
    heights = draw(GRAPH)
    assert set(np.round(heights[np.isfinite(heights)], 6)) == {0.0, *np.round(list(HEIGHT_BY_CLASS.values()), 6)}
    rows, columns = heights.shape
    assert heights[rows // 2, columns // 4] == pytest.approx(2 / 3), "an axis over a line of the grid"
    assert heights[rows // 2, columns // 2] == 1.0, "the curve over the axes, by the group around it"


def test_left_is_left_and_top_is_top():
    heights = draw('<path d="M1 1h4"/>')
    rows, columns = np.nonzero(np.nan_to_num(heights))
    assert rows.min() > heights.shape[0] * 0.75
    assert columns.max() < heights.shape[1] * 0.4


def test_a_drawing_is_fitted_and_centred():
    flat, tall = (
        np.nan_to_num(draw('<rect x="0" y="0" width="100%" height="100%"/>', *size)) > 0
        for size in ((40, 10), (10, 40))
    )
    assert flat.any(axis=0).sum() > 2 * flat.any(axis=1).sum()
    assert tall.any(axis=1).sum() > 2 * tall.any(axis=0).sum()


@pytest.mark.parametrize("name", ["display-357", "display-437", "display-1511"])
def test_three_heights_stay_three_classes_on_the_membrane(name):
    """By the heights that the plan predicts, each class apart from the others; nothing trimmed."""
    config = load_config(name)
    display = DisplayModel.from_config(config)
    (whole,) = {
        frame.target_m.tobytes()
        for frame in build_drawing(config, "t", SVG.format(20, 20, GRAPH).encode(), 90e-6, 0.0).frames
    }
    target_m = np.frombuffer(whole)
    planned = plan_sequence(
        display, FrameSequence((TactileFrame("d", 0.0, 60.0, target_m),)), *display.build_cold_state()
    )
    reached_m = np.zeros(len(target_m))
    np.maximum.at(reached_m, planned.plan.pixel, planned.predicted_m)
    classes = [reached_m[np.isclose(target_m, share * 90e-6)] for share in sorted(HEIGHT_BY_CLASS.values())]
    assert all(len(heights) for heights in classes)
    for lower, higher in pairwise(classes):
        assert lower.max() < 0.75 * higher.min()


@pytest.mark.parametrize(
    ("file", "message"),
    [
        (b"", "an SVG drawing"),
        (b"\x89PNG\r\n", "an SVG drawing"),
        (b"<svg", "an SVG drawing"),
        (b"<html></html>", "an SVG drawing|a drawing with lines"),
        (SVG.format(0, 0, '<path d="M0 0L1 1"/>').encode(), "an SVG drawing with a viewBox"),
        (SVG.format(9, 9, "<text>a</text>").encode(), "a drawing with lines"),
        (SVG.format(9, 9, '<path d="M90 90L99 99"/>').encode(), "a drawing with lines"),
        (SVG.format(9, 9, f'<path d="M0 0{"L9 9L0 0" * 20_000}"/>').encode(), "fewer or shorter lines"),
    ],
)
def test_another_file_is_refused_in_one_line(file, message):
    lattice = Lattice.from_config(load_config())
    with pytest.raises(InputError, match=message) as refused:
        compute_lattice_heights(file, lattice, "t: file")
    assert "\n" not in str(refused.value)


def test_without_the_library_one_line_says_what_to_install(monkeypatch):
    def import_nothing(name):
        raise ImportError(name)

    monkeypatch.setattr(extras, "import_module", import_nothing)
    with pytest.raises(InputError, match=r"svgelements: .*pip install 'optodrive\[reading\]'"):
        build_drawing(load_config(), "t", SVG.format(9, 9, "").encode(), 1e-4, 1.0)
