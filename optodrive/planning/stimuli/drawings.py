"""Frames from SVG drawings, whose lines stand at three heights: those of a graph's grid, axes and curve.

A drawing is rendered as a browser shows it on white paper, without text, pictures and filters, fitted into the lattice
and centred. A line is what is thinner than LINE_PLACES and has one colour on both sides; a wider area is shown by its
outline, and so is a change of colour. Each place that a line meets rises to the height of its class, where lines meet
to the highest. The classes are told apart by one further picture per class, in which the others are hidden.

What a file may cost is bounded before it is rendered: its elements and characters are counted after the expansion of
everything that is referred to, which the file may multiply.
"""

import re
from collections.abc import Iterator
from copy import deepcopy
from io import BytesIO
from math import isfinite
from typing import NamedTuple
from xml.etree.ElementTree import Element, ParseError, SubElement, tostring

import numpy as np
from defusedxml import DefusedXmlException
from defusedxml.ElementTree import fromstring
from numpy.typing import NDArray

from optodrive.core.errors import MISSING, InputError, Unquoted, build_nothing_raised_error
from optodrive.core.extras import import_extra
from optodrive.core.types.arrays import BoolArray, FloatArray, IntArray
from optodrive.core.types.stimuli import FrameSequence, TactileFrame
from optodrive.device.config import Config
from optodrive.planning.stimuli.ilda import convert_ilda, is_ilda
from optodrive.planning.stimuli.pixel_lattice import Lattice
from optodrive.planning.stimuli.refresh import BeamTimeEstimator, hold_picture, sequence_end_s

HEIGHT_BY_CLASS = {"grid": 1 / 3, "axes": 2 / 3, "curve": 1.0}
"""Share of the full height by class of an element, or of the nearest element around it that has one of these."""
DEFAULT_CLASS = "curve"
SAMPLES_PER_PLACE = 12
LINE_PLACES = 1.75
"""Largest width of a line along a row or column, in places of the lattice: a line of one place in any direction."""
CONTRAST_MIN = 3
"""Smallest difference of neighbouring samples, of 255, that is an edge: rounding makes smaller ones."""
SMOOTH_SAMPLES = 2
"""Samples over which an edge is smoothed."""

FILE_BYTES_MAX = 8_000_000
ELEMENTS_MAX = 10_000
"""Elements of a drawing after expansion, in all its pictures; a thousand take up to 0.3 s."""
LAYER = re.compile("clip-path|mask|opacity|filter|mix-blend-mode|isolation")
"""Properties for which an element is rendered into a picture of its own."""
LAYER_ELEMENTS = 10
"""Elements that take as long as one with such a property."""
ATTRIBUTES_MAX = 200
"""Attributes of an element, each of which the renderer compares with all others."""
CHARACTERS_MAX = 8_000_000
"""Characters of all attributes after expansion."""
DEPTH_MAX = 100
"""Nesting after expansion, which takes a picture's memory per level."""
STYLE_COST_MAX = 200_000_000
"""Characters of style sheets times elements."""

SVG = "http://www.w3.org/2000/svg"
REFERENCE = re.compile(r"url\(\s*['\"]?\s*#([^'\")\s]+)")
NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
LENGTH = re.compile(rf"({NUMBER.pattern})\s*(px|pt|pc|mm|cm|in|)")
PX_PER_UNIT = {"": 1.0, "px": 1.0, "pt": 4 / 3, "pc": 16.0, "mm": 96 / 25.4, "cm": 96 / 2.54, "in": 96.0}
HIDDEN = ("defs", "symbol", "clipPath", "mask", "marker", "pattern")
"""Elements whose content is shown only where others refer to it."""
SHAPES = ("path", "rect", "circle", "ellipse", "line", "polyline", "polygon", "use")
PICTURES = ("image", "feImage")
"""Elements that show other files, also of the computer that renders."""


class _Cost(NamedTuple):
    """Elements, characters of attributes and depth of an element after expansion."""

    elements: int = 0
    characters: int = 0
    depth: int = 0

    def add(self, other: "_Cost", times: int = 1) -> "_Cost":
        elements = self.elements + times * other.elements
        return _Cost(elements, self.characters + times * other.characters, max(self.depth, other.depth))


def build_drawing(config: Config, where: str, file: bytes, height_m: float, seconds: float) -> FrameSequence:
    """Build frames that show an SVG drawing, or each picture of an ILDA file, for `seconds`, class `curve` at height_m.

    Raises InputError (bad_picture, too_many, raises_nothing, and without resvg_py missing_extra).
    """
    lattice = Lattice.from_config(config)
    place, estimator = f"{where}: file", BeamTimeEstimator(config)
    pictures = convert_ilda(file, place) if is_ilda(file) else [file]
    frames: list[TactileFrame] = []
    start_s = 0.0
    for number, picture in enumerate(pictures, start=1):
        if picture is None:  # a dark one
            start_s += seconds
            continue
        target_m = height_m * compute_lattice_heights(picture, lattice, place)
        name = "drawing" if len(pictures) == 1 else f"drawing-{number}"
        frames += hold_picture(estimator, target_m, seconds, name, start_s)
        start_s = sequence_end_s(FrameSequence(tuple(frames[-1:])))
    if not frames:
        raise build_nothing_raised_error(place, "all its points are blanked or black", "a drawing with lines")
    return FrameSequence(frames=tuple(frames))


def compute_lattice_heights(file: bytes, lattice: Lattice, where: str) -> FloatArray:
    """Compute the height of each pixel as a share of the full one, 0…1, [p]."""
    root = _parse(file, where)
    shapes = list(_list_shapes(root))
    # The lowest class has no picture of its own: it is what no other picture shows.
    present = sorted({name for name, _, _ in shapes}, key=lambda name: HEIGHT_BY_CLASS[name])
    _check_cost(root, max(1, len(present)), where)
    shape = lattice.index.shape
    raised = _find_lines(_render(root, shape, where))
    heights = np.where(raised, HEIGHT_BY_CLASS[present[0]] if present else 0.0, 0.0)
    for name in present[1:]:
        picture = deepcopy(root)
        for other, parent, index in list(_list_shapes(picture)):
            if other != name:
                cover = Element(f"{{{SVG}}}g", {"style": "display:none"})
                cover.append(parent[index])
                parent[index] = cover
        heights[raised & _find_lines(_render(picture, shape, where))] = HEIGHT_BY_CLASS[name]
    values: FloatArray = heights[::-1][lattice.layout.row, lattice.layout.column]
    if not values.any():
        if raised.any():
            reason = "its lines lie where the display has no pixel"
        else:
            reason = "every shape is white, hidden or outside its viewBox" if shapes else "it has no shape"
        expected = "a drawing with lines that differ from white; text and pictures are not shown"
        raise build_nothing_raised_error(where, reason, expected)
    return values


def _parse(file: bytes, where: str) -> Element:
    """Parse a drawing without its pictures and filters. Raise InputError (bad_picture, too_many)."""
    if len(file) > FILE_BYTES_MAX or file.count(b"<") > 4 * ELEMENTS_MAX:
        found = Unquoted(f"{len(file)} bytes with {file.count(b'<')} tags")
        raise InputError(where, found, f"at most {FILE_BYTES_MAX} bytes, {4 * ELEMENTS_MAX} tags", code="too_many")
    try:
        root: Element = fromstring(file)
    except DefusedXmlException:
        raise InputError(where, Unquoted("entities"), "an SVG drawing without any", code="bad_picture") from None
    except (ParseError, ValueError, LookupError) as error:  # an unknown encoding is none of the parser's own errors
        raise InputError(where, file[:16], f"an SVG drawing ({error})", code="bad_picture") from None
    if _get_name(root) != "svg":
        raise InputError(where, root.tag[:80], "an SVG drawing, whose root is svg", code="bad_picture")
    for element in root.iter():
        if len(element.attrib) > ATTRIBUTES_MAX:
            raise _too_much_error(where, f"{len(element.attrib)} attributes of an element")
        if not element.tag.startswith("{"):
            element.tag = f"{{{SVG}}}{element.tag}"  # a drawing cut from a page of HTML states no namespace
        for child in [each for each in element if _get_name(each) in PICTURES]:
            element.remove(child)
        if _get_name(element) == "filter":
            element[:] = [Element(f"{{{SVG}}}feOffset")]  # blurs and shadows are nothing for fingers
    return root


def _get_name(element: Element) -> str:
    return element.tag.rpartition("}")[2]


def _check_cost(root: Element, pictures: int, where: str) -> None:
    """Raise InputError (too_many) for a drawing that takes too much work to render."""
    known: dict[Element, _Cost] = {}
    targets = {name: element for element in root.iter() if (name := element.get("id"))}
    style = "".join(element.text or "" for element in root.iter() if _get_name(element) == "style")
    styled = [targets[name] for name in REFERENCE.findall(style) if name in targets]
    styles_layers = LAYER.search(style) is not None
    markers = [element for element in root.iter() if _get_name(element) == "marker"]

    def measure(element: Element, path: frozenset[Element]) -> _Cost:
        if len(path) > DEPTH_MAX:
            raise _too_much_error(where, f"deeper nesting than {DEPTH_MAX}")
        if element in path:  # a renderer does not follow a reference to what is around it
            return _Cost()
        if element not in known:
            inner, values = path | {element}, list(element.attrib.values())
            links = [value[1:] for key, value in element.attrib.items() if key.endswith("href") and value[:1] == "#"]
            names = links + [name for value in values for name in REFERENCE.findall(value)]
            has_layer = styles_layers or LAYER.search(" ".join([*element.attrib, element.get("style", "")]))
            cost = _Cost(LAYER_ELEMENTS if has_layer else 1, sum(map(len, values)))
            for child in (*element, *(targets[name] for name in names if name in targets)):
                cost = cost.add(measure(child, inner))
            if _get_name(element) in SHAPES and not path & set(styled) and not path & set(markers):
                for target in styled:
                    cost = cost.add(measure(target, inner))
                points = len(NUMBER.findall(element.get("d", "") + " " + element.get("points", "")))
                for marker in markers if points else ():
                    cost = cost.add(measure(marker, inner), points)
            known[element] = cost._replace(depth=cost.depth + 1)
        return known[element]

    cost = measure(root, frozenset())
    if cost.elements * pictures > ELEMENTS_MAX:
        raise _too_much_error(where, f"{cost.elements} elements in {pictures} pictures")
    if cost.characters > CHARACTERS_MAX:
        raise _too_much_error(where, f"{cost.characters} characters")
    if cost.depth > DEPTH_MAX:
        raise _too_much_error(where, f"{cost.depth} levels of nesting")
    if len(style) * cost.elements > STYLE_COST_MAX:
        raise _too_much_error(where, f"{len(style)} characters of style sheets for {cost.elements} elements")


def _too_much_error(where: str, found: str) -> InputError:
    expected = f"a drawing that has, with all that it uses, at most {ELEMENTS_MAX} elements, of which clipped or "
    expected += f"transparent ones count {LAYER_ELEMENTS}, {CHARACTERS_MAX} characters and {DEPTH_MAX} levels"
    return InputError(where, Unquoted(found if len(found) < 120 else "far more elements"), expected, code="too_many")


def _list_shapes(root: Element) -> Iterator[tuple[str, Element, int]]:
    """Yield the class of each shape that is drawn where it stands, with its parent and its index there."""
    targets = {element.get("id"): element for element in root.iter()}
    waiting = [(root, DEFAULT_CLASS)]
    while waiting:
        parent, around = waiting.pop()
        around = _find_class(parent, around)
        for index, child in enumerate(parent):
            name = _get_name(child)
            if name in SHAPES:
                href = next((value for key, value in child.attrib.items() if key.endswith("href")), "")
                used = targets.get(href[1:])
                own = _find_class(child, around)
                yield own if used is None else _find_class(used, own), parent, index
            elif name not in HIDDEN:
                waiting.append((child, around))


def _find_class(element: Element, around: str) -> str:
    return next((name for name in element.get("class", "").split() if name in HEIGHT_BY_CLASS), around)


def _render(root: Element, shape: tuple[int, ...], where: str) -> NDArray[np.uint8]:
    """Render a drawing on white, fitted into the lattice and centred, [samples down, samples across, 3]."""
    from PIL import Image

    resvg = import_extra("resvg_py", extra="reading")
    height, width = (places * SAMPLES_PER_PLACE for places in shape)
    left, top, across, down = _read_view_box(root, where)
    scale = min(width / across, height / down)
    paper = Element(f"{{{SVG}}}svg", {"width": str(width), "height": str(height)})
    drawing = SubElement(paper, root.tag, root.attrib)
    drawing[:] = root[:]
    size = {"x": (width - across * scale) / 2, "y": (height - down * scale) / 2}
    size |= {"width": across * scale, "height": down * scale}
    drawing.attrib |= {name: f"{value:.9g}" for name, value in size.items()}
    drawing.attrib |= {"viewBox": f"{left!r} {top!r} {across!r} {down!r}", "preserveAspectRatio": "none"}
    text = tostring(paper, encoding="unicode", default_namespace=None)
    try:
        png = resvg.svg_to_bytes(svg_string=text, background="#fff", skip_system_fonts=True, languages=["en"])
    except ValueError as error:
        raise InputError(where, Unquoted("a drawing"), f"an SVG drawing ({error})", code="bad_picture") from None
    with Image.open(BytesIO(png)) as image:
        return np.asarray(image.convert("RGB"))


def _read_view_box(root: Element, where: str) -> tuple[float, float, float, float]:
    """Return the part of the plane that a drawing shows: left, top, width, height. Raise InputError (bad_picture)."""
    stated = root.get("viewBox")
    if stated is None:
        lengths = [LENGTH.fullmatch((root.get(name) or "").strip()) for name in ("width", "height")]
        sizes = [float(length[1]) * PX_PER_UNIT[length[2]] for length in lengths if length is not None]
        found: object = MISSING if len(sizes) < 2 else f"{sizes[0]:g} × {sizes[1]:g}"
        values = [0.0, 0.0, *sizes]
    else:
        found, words = stated[:40], stated.replace(",", " ").split()[:5]
        values = [float(word) if NUMBER.fullmatch(word) else float("nan") for word in words]
    if len(values) != 4 or not all(map(isfinite, values)) or min(values[2:]) <= 0.0:
        expected = "an SVG drawing with a viewBox of four numbers, or with width and height"
        raise InputError(f"{where}: viewBox", found, expected, code="bad_picture")
    return values[0], values[1], values[2], values[3]


def _find_lines(picture: NDArray[np.uint8]) -> BoolArray:
    """Return the places that lines and outlines meet, [rows from the top, columns].

    Every row and column of samples is searched: the middle of a line in any direction lies on the line's middle.
    Edges that only one search sees may be those of a line along it, whose middle the other one has found.
    """
    padded = np.pad(picture.astype(np.int16), ((1, 1), (1, 1), (0, 0)), constant_values=255)
    (lines, steps, inside), (lines_down, steps_down, inside_down) = (
        _search_rows(padded),
        (each.T for each in _search_rows(padded.transpose(1, 0, 2))),
    )
    marks = lines | lines_down | steps & ~inside_down | steps_down & ~inside
    height, width = (size // SAMPLES_PER_PLACE for size in picture.shape[:2])
    blocks = marks[1:-1, 1:-1].reshape(height, SAMPLES_PER_PLACE, width, SAMPLES_PER_PLACE)
    return np.asarray(blocks.any(axis=(1, 3)))


def _search_rows(picture: NDArray[np.int16]) -> tuple[BoolArray, BoolArray, BoolArray]:
    """Return the middles of lines, the places of other edges, and all that lies within lines, each [samples]."""
    lines, steps = np.zeros((2, *picture.shape[:2]), dtype=np.bool_)
    inside = np.zeros(picture.shape[:2], dtype=np.int8)
    row, at = np.nonzero(np.abs(np.diff(picture, axis=1)).max(axis=2) >= CONTRAST_MIN)
    if not len(row):
        return lines, steps, inside > 0
    begins = np.flatnonzero(np.diff(row, prepend=-1) | (np.diff(at, prepend=-9) > SMOOTH_SAMPLES))
    row, first, last = row[begins], at[begins], at[np.append(begins[1:], len(at)) - 1] + 1
    before, after = picture[row, first], picture[row, last]
    width_max = LINE_PLACES * SAMPLES_PER_PLACE
    is_thin = _are_alike(before, after)
    is_near = np.zeros(len(row), dtype=np.bool_)
    is_near[:-1] = (np.diff(row) == 0) & (last[1:] - first[:-1] - 1 <= width_max)
    opens = _take_pairs(is_near & ~is_thin & ~np.append(is_thin[1:], True) & _are_alike(before, np.roll(after, -1, 0)))
    for index in (np.flatnonzero(is_thin), np.flatnonzero(opens)):
        ends = last[index + opens[index]]
        lines[row[index], (first[index] + ends) // 2] = True
        np.add.at(inside, (row[index], np.maximum(first[index] - SMOOTH_SAMPLES, 0)), 1)
        np.add.at(inside, (row[index], np.minimum(ends + 1 + SMOOTH_SAMPLES, picture.shape[1] - 1)), -1)
    rest = np.flatnonzero(~(is_thin | opens | np.roll(opens, 1)))
    joined = _take_pairs(is_near[rest] & (np.diff(rest, append=-9) == 1))
    second = np.roll(joined, 1)
    steps[row[rest], (first[rest] + np.where(joined, np.roll(last[rest], -1), last[rest])) // 2] |= ~second
    return lines, steps, np.cumsum(inside, axis=1) > 0


def _take_pairs(may_open: BoolArray) -> BoolArray:
    """Return which edges open a pair with the next one, each edge in one pair at most."""
    index: IntArray = np.arange(len(may_open))
    position = index - np.maximum.accumulate(np.where(may_open, -1, index))
    return np.asarray(may_open & (position % 2 == 1))


def _are_alike(one: NDArray[np.int16], other: NDArray[np.int16]) -> BoolArray:
    alike: BoolArray = np.abs(one - other).max(axis=1) < 2 * CONTRAST_MIN
    return alike
