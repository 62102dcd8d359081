"""The report on a display: a map of what each pixel suffers from, and a table; one HTML file, without scripts."""

from collections.abc import Iterator
from dataclasses import dataclass
from html import escape
from math import ceil, sqrt

from optodrive.core.html_page import page, table
from optodrive.core.types.discrepancy import Discrepancy
from optodrive.device.config import Config, pixel_layout
from optodrive.lab.diagnosis.display_diagnosis import DisplayAnswer, Group, PixelAnswer
from optodrive.lab.diagnosis.display_narrative import display_story, headline, meaning, ranges
from optodrive.lab.diagnosis.narrative import quantity

COLOURS = ("#e69f00", "#56b4e9", "#009e73", "#f0e442", "#5e9bd6", "#d55e00", "#cc79a7", "#b39ddb")
"""Told apart by colour-blind readers too (Okabe and Ito's, lightened for the letters on them)."""
LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"
CELL = 20
PLAIN, DOUBT, FAILED = "#e8e8e8", "#bdbdbd", "#ffffff"


@dataclass(frozen=True)
class Mark:
    """How pixels of one kind are drawn, and what that means."""

    letter: str
    colour: str
    meaning: str


def display_report(found: DisplayAnswer, title: str, config: Config | None) -> str:
    """HTML. config: says where pixels lie."""
    marks = _marks(found)
    places, where = _places(found, config)
    body = [
        f"<h2>Map</h2><p>{escape(where)} Each mark tells its pixel's answer where the pointer rests.</p>",
        _map(found, marks, places),
        table(("", "pixels", "", "which"), _legend(found, marks), frozenset({1})),
        "<h2>Pixels</h2>",
        table(("pixel", "verdict", "sizes, 95 %", "gain"), (_row(item) for item in found.pixels), frozenset({0})),
    ]
    return page(title, headline(found), display_story(found), body)


def _marks(found: DisplayAnswer) -> dict[int, Mark]:
    """Of each pixel: a letter and a colour for each set of causes, signs for what has none."""
    out = {item.pixel: Mark("×", FAILED, "without an answer") for item in found.failed if item.pixel is not None}
    named = 0
    for group in found.groups():
        if group.verdict == "cause":
            mark = Mark(LETTERS[named % len(LETTERS)], COLOURS[named % len(COLOURS)], meaning(group))
            named += 1
        else:
            mark = _sign(group)
        out |= dict.fromkeys(group.pixels, mark)
    return out


def _sign(group: Group) -> Mark:
    if group.verdict == "none":
        return Mark("·", PLAIN, meaning(group))
    return Mark("?" if group.verdict == "ambiguous" else "!", DOUBT, meaning(group))


def _places(found: DisplayAnswer, config: Config | None) -> tuple[dict[int, tuple[int, int]], str]:
    """Column and row, from the top, of every place drawn; and which lattice that is."""
    measured = [item.pixel for item in found.pixels if item.pixel is not None]
    if config is not None and max(measured) < (layout := len(pixel_layout(config.display))):
        row, column = pixel_layout(config.display).row, pixel_layout(config.display).column
        places = {pixel: (int(column[pixel]), config.display.rows - 1 - int(row[pixel])) for pixel in range(layout)}
        return places, f"Pixels where they lie on {config.name}, seen from the front; empty: not measured."
    side = ceil(sqrt(len(measured)))
    why = "no place is known" if config is None else f"{config.name} has no pixel {max(measured)}"
    places = {pixel: (at % side, at // side) for at, pixel in enumerate(measured)}
    return places, f"Pixels by index, row by row from the top left; {why}."


def _map(found: DisplayAnswer, marks: dict[int, Mark], places: dict[int, tuple[int, int]]) -> str:
    by_pixel = {item.pixel: item for item in found.pixels}
    wide, high = (CELL * (1 + max(place[axis] for place in places.values())) for axis in (0, 1))
    drawn = []
    for pixel, (column, row) in places.items():
        x, y = column * CELL, row * CELL
        box = f"<rect x='{x + 1}' y='{y + 1}' width='{CELL - 2}' height='{CELL - 2}' rx='3' stroke='#999'"
        mark = marks.get(pixel)
        if mark is None:
            drawn.append(f"<g><title>pixel {pixel}: not measured</title>{box} stroke-dasharray='2' fill='none'/></g>")
            continue
        drawn.append(
            f"<g><title>{escape(_tooltip(by_pixel[pixel], mark))}</title>{box} fill='{mark.colour}'/>"
            f"<text x='{x + CELL / 2:g}' y='{y + CELL / 2 + 4:g}' text-anchor='middle'>{mark.letter}</text></g>"
        )
    size = f"max-width:{max(12, 1.6 * wide / CELL):g}rem"
    return f"<svg viewBox='0 0 {wide} {high}' style='{size}' role='img'>{''.join(drawn)}</svg>"


def _tooltip(item: PixelAnswer, mark: Mark) -> str:
    if item.found is None:
        return f"pixel {item.pixel}: {item.error}"
    return "; ".join([f"pixel {item.pixel}: {mark.meaning}", *_sizes(item.found)])


def _legend(found: DisplayAnswer, marks: dict[int, Mark]) -> Iterator[tuple[str, ...]]:
    groups = [group.pixels for group in found.groups()]
    for pixels in [*groups, [item.pixel for item in found.failed if item.pixel is not None]]:
        if pixels:
            mark = marks[pixels[0]]
            sample = (
                "<svg viewBox='0 0 20 20' style='width:20px;border:0'>"
                f"<rect x='1' y='1' width='18' height='18' rx='3' stroke='#999' fill='{mark.colour}'/>"
                f"<text x='10' y='14' text-anchor='middle'>{mark.letter}</text></svg>"
            )
            yield sample, str(len(pixels)), escape(mark.meaning), ranges(pixels)


def _row(item: PixelAnswer) -> tuple[str, ...]:
    found = item.found
    if found is None:
        return str(item.pixel), escape(item.error), "", ""
    gain = "" if found.gain is None else f"{found.gain.reduction:.0%}"
    verdict = ", ".join([found.verdict, *found.causes]) if found.causes else found.verdict
    return str(item.pixel), escape(verdict), "<br>".join(escape(size) for size in _sizes(found)), gain


def _sizes(found: Discrepancy) -> list[str]:
    """The causes' numbers with their intervals."""
    return [
        f"{name} {quantity(item.value, item.unit)} "
        f"({quantity(item.low, item.unit)} to {quantity(item.high, item.unit)})"
        for name, item in found.parameters.items()
        if "." in name and found.verdict in ("cause", "ambiguous")
    ]
