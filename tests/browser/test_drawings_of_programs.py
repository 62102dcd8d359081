"""Drawings that Matplotlib, Inkscape and LaTeX write here, and some in the habits of TactileView, against Chromium."""

import subprocess

import numpy as np
import pytest

from test_drawings_as_rendered import PIXELS_PER_PLACE, find_errors, raise_places, show

pytestmark = pytest.mark.slow
T = np.linspace(0.0, 6.3, 120)


def plot(ax):
    ax.plot(T, np.sin(T))
    ax.grid(visible=True)


def polar(ax):
    ax.set_theta_zero_location("N")
    ax.plot(T, 1 + np.cos(3 * T))


MATPLOTLIB = {
    "plot": plot,
    "scatter": lambda ax: ax.scatter(T[::12], np.cos(T[::12]), marker="x"),
    "bars": lambda ax: ax.bar(range(5), [3, 1, 4, 1, 5], fill=False),
    "filled bars": lambda ax: ax.bar(range(4), [3, 1, 4, 2], hatch="/", edgecolor="k"),
    "contour": lambda ax: ax.contour(np.hypot(*np.mgrid[-2:2:20j, -2:2:20j])),
    "polar": polar,
    "error bars": lambda ax: ax.errorbar(range(5), [1, 2, 1, 3, 2], yerr=0.4, capsize=4),
    "band": lambda ax: ax.fill_between(T, np.sin(T), np.sin(T) + 1, alpha=0.4),
    "steps": lambda ax: ax.step(range(8), [1, 3, 2, 5, 4, 4, 1, 0], linestyle="--"),
    "arrows": lambda ax: ax.quiver(*np.meshgrid(range(4), range(4)), *np.meshgrid([1, 2, 1, 0], [1, 1, 0, 1])),
}
HEAD = '<svg xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink" width="100mm" height="{}mm" '
TEXT = '<text x="10" y="50" font-size="40" font-family="DejaVu Sans">Aq</text>'
INKSCAPE = {
    "text as paths": (f"<g>{TEXT}</g>", "select-all:all;object-to-path"),
    "a stroke as a path": (
        '<path d="M10 10C40 90 60 -20 90 60" fill="none" stroke="#000" stroke-width="3"/>',
        "select-all:all;object-stroke-to-path",
    ),
    "a layer, turned": (
        '<g transform="rotate(20 50 50)"><rect x="20" y="20" width="50" height="30" fill="none" stroke="#a00"/></g>',
        "select-all:groups;object-rotate-90-cw",
    ),
    "clones": (
        '<circle id="c" cx="20" cy="20" r="12" fill="none" stroke="#00f" stroke-width="2"/>'
        '<use xlink:href="#c" x="40" y="30"/><use xlink:href="#c" transform="translate(10 50) scale(1.4 .8)"/>',
        "select-all:all",
    ),
    "a union": (
        '<circle cx="40" cy="40" r="25" fill="#080"/><circle cx="60" cy="60" r="25" fill="#080"/>',
        "select-all:all;path-union",
    ),
    "a difference": (
        '<rect x="10" y="10" width="80" height="80" fill="#555"/><circle cx="50" cy="50" r="25" fill="#000"/>',
        "select-all:all;path-difference",
    ),
}
TIKZ = {
    "axes": r"\draw[help lines] (0,0) grid (4,3); \draw[->,thick] (0,0)--(4.2,0); \draw[->,thick] (0,0)--(0,3.2);"
    r"\draw plot[smooth,domain=0:4] (\x,{1.5+sin(90*\x)});",
    "a circuit": r"\draw (0,0)--(1,0)--(1,.3) rectangle (2,-.3) (2,0)--(3,0)--(3,2)--(0,2)--cycle;"
    r"\fill (3,2) circle (3pt);",
    "a formula": r"\node[scale=3] {$\displaystyle\int_0^1\sqrt{x}\,dx$};",
    "a tree": r"\node[circle,draw]{a} child{node[draw]{b}} child{node[circle,draw]{c} child{node{d}}};",
    "patterns": r"\draw[dashed] (0,0) circle (1); \draw[clip] (1,0) circle (1); \draw (0,-1)--(2,1) (0,0)--(2,0);",
}
TACTILE_VIEW = {
    "a map": '<rect x="0" y="0" width="210" height="148" fill="#FFFFFF"/>'
    '<g stroke="#000000" stroke-width="1.5" fill="none">'
    '<polyline points="10,10 100,40 190,30"/><polygon points="40,70 120,60 150,120 60,130"/></g>',
    "a diagram": '<g fill="none" stroke="rgb(0,0,0)" stroke-width="1"><line x1="20" y1="130" x2="200" y2="130"/>'
    '<line x1="20" y1="130" x2="20" y2="10"/></g><path d="M 20 130 Q 90 -60 190 120" fill="none" stroke="black"/>',
    "braille dots": "".join(
        f'<circle cx="{30 + 2.5 * (k % 2) * 8}" cy="{30 + 2.5 * (k // 2) * 8}" r="6" fill="#000000"/>'
        for k in (0, 1, 3, 4)
    )
    + '<line x1="10" y1="110" x2="200" y2="110" stroke="#000000" stroke-width="2" stroke-dasharray="8,4"/>',
    "a filled area": '<ellipse cx="105" cy="74" rx="80" ry="50" fill="#C0C0C0" stroke="#000000" stroke-width="2"/>'
    '<text x="60" y="140" font-family="Braille" font-size="1" fill="none">area</text>',
}

AREAS = ("a union", "a difference", "a filled area")
"""Drawings with an area that is wider than a line: it is outlined, and its inside is not raised."""
INSIDE = PIXELS_PER_PLACE


def run(folder, *command):
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]


def draw_by_matplotlib(folder, name):
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4, 4))
    FigureCanvasSVG(figure)
    MATPLOTLIB[name](figure.add_subplot(projection="polar" if name == "polar" else None))
    figure.savefig(folder / "m.svg")
    return (folder / "m.svg").read_text()


def draw_by_inkscape(folder, name, *options):
    shapes, actions = INKSCAPE[name]
    (folder / "in.svg").write_text(f'{HEAD.format(100)}viewBox="0 0 100 100">{shapes}</svg>')
    do = f"--actions={actions};export-filename:out.svg;export-do"
    run(folder, "inkscape", "in.svg", *options, do)
    return (folder / "out.svg").read_text()


def write_tex(folder, name, setting):
    head = rf"\documentclass{{article}}{setting}\usepackage{{tikz}}\pagestyle{{empty}}\parindent0pt"
    (folder / "d.tex").write_text(
        rf"{head}\begin{{document}}\begin{{tikzpicture}}{TIKZ[name]}\end{{tikzpicture}}\end{{document}}"
    )


def draw_by_dvisvgm(folder, name):
    write_tex(folder, name, r"\def\pgfsysdriver{pgfsys-dvisvgm.def}")
    run(folder, "latex", "-interaction=nonstopmode", "d.tex")
    run(folder, "dvisvgm", "--no-fonts", "--exact", "-o", "out.svg", "d.dvi")
    return (folder / "out.svg").read_text()


def draw_by_pdftocairo(folder, name):
    write_tex(folder, name, r"\usepackage[paperwidth=60mm,paperheight=60mm,margin=4mm]{geometry}")
    run(folder, "pdflatex", "-interaction=nonstopmode", "d.tex")
    run(folder, "pdftocairo", "-svg", "d.pdf", "out.svg")
    return (folder / "out.svg").read_text()


def draw_as_tactile_view(folder, name):
    head = '<?xml version="1.0" encoding="utf-8"?>\n<svg xmlns="http://www.w3.org/2000/svg" version="1.1" '
    return f'{head}width="210mm" height="148mm" viewBox="0 0 210 148">{TACTILE_VIEW[name]}</svg>'


CASES = [
    *((draw_by_matplotlib, name) for name in MATPLOTLIB),
    *((draw_by_inkscape, name) for name in INKSCAPE),
    *((draw_by_dvisvgm, name) for name in TIKZ),
    *((draw_by_pdftocairo, name) for name in TIKZ),
    *((draw_as_tactile_view, name) for name in TACTILE_VIEW),
]


@pytest.fixture(scope="module")
def sheet(browser):
    page = browser.new_page(viewport={"width": 320, "height": 320})
    yield page
    page.close()


@pytest.mark.parametrize(("draw", "name"), CASES, ids=lambda value: getattr(value, "__name__", value))
def test_the_display_raises_what_chromium_shows(sheet, tmp_path, draw, name):
    svg = draw(tmp_path, name)
    ink = show(sheet, svg)
    assert ink.any()
    raised, missing = find_errors(raise_places(svg), ink)
    if name in AREAS:
        missing = [(y, x) for y, x in missing if not ink[y - INSIDE : y + INSIDE, x - INSIDE : x + INSIDE].all()]
    assert (raised, missing) == ([], [])


def test_there_are_thirty():
    assert len(CASES) == 30
