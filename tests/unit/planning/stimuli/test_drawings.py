"""SVG drawings: lines on the lattice at three heights, which stay three classes on the membrane."""

from io import BytesIO
from itertools import pairwise

import numpy as np
import pytest
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from optodrive.core import extras
from optodrive.core.errors import InputError
from optodrive.core.types.stimuli import FrameSequence, TactileFrame
from optodrive.device.config_file import load_config
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.pipeline import plan_sequence
from optodrive.planning.stimuli import drawings
from optodrive.planning.stimuli.drawings import HEIGHT_BY_CLASS, build_drawing, compute_lattice_heights
from optodrive.planning.stimuli.pixel_lattice import Lattice

SVG = (
    '<svg xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink" viewBox="0 0 {} {}" '
    'stroke="#000" stroke-width=".2" fill="none">{}</svg>'
)
GRAPH = """
<g class="grid" stroke="#ccc"><path d="M0 5H20M0 15H20M5 0V20M15 0V20"/></g>
<g class="fine axes"><path d="M0 10H20"/><line x1="10" y1="0" x2="10" y2="20"/></g>
<g class="plot" transform="translate(10 10)"><path d="M-9 8C-3 8 3 -8 9 -8" fill="none"/></g>
<text x="3" y="3">y</text>
"""

LATTICE = Lattice.from_config(load_config("display-437"))


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
        (SVG.format("nan", "nan", '<path d="M0 0L1 1"/>').encode(), "viewBox: got '0 0 nan nan'"),
        (SVG.format("1e999", 9, '<path d="M0 0L1 1"/>').encode(), "viewBox: got '0 0 1e999 9'"),
        (b'<svg xmlns="http://www.w3.org/2000/svg" width="9"/>', "viewBox: missing, expected .* width and height"),
        (b'<!DOCTYPE svg [<!ENTITY a "b">]><svg/>', "got entities"),
        (
            '<?xml version="1.0" encoding="UTF-16"?><!DOCTYPE svg [<!ENTITY a "b">]><svg/>'.encode("utf-16-le"),
            "entities",
        ),
        (b'<?xml version="1.0" encoding="nonsense"?><svg/>', "an SVG drawing"),
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
    with pytest.raises(InputError, match=r"resvg_py: .*pip install 'optodrive\[reading\]'"):
        build_drawing(load_config(), "t", SVG.format(9, 9, "<path/>").encode(), 1e-4, 1.0)


MANY = '<path d="M0 0L9 9"/>'
USE, OLD_USE = "<use href='#a{}'/>", "<use xlink:href='#a{}'/>"


def multiply(tag, content, levels):
    """Return elements of which each refers ten times to the one before."""
    return "".join(
        f'<{tag} id="a{k}" width="1" height="1">' + content.format(k - 1) * 10 + f"</{tag}>" for k in range(1, levels)
    )


HEAVY = {
    "uses": f'<defs><path id="a0"/>{multiply("g", USE, 14)}</defs><use href="#a13"/>',
    "uses by the old name": f'<defs><path id="a0"/>{multiply("g", OLD_USE, 14)}</defs><use xlink:href="#a13"/>',
    "patterns": multiply("pattern", "<rect fill='url(#a{})'/>", 9) + '<rect fill="url(#a8)"/>',
    "patterns by style": multiply("pattern", """<rect style='fill: url( "#a{}")'/>""", 9) + '<rect fill="url(#a8)"/>',
    "markers": f'<marker id="m">{MANY * 100}</marker><g marker-mid="url(#m)"><path d="M0 0{"L1 1L2 2" * 10_000}"/></g>',
    "masks by a style sheet": f'<style>path {{mask: url(#m)}}</style><mask id="m">{MANY * 100}</mask>{MANY * 500}',
    "paths": MANY * 100_000,
    "groups of their own picture": f'<g opacity="0.5">{MANY}</g>' * 9_000,
    "pictures of classes": '<path class="grid" d="M0 0L9 9"/><path class="axes" d="M0 0L9 9"/>' * 4_000,
    "depth": "<g>" * 900 + MANY + "</g>" * 900,
    "depth of uses": "".join(f'<g id="a{k}"><use href="#a{k + 1}"/></g>' for k in range(900)),
    "style sheets": f"<style>{'.a{{stroke:red}}' * 20_000}</style>{MANY * 5_000}",
    "attributes": "<path " + " ".join(f'a{k}=""' for k in range(50_000)) + "/>",
    "characters": f'<defs><path id="a" d="{"M0 0L1 1" * 20_000}"/></defs>' + '<use href="#a"/>' * 100,
    "bytes": "<!--" + " " * 8_000_000 + "-->",
}


@pytest.mark.parametrize("name", HEAVY)
def test_a_drawing_that_takes_much_work_is_refused_before_any(monkeypatch, name):
    """By counts after expansion; nothing is rendered."""
    monkeypatch.setattr(drawings, "import_extra", lambda *_, **__: pytest.fail("it was rendered"))
    with pytest.raises(InputError, match=r"expected (a drawing that has|at most)") as refused:
        draw(HEAVY[name])
    assert refused.value.code == "too_many"
    assert len(str(refused.value)) < 400


@pytest.mark.parametrize(
    "body",
    [
        f'<path d="M5 5h9" transform="{"rotate(" * 50_000}1{")" * 50_000}"/>',
        f'<path d="M5 5h9" transform="{"rotate(360)" * 10_000}"/>',
        '<filter id="f" filterUnits="userSpaceOnUse" width="20" height="20">'
        '<feTurbulence numOctaves="1000000" baseFrequency="1"/></filter><path d="M5 5h9" filter="url(#f)"/>',
        '<g id="a"><use href="#a"/><path d="M5 5h9"/></g>',
        '<path d="M5 5h9"/><path/><path d=""/><path d="M0"/><use/><use href="#none"/>',
        '<path d="M5 5h9"/><image width="20" height="20" href="/usr/share/pixmaps/debian-logo.png"/>',
        '<path d="M5 5h9"/><feImage href="/etc/hostname"/><style>@import url("http://a/b.css");</style>',
    ],
)
def test_what_would_take_long_or_read_a_file_is_ignored(body):
    assert np.array_equal(draw(body), draw('<path d="M5 5h9"/>'), equal_nan=True)


@pytest.mark.parametrize(
    ("root", "equal_to"),
    [
        ('width="100" viewBox="0 0 20 10"', 'viewBox="0 0 20 10"'),
        ('height="9mm" viewBox="0,0 20,10"', 'viewBox="0 0 20 10"'),
        ('width="100%" height="100%" viewBox="0 0 20 10"', 'viewBox="0 0 20 10"'),
        ('width="15pt" height="10px"', 'viewBox="0 0 20 10"'),
    ],
)
def test_a_drawing_is_as_large_as_its_view_box(root, equal_to):
    body = '<path d="M1 1H19V9" stroke="#000" stroke-width=".2" fill="none"/>'
    one, other = (
        compute_lattice_heights(f'<svg xmlns="http://www.w3.org/2000/svg" {each}>{body}</svg>'.encode(), LATTICE, "t")
        for each in (root, equal_to)
    )
    assert np.array_equal(one, other)
    assert one.any()


def test_a_drawing_of_matplotlib_has_its_axes_and_its_curve():
    """With white backgrounds, a title with a space, which is a path without d, and a document type."""
    figure = Figure(figsize=(4, 4))
    FigureCanvasSVG(figure)
    axes = figure.add_axes((0.1, 0.1, 0.8, 0.8))
    axes.plot([0, 1], [0, 1], gid="line")
    axes.set(title="a b", xlim=(0, 1), ylim=(0, 1), xticks=[], yticks=[])
    file = BytesIO()
    figure.savefig(file, format="svg")
    assert b"<!DOCTYPE" in file.getvalue()
    rows, columns = LATTICE.index.shape
    whole = np.full((rows, columns), np.nan)
    whole[LATTICE.layout.row, LATTICE.layout.column] = compute_lattice_heights(file.getvalue(), LATTICE, "t")
    low, high = int(0.1 * rows), int(0.9 * rows)
    assert np.nanmin(whole[low, low : high + 1]) == 1.0, "the lower axis"
    assert all(whole[k, k] == 1.0 for k in range(low, high)), "the line"
    assert not np.nan_to_num(whole[: low - 1]).any(), "the white margin"
    inner = whole[low + 3 : high - 3, low + 3 : high - 3]
    assert np.nanmean(inner > 0.0) < 0.3, "the white ground of the axes"
