"""Report on a display: a map of the pixels' verdicts and a table, in one HTML file without scripts."""

from collections.abc import Iterator
from dataclasses import dataclass
from html import escape
from math import ceil, sqrt

from optodrive.core.html_page import render_page, render_table
from optodrive.core.provenance import Provenance
from optodrive.core.quantity import format_quantity
from optodrive.core.types.discrepancy import Discrepancy
from optodrive.device.config import Config, build_pixel_layout
from optodrive.lab.diagnosis.display_diagnosis import DisplayAnswer, PixelAnswer, PixelGroup
from optodrive.lab.diagnosis.display_narrative import (
    build_display_narrative,
    build_headline,
    describe_group,
    format_ranges,
)

COLOURS = ("#e69f00", "#56b4e9", "#009e73", "#f0e442", "#5e9bd6", "#d55e00", "#cc79a7", "#b39ddb")
"""Palette of Okabe and Ito, distinguishable by colour-blind readers, lightened for the letters on it."""
LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"
CELL_PX = 20
NOTHING_COLOUR, UNCERTAIN_COLOUR, FAILED_COLOUR = "#e8e8e8", "#bdbdbd", "#ffffff"


@dataclass(frozen=True)
class PixelMark:
    """Letter and colour of the pixels of one group, with their meaning."""

    letter: str
    colour: str
    meaning: str


def build_display_report(
    answer: DisplayAnswer, title: str, config: Config | None, provenance: Provenance | None = None
) -> str:
    """Return the report as HTML.

    config: provides the pixel layout
    """
    columns = ("pixel", "verdict", "parameters, 95 %", "gain")
    marks = _assign_marks(answer)
    positions, caption = _place_pixels(answer, config)
    body = [
        f"<h2>Map</h2><p>{escape(caption)} Hover over a mark for the pixel's answer.</p>",
        _draw_map(answer, marks, positions),
        render_table(("mark", "pixels", "meaning", "indices"), _build_legend(answer, marks), frozenset({1}), "Legend"),
        "<h2>Pixels</h2>",
        render_table(columns, (_build_row(item) for item in answer.pixels), frozenset({0}), "Pixels"),
    ]
    return render_page(title, build_headline(answer), build_display_narrative(answer), body, provenance)


def _assign_marks(answer: DisplayAnswer) -> dict[int, PixelMark]:
    """Return the mark of each pixel: a letter and a colour per set of causes, and signs for other verdicts."""
    out = {
        item.pixel: PixelMark("×", FAILED_COLOUR, "without an answer")
        for item in answer.failed
        if item.pixel is not None
    }
    named = 0
    for group in answer.build_groups():
        if group.verdict == "cause":
            mark = PixelMark(LETTERS[named % len(LETTERS)], COLOURS[named % len(COLOURS)], describe_group(group))
            named += 1
        else:
            mark = _build_sign(group)
        out |= dict.fromkeys(group.pixels, mark)
    return out


def _build_sign(group: PixelGroup) -> PixelMark:
    if group.verdict in ("none", "instrument"):
        return PixelMark("·", NOTHING_COLOUR, describe_group(group))
    return PixelMark("?" if group.verdict == "ambiguous" else "!", UNCERTAIN_COLOUR, describe_group(group))


def _place_pixels(answer: DisplayAnswer, config: Config | None) -> tuple[dict[int, tuple[int, int]], str]:
    """Return column and row from the top of every drawn pixel, and a caption for the layout."""
    measured = [item.pixel for item in answer.pixels if item.pixel is not None]
    if config is not None and max(measured) < (layout := len(build_pixel_layout(config.display))):
        row, column = build_pixel_layout(config.display).row, build_pixel_layout(config.display).column
        positions = {pixel: (int(column[pixel]), config.display.rows - 1 - int(row[pixel])) for pixel in range(layout)}
        return positions, f"Pixels at their places on {config.name}, front view; empty: not measured."
    side = ceil(sqrt(len(measured)))
    reason = "no layout is known" if config is None else f"{config.name} has no pixel {max(measured)}"
    positions = {pixel: (at % side, at // side) for at, pixel in enumerate(measured)}
    return positions, f"Pixels by index, row by row from the top left; {reason}."


def _draw_map(answer: DisplayAnswer, marks: dict[int, PixelMark], positions: dict[int, tuple[int, int]]) -> str:
    by_pixel = {item.pixel: item for item in answer.pixels}
    wide, high = (CELL_PX * (1 + max(position[axis] for position in positions.values())) for axis in (0, 1))
    elements = []
    for pixel, (column, row) in positions.items():
        x, y = column * CELL_PX, row * CELL_PX
        box = f"<rect x='{x + 1}' y='{y + 1}' width='{CELL_PX - 2}' height='{CELL_PX - 2}' rx='3' stroke='#999'"
        mark = marks.get(pixel)
        if mark is None:
            elements.append(
                f"<g><title>pixel {pixel}: not measured</title>{box} stroke-dasharray='2' fill='none'/></g>"
            )
            continue
        elements.append(
            f"<g><title>{escape(_build_tooltip(by_pixel[pixel], mark))}</title>{box} fill='{mark.colour}'/>"
            f"<text x='{x + CELL_PX / 2:g}' y='{y + CELL_PX / 2 + 4:g}' text-anchor='middle' "
            f"class='on-colour'>{mark.letter}</text></g>"
        )
    size = f"max-width:{max(12, 1.6 * wide / CELL_PX):g}rem"
    head = f"<svg viewBox='0 0 {wide} {high}' style='{size}' role='img' aria-label='Map of the pixels'>"
    return f"{head}{''.join(elements)}</svg>"


def _build_tooltip(item: PixelAnswer, mark: PixelMark) -> str:
    if item.discrepancy is None:
        return f"pixel {item.pixel}: {item.error}"
    return "; ".join([f"pixel {item.pixel}: {mark.meaning}", *_format_parameters(item.discrepancy)])


def _build_legend(answer: DisplayAnswer, marks: dict[int, PixelMark]) -> Iterator[tuple[str, ...]]:
    groups = [group.pixels for group in answer.build_groups()]
    for pixels in [*groups, [item.pixel for item in answer.failed if item.pixel is not None]]:
        if pixels:
            mark = marks[pixels[0]]
            sample = (
                "<svg class='mark' viewBox='0 0 20 20' style='width:20px' role='img' aria-label='" + mark.letter + "'>"
                f"<rect x='1' y='1' width='18' height='18' rx='3' stroke='#999' fill='{mark.colour}'/>"
                f"<text x='10' y='14' text-anchor='middle' class='on-colour'>{mark.letter}</text></svg>"
            )
            yield sample, str(len(pixels)), escape(mark.meaning), format_ranges(pixels)


def _build_row(item: PixelAnswer) -> tuple[str, ...]:
    discrepancy = item.discrepancy
    if discrepancy is None:
        return str(item.pixel), escape(item.error), "", ""
    gain = "" if discrepancy.gain is None else f"{discrepancy.gain.reduction:.0%}"
    verdict = ", ".join([discrepancy.verdict, *discrepancy.causes]) if discrepancy.causes else discrepancy.verdict
    return str(item.pixel), escape(verdict), "<br>".join(escape(size) for size in _format_parameters(discrepancy)), gain


def _format_parameters(discrepancy: Discrepancy) -> list[str]:
    """Return the parameters of the causes with their intervals."""
    return [
        f"{name} {format_quantity(item.value, item.unit)} "
        f"({format_quantity(item.low, item.unit)} to {format_quantity(item.high, item.unit)})"
        for name, item in discrepancy.parameters.items()
        if "." in name and discrepancy.verdict in ("cause", "ambiguous")
    ]
