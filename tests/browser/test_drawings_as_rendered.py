"""SVG drawings against Chromium: the display raises what the browser shows, and nothing else."""

from base64 import b64encode
from io import BytesIO

import numpy as np
import pytest
from PIL import Image

from optodrive.device.config import PixelLayout
from optodrive.planning.stimuli.drawings import compute_lattice_heights
from optodrive.planning.stimuli.pixel_lattice import Lattice

PLACES, PIXELS_PER_PLACE = 20, 16
INK = 12
"""Difference from white, of 255, that is a line."""
LINE = '<path d="M2 3L17 12" stroke="#000"/>'
SVG = '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 20 20" stroke-width=".3" fill="none">{}</svg>'
DRAWINGS = {
    "edges": '<path d="M20 0V20H0" stroke="#000"/>',
    "display none": f'{LINE}<g style="display:none"><path d="M2 17H18" stroke="#000"/></g>',
    "visibility": f'{LINE}<g visibility="hidden"><path d="M2 17H18" stroke="#000"/></g>',
    "visible within": '<g visibility="hidden"><path d="M2 17H18" stroke="#000" visibility="visible"/></g>',
    "style sheet": f'<style>.no {{display: none}} g > path {{stroke: red}}</style>{LINE}<g><path d="M2 2V18"/></g>'
    '<path class="no" d="M2 17H18" stroke="#000"/>',
    "transparent": f'{LINE}<path d="M2 17H18" stroke="#000" opacity="0"/><path d="M9 2V18" stroke="#000" '
    'stroke-opacity="0"/><path d="M12 2V18" stroke="transparent"/>',
    "without a stroke": f'{LINE}<path d="M2 17H18"/>',
    "clipped": '<clipPath id="c"><rect x="5" width="6" height="20"/></clipPath>'
    '<path d="M1 9H19" stroke="#000" clip-path="url(#c)"/>',
    "masked": '<mask id="m"><rect x="5" width="6" height="20" fill="#fff"/></mask>'
    '<path d="M1 9H19M8 1V19" stroke="#000" mask="url(#m)"/>',
    "a symbol with a viewBox": '<symbol id="s" viewBox="0 0 100 100"><path d="M10 10L90 50" stroke="#000" '
    'stroke-width="4"/></symbol><use href="#s" x="4" y="4" width="10" height="10"/>',
    "a symbol alone": f'<symbol id="s"><path d="M2 17H18" stroke="#000"/></symbol>{LINE}',
    "definitions": f'<defs><path id="d" d="M2 17H18" stroke="#000"/></defs>{LINE}',
    "a marker": '<marker id="k" markerWidth="9" markerHeight="9" refX="0" refY="3" orient="auto" '
    'markerUnits="userSpaceOnUse"><path d="M0 0L3 3L0 6" stroke="#000" fill="none" stroke-width=".3"/></marker>'
    '<path d="M2 10H14" stroke="#000" marker-end="url(#k)"/>',
    "white ground": f'<rect width="20" height="20" fill="#fff"/>{LINE}',
    "white cover": f'<path d="M2 17H18" stroke="#000"/><rect y="15" width="20" height="5" fill="#fff"/>{LINE}',
    "white cover of another class": '<g class="grid"><path d="M2 17H18" stroke="#000"/></g>'
    f'<rect y="15" width="20" height="5" fill="#fff"/><g class="axes">{LINE}</g>',
    "beyond the viewBox": f'{LINE}<svg width="20" height="8"><path d="M4 0V20" stroke="#000"/></svg>',
    "turned": '<g transform="rotate(30 10 10) scale(.8)"><path d="M4 4H20M4 8L9 20" stroke="#00f"/></g>',
    "arcs and curves": '<path d="M3 15A7 5 20 0 1 17 9S12 2 6 4Q1 6 3 15" stroke="#080"/>',
    "pale and fine": '<path d="M1 4L19 16" stroke="#ccc" stroke-width=".05"/>',
}


@pytest.fixture(scope="module")
def sheet(browser):
    size = PLACES * PIXELS_PER_PLACE
    page = browser.new_page(viewport={"width": size, "height": size})
    yield page
    page.close()


def show(sheet, svg):
    """Return where Chromium shows ink, [pixels down, pixels across]."""
    source = f"data:image/svg+xml;base64,{b64encode(svg.encode()).decode()}"
    sheet.set_content(f'<body style="margin:0"><img style="width:100vw;height:100vh" src="{source}">')
    sheet.wait_for_function("document.images[0].complete")
    with Image.open(BytesIO(sheet.screenshot())) as image:
        return (255 - np.asarray(image.convert("RGB")).min(axis=2)) > INK


def find_errors(raised, ink):
    """Return the places that are raised without ink, and the ink that is further than a place from a raised one."""
    near = np.pad(ink, 1)
    near = np.max([near[y : y + ink.shape[0], x : x + ink.shape[1]] for y in range(3) for x in range(3)], axis=0)
    blocks = near.reshape(PLACES, PIXELS_PER_PLACE, PLACES, PIXELS_PER_PLACE).any(axis=(1, 3))
    around = np.pad(raised, 1)
    around = np.max([around[y : y + PLACES, x : x + PLACES] for y in range(3) for x in range(3)], axis=0)
    is_near = np.kron(around, np.ones((PIXELS_PER_PLACE, PIXELS_PER_PLACE), dtype=bool))
    return np.argwhere(raised & ~blocks).tolist(), np.argwhere(ink & ~is_near).tolist()


def raise_places(svg):
    row, column = np.divmod(np.arange(PLACES * PLACES), PLACES)
    lattice = Lattice.from_layout("square", PixelLayout(column * 1e-3, row * 1e-3, row, column))
    return compute_lattice_heights(svg.encode(), lattice, "t").reshape(PLACES, PLACES)[::-1] > 0.0


@pytest.mark.parametrize("name", DRAWINGS)
def test_the_display_raises_what_chromium_shows(sheet, name):
    svg = SVG.format(DRAWINGS[name])
    ink = show(sheet, svg)
    assert ink.any()
    assert find_errors(raise_places(svg), ink) == ([], [])


def test_the_judge_sees_a_line_too_many_and_one_too_few(sheet):
    one, two = SVG.format(LINE), SVG.format(f'{LINE}<path d="M2 17H18" stroke="#000"/>')
    assert find_errors(raise_places(two), show(sheet, one))[0]
    assert find_errors(raise_places(one), show(sheet, two))[1]
