"""Answer about a display of many pixels: as text, as JSON, and as an HTML file with a map of the pixels.

Pixels with the same verdict and causes are one group, which is told with the median and the range of its sizes. The map
gives each group a letter and a colour.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape
from itertools import pairwise
from math import ceil, sqrt
from typing import Any

from optodrive import __version__
from optodrive.core.document import Document, Markup, Section, Table
from optodrive.core.provenance import Provenance
from optodrive.core.quantity import format_quantity
from optodrive.core.types.discrepancy import Discrepancy
from optodrive.device.config import Config, build_pixel_layout
from optodrive.lab.diagnosis.display_diagnosis import DisplayAnswer, PixelAnswer, PixelGroup, PixelSpread
from optodrive.lab.diagnosis.narrative import build_answer, build_narrative
from optodrive.lab.inference.claim import WORST_FIRST
from optodrive.physics.terms import discover_terms

MAX_ERRORS = 6
"""Maximum number of errors listed individually."""
WRONG = {"cause": "a named cause", "ambiguous": "rival causes", "unexplained": "no known cause"}
"""Verdicts that find an error, and with what."""
MEANINGS = {
    "none": "no error found",
    "instrument": "no error of the model, but an instrument is disturbed",
    "incomplete": "no error found, but not every cause could be computed",
}
COLOURS = ("#e69f00", "#56b4e9", "#009e73", "#f0e442", "#5e9bd6", "#d55e00", "#cc79a7", "#b39ddb")
"""Palette of Okabe and Ito, distinguishable by colour-blind readers, lightened for the letters on it."""
LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"
CELL_PX = 20
NOTHING_COLOUR, UNCERTAIN_COLOUR, FAILED_COLOUR = "#e8e8e8", "#bdbdbd", "#ffffff"


def build_display_narrative(answer: DisplayAnswer) -> list[str]:
    """Return the lines of the narrative: headline, groups with parameters and gain, errors, mirrors and model."""
    lines = [build_headline(answer), ""]
    for group in answer.build_groups():
        lines.append(f"- {_count_pixels(len(group.members))}: {_describe_group(group)}: {format_ranges(group.pixels)}.")
        for name, item in group.parameters.items():
            median, low, high = (format_quantity(value, item.unit) for value in (item.median, item.low, item.high))
            lines.append(f"  {name}: median {median}, from {low} to {high}")
        if group.gain is not None:
            share = f"{group.gain.median:.0%} of the avoidable error on held-out runs"
            span = f"from {group.gain.low:.0%} to {group.gain.high:.0%}"
            lines.append(f"  The extended model removes {share} (median; {span}).")
        if group.height_error is not None:
            error = group.height_error
            lines.append(
                f"  Heights planned with their models are off by {error.median:.1%} rms "
                f"(median; from {error.low:.1%} to {error.high:.1%})."
            )
        if group.doubtful:
            lines.append(f"  Sizes not established, see the pixels' doubts: {format_ranges(group.doubtful)}.")
    partly = [item.pixel for item in answer.pixels if item.discrepancy is not None and item.discrepancy.omitted_data]
    if partly:
        lines.append(f"- data left out, see omitted of the pixels: {format_ranges(partly)}.")
    if failed := answer.failed:
        indices = format_ranges([item.pixel for item in failed])
        lines.append(f"- {_count_pixels(len(failed))} without an answer: {indices}.")
        lines += [f"  pixel {item.pixel}: {item.error}" for item in failed[:MAX_ERRORS]]
        lines += [f"  and {len(failed) - MAX_ERRORS} more"] if len(failed) > MAX_ERRORS else []
    if (mirrors := answer.mirrors) is not None:
        found = mirrors.discrepancy
        lines.append(f"Mirrors: {mirrors.error if found is None else build_narrative(found)[0]}")
    model, _, reason = answer.build_model()
    lines.append(f"No model for the whole display: {reason}." if model is None else f"Model of the display: {reason}.")
    return lines


def build_headline(answer: DisplayAnswer) -> str:
    """Return a one-sentence summary."""
    counts = Counter(item.verdict for item in answer.discrepancies)
    incomplete, undecided, failed = counts["incomplete"], counts["undecided"], len(answer.failed)
    wrong = [f"{counts[verdict]} with {what}" for verdict, what in WRONG.items() if counts[verdict]]
    doubtful = sum(len(group.doubtful) for group in answer.build_groups())
    wrong += [f"{doubtful} with a cause of uncertain size"] if doubtful else []
    prefix = f"Of {_count_pixels(len(answer.pixels))}, each diagnosed separately,"
    missing = f"; {failed} {'has' if failed == 1 else 'have'} no answer" if failed else ""
    missing += f"; for {incomplete}, the search is incomplete" if incomplete else ""
    missing += f"; {undecided} {'is' if undecided == 1 else 'are'} undecided" if undecided else ""
    if failed == len(answer.pixels):
        return f"{prefix} none has an answer."
    if not (total := sum(counts[verdict] for verdict in WRONG)):
        others = f"none of the other {len(answer.pixels) - failed - incomplete - undecided}" if missing else "none"
        return f"{prefix} {others} shows an error of the nominal model{missing}."
    return f"{prefix} {total} show an error of the nominal model: {', '.join(wrong)}{missing}."


def _describe_group(group: PixelGroup) -> str:
    """Return the causes of a group as text with their keys."""
    named = [f"{discover_terms()[key].label} ({key})" for key in group.causes]
    if group.verdict == "cause":
        return " and ".join(named)
    if group.verdict == "ambiguous" and named:
        return f"indistinguishable: {'; or '.join(named)}"
    return MEANINGS.get(group.verdict, "an error that no known cause explains")


def _count_pixels(pixels: int) -> str:
    return f"{pixels:,} pixel{'s' if pixels != 1 else ''}"


def format_ranges(pixels: list[int]) -> str:
    """Return sorted pixel indices as text, such as "3, 7, 12 to 15"."""
    breaks = [at for at, (first, second) in enumerate(pairwise(pixels), start=1) if second != first + 1]
    runs = [pixels[a:b] for a, b in pairwise([0, *breaks, len(pixels)])]
    return ", ".join(
        f"{run[0]} to {run[-1]}" if len(run) > 2 else ", ".join(str(pixel) for pixel in run) for run in runs if run
    )


def build_display_answer(answer: DisplayAnswer) -> dict[str, Any]:
    """Return JSON values: a summary, and per pixel index the same answer as for a recording of that pixel only."""
    model, _, reason = answer.build_model()
    counts = Counter(item.verdict for item in answer.discrepancies)
    return {
        "summary": {
            "pixels": len(answer.pixels),
            "verdicts": {verdict: counts[verdict] for verdict in WORST_FIRST[::-1]},
            "errors": [item.pixel for item in answer.failed],
            "groups": [
                {
                    "verdict": group.verdict,
                    "causes": list(group.causes),
                    "pixels": group.pixels,
                    "parameters": {name: _spread_to_json(item) for name, item in group.parameters.items()},
                    "gain": _spread_to_json(group.gain),
                    "height_error": _spread_to_json(group.height_error),
                    "doubtful": group.doubtful,
                }
                for group in answer.build_groups()
            ],
            "model": {"written": model is not None, "reason": reason},
        },
        "pixels": {str(item.pixel): _build_entry(item) for item in answer.pixels},
        "mirrors": None if answer.mirrors is None else _build_entry(answer.mirrors),
        "elapsed_s": answer.elapsed_s,
        "version": __version__,
    }


def _build_entry(item: PixelAnswer) -> dict[str, Any]:
    if item.discrepancy is None:
        return {"verdict": None, "causes": [], "parameters": {}, "gain": None, "error": item.error}
    return {**build_answer(item.discrepancy), "error": None}


def _spread_to_json(item: PixelSpread | None) -> dict[str, Any] | None:
    return None if item is None else {"median": item.median, "range": [item.low, item.high], "unit": item.unit}


@dataclass(frozen=True)
class PixelMark:
    """Letter and colour of the pixels of one group, with their meaning."""

    letter: str
    colour: str
    meaning: str

    def draw(self, x: int, y: int) -> str:
        """Draw the mark in a cell of the map, whose upper left corner is at x and y."""
        middle = CELL_PX / 2
        return (
            f"{_draw_cell(x, y)} fill='{self.colour}'/>"
            f"<text x='{x + middle:g}' y='{y + middle + 4:g}' text-anchor='middle' class='on-colour'>"
            f"{self.letter}</text>"
        )


def _draw_cell(x: int, y: int) -> str:
    """Return the beginning of a cell's rectangle."""
    return f"<rect x='{x + 1}' y='{y + 1}' width='{CELL_PX - 2}' height='{CELL_PX - 2}' rx='3' stroke='#999'"


def build_display_report(
    answer: DisplayAnswer, title: str, config: Config | None, provenance: Provenance | None = None
) -> str:
    """Return the report as HTML.

    config: provides the pixel layout
    """
    marks = _assign_marks(answer)
    positions, caption = _place_pixels(answer, config)
    columns = ("pixel", "verdict", "parameters, 95 %", "gain")
    legend = Table("Legend", ("mark", "pixels", "meaning", "indices"), _build_legend(answer, marks), {1})
    hint = f"{caption} Hover over a mark for the pixel's answer."
    body = [
        Section("Map", [hint, _draw_map(answer, marks, positions), legend]),
        Section("Pixels", [Table("Pixels", columns, map(_build_row, answer.pixels), {0})]),
    ]
    return Document(title, build_headline(answer), build_display_narrative(answer), body, provenance).to_html()


def _assign_marks(answer: DisplayAnswer) -> dict[int, PixelMark]:
    """Return the mark of each pixel: a letter and a colour per set of causes, and signs for other verdicts."""
    marks = {item.pixel: PixelMark("×", FAILED_COLOUR, "without an answer") for item in answer.failed}
    named = 0
    for group in answer.build_groups():
        if group.verdict == "cause":
            letter, colour = LETTERS[named % len(LETTERS)], COLOURS[named % len(COLOURS)]
            named += 1
        elif group.verdict in ("none", "instrument"):
            letter, colour = "·", NOTHING_COLOUR
        else:
            letter, colour = "?" if group.verdict == "ambiguous" else "!", UNCERTAIN_COLOUR
        marks |= dict.fromkeys(group.pixels, PixelMark(letter, colour, _describe_group(group)))
    return marks


def _place_pixels(answer: DisplayAnswer, config: Config | None) -> tuple[dict[int, tuple[int, int]], str]:
    """Return column and row from the top of every drawn pixel, and a caption for the layout."""
    measured = [item.pixel for item in answer.pixels]
    if config is not None and max(measured) < len(layout := build_pixel_layout(config.display)):
        rows = (config.display.rows - 1 - layout.row).tolist()
        positions = dict(enumerate(zip(layout.column.tolist(), rows, strict=True)))
        return positions, f"Pixels at their places on {config.name}, front view; empty: not measured."
    side = ceil(sqrt(len(measured)))
    reason = "no layout is known" if config is None else f"{config.name} has no pixel {max(measured)}"
    positions = {pixel: (at % side, at // side) for at, pixel in enumerate(measured)}
    return positions, f"Pixels by index, row by row from the top left; {reason}."


def _draw_map(answer: DisplayAnswer, marks: dict[int, PixelMark], positions: dict[int, tuple[int, int]]) -> Markup:
    by_pixel = {item.pixel: item for item in answer.pixels}
    width, height = (CELL_PX * (1 + max(position[axis] for position in positions.values())) for axis in (0, 1))
    elements = []
    for pixel, (column, row) in positions.items():
        x, y = column * CELL_PX, row * CELL_PX
        if (mark := marks.get(pixel)) is None:
            title, cell = f"pixel {pixel}: not measured", f"{_draw_cell(x, y)} stroke-dasharray='2' fill='none'/>"
        else:
            title, cell = _build_tooltip(by_pixel[pixel], mark), mark.draw(x, y)
        elements.append(f"<g><title>{escape(title)}</title>{cell}</g>")
    size = f"max-width:{max(12, 1.6 * width / CELL_PX):g}rem"
    head = f"<svg viewBox='0 0 {width} {height}' style='{size}' role='img' aria-label='Map of the pixels'>"
    return Markup(f"{head}{''.join(elements)}</svg>")


def _build_tooltip(item: PixelAnswer, mark: PixelMark) -> str:
    if item.discrepancy is None:
        return f"pixel {item.pixel}: {item.error}"
    return "; ".join([f"pixel {item.pixel}: {mark.meaning}", *_format_parameters(item.discrepancy)])


def _build_legend(answer: DisplayAnswer, marks: dict[int, PixelMark]) -> Iterator[Sequence[str]]:
    for pixels in [*(group.pixels for group in answer.build_groups()), [item.pixel for item in answer.failed]]:
        if pixels:
            mark = marks[pixels[0]]
            head = f"<svg class='mark' viewBox='0 0 {CELL_PX} {CELL_PX}' style='width:{CELL_PX}px' role='img'"
            sample = Markup(f"{head} aria-label='{mark.letter}'>{mark.draw(0, 0)}</svg>")
            yield sample, str(len(pixels)), mark.meaning, format_ranges(pixels)


def _build_row(item: PixelAnswer) -> Sequence[str]:
    found = item.discrepancy
    if found is None:
        return str(item.pixel), item.error, "", ""
    gain = "" if found.gain is None else f"{found.gain.reduction:.0%}"
    sizes = Markup("<br>".join(map(escape, _format_parameters(found))))
    return str(item.pixel), ", ".join([found.verdict, *found.causes]), sizes, gain


def _format_parameters(found: Discrepancy) -> list[str]:
    """Return the parameters of the causes with their intervals."""
    return [
        f"{name} {format_quantity(item.value, item.unit)} "
        f"({format_quantity(item.low, item.unit)} to {format_quantity(item.high, item.unit)})"
        for name, item in found.parameters.items()
        if "." in name and found.verdict in ("cause", "ambiguous")
    ]
