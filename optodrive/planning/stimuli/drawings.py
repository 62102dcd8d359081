"""Frames from SVG drawings, whose lines stand at three heights: those of a graph's grid, axes and curve.

A drawing is fitted into the lattice and centred. Its lines are sampled more densely than the lattice, and each place
that a line meets rises to the height of its class, where lines meet to the highest. Areas are shown by their outline;
text is not.
"""

from collections.abc import Iterator
from io import BytesIO
from math import ceil, isfinite
from typing import TYPE_CHECKING, Any

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.extras import import_extra
from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.stimuli import FrameSequence
from optodrive.device.config import Config
from optodrive.planning.stimuli.pixel_lattice import Lattice
from optodrive.planning.stimuli.refresh import BeamTimeEstimator, hold_picture

if TYPE_CHECKING:
    from types import ModuleType

HEIGHT_BY_CLASS = {"grid": 1 / 3, "axes": 2 / 3, "curve": 1.0}
"""Share of the full height by class of an element, or of the nearest element around it that has one of these."""
DEFAULT_CLASS = "curve"
SAMPLES_PER_PLACE = 8
POINTS_MAX = 1_000_000
"""Sampled points of a drawing."""


def build_drawing(config: Config, where: str, file: bytes, height_m: float, seconds: float) -> FrameSequence:
    """Build frames that show an SVG drawing for `seconds`, class `curve` at height_m.

    Raises InputError (bad_picture, too_many, and without svgelements missing_extra).
    """
    lattice = Lattice.from_config(config)
    target_m = height_m * compute_lattice_heights(file, lattice, f"{where}: file")
    return FrameSequence(frames=tuple(hold_picture(BeamTimeEstimator(config), target_m, seconds, "drawing")))


def compute_lattice_heights(file: bytes, lattice: Lattice, where: str) -> FloatArray:
    """Compute the height of each pixel as a share of the full one, 0…1, [p]."""
    svg = import_extra("svgelements", extra="reading")
    drawing = _parse(svg, file, where)
    rows, columns = lattice.index.shape
    scale = max(drawing.height / rows, drawing.width / columns)  # units of the drawing per place
    heights, points = np.zeros((rows, columns)), 0
    for share, samples in _sample_lines(svg, drawing, scale / SAMPLES_PER_PLACE):
        points += len(samples)
        if points > POINTS_MAX:
            raise InputError(where, f"more than {POINTS_MAX} points", "fewer or shorter lines", code="too_many")
        across = np.floor(columns / 2 + (samples[:, 0] - drawing.width / 2) / scale)
        down = np.floor(rows / 2 + (samples[:, 1] - drawing.height / 2) / scale)
        inside = (across >= 0) & (across < columns) & (down >= 0) & (down < rows)
        place = rows - 1 - down[inside].astype(int), across[inside].astype(int)
        np.maximum.at(heights, place, share)
    values: FloatArray = heights[lattice.layout.row, lattice.layout.column]
    if not values.any():
        raise InputError(where, "no line on the display", "a drawing with lines", code="bad_picture")
    return values


def _parse(svg: "ModuleType", file: bytes, where: str) -> Any:
    """Parse a drawing. Raise InputError (bad_picture) if it is none, or has no size."""
    try:
        drawing = svg.SVG.parse(BytesIO(file))
        sizes = float(drawing.width), float(drawing.height)
    except Exception as error:  # the library raises what its input happens to break
        reason = " ".join(str(error).split())[:80]
        raise InputError(where, f"{len(file)} bytes", f"an SVG drawing ({reason})", code="bad_picture") from None
    if not all(isfinite(size) and size > 0.0 for size in sizes):
        raise InputError(where, f"{sizes[0]:g} × {sizes[1]:g}", "an SVG drawing with a viewBox", code="bad_picture")
    return drawing


def _sample_lines(svg: "ModuleType", drawing: Any, step: float) -> Iterator[tuple[float, FloatArray]]:
    """Yield the height's share and points [n, 2] along each segment, at most `step` apart."""
    for name, shape in _walk(svg, drawing, DEFAULT_CLASS):
        for segment in svg.Path(shape).segments():
            if isinstance(segment, svg.Move):
                continue
            # The way between five points of a curve is at most a tenth too short; SAMPLES_PER_PLACE covers that.
            corners = np.array([(point.x, point.y) for point in map(segment.point, np.linspace(0.0, 1.0, 5))])
            length = float(np.hypot(*np.diff(corners, axis=0).T).sum())
            if not isfinite(length):
                continue
            shares = np.linspace(0.0, 1.0, min(POINTS_MAX, ceil(length / step)) + 1)
            yield HEIGHT_BY_CLASS[name], _compute_points(svg, segment, shares)


def _compute_points(svg: "ModuleType", segment: Any, shares: FloatArray) -> FloatArray:
    if isinstance(segment, svg.Line | svg.Close):
        start, end = (np.array([point.x, point.y]) for point in (segment.start, segment.end))
        return np.asarray(start + shares[:, None] * (end - start))
    return np.array([(point.x, point.y) for point in map(segment.point, shares)])


def _walk(svg: "ModuleType", element: Any, name: str) -> Iterator[tuple[str, Any]]:
    """Yield the class and each shape of an element and of those within it."""
    classes = (element.values.get("class") or "").split() if element.values else []
    name = next((each for each in classes if each in HEIGHT_BY_CLASS), name)
    if isinstance(element, svg.Shape):
        yield name, element
    elif isinstance(element, list):  # SVG, Group, Use
        for child in element:
            yield from _walk(svg, child, name)
