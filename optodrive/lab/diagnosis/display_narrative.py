"""Diagnosis of a display as narrative text and as JSON."""

from importlib.metadata import version
from itertools import pairwise
from typing import Any

from optodrive.core.quantity import format_quantity
from optodrive.lab.diagnosis.display_diagnosis import DisplayAnswer, PixelAnswer, PixelGroup, PixelSpread
from optodrive.lab.diagnosis.narrative import build_answer, build_narrative
from optodrive.lab.inference.claim import WORST_FIRST
from optodrive.physics.terms import discover_terms

MAX_ERRORS = 6
"""Maximum number of errors listed individually."""


def build_display_narrative(answer: DisplayAnswer) -> list[str]:
    """Return the lines of the narrative: headline, groups with parameters and gain, errors, mirrors and model."""
    groups = answer.build_groups()
    lines = [build_headline(answer), ""]
    for group in groups:
        lines.append(
            f"- {format_pixel_count(len(group.answers))}: {describe_group(group)}: {format_ranges(group.pixels)}."
        )
        lines += [f"  {name}: {_format_spread(item)}" for name, item in group.parameters.items()]
        if group.gain is not None:
            gain = group.gain
            lines.append(
                f"  The extended model removes {gain.median:.0%} of the avoidable error on held-out runs "
                f"(median; from {gain.low:.0%} to {gain.high:.0%})."
            )
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
        lines.append(
            f"- data left out, see omitted of the pixels: {format_ranges([n for n in partly if n is not None])}."
        )
    failed = answer.failed
    if failed:
        lines.append(f"- {format_pixel_count(len(failed))} without an answer: {format_ranges(_list_indices(failed))}.")
        lines += [f"  pixel {item.pixel}: {item.error}" for item in failed[:MAX_ERRORS]]
        lines += [f"  and {len(failed) - MAX_ERRORS} more"] if len(failed) > MAX_ERRORS else []
    if answer.mirrors is not None:
        mirrors = answer.mirrors
        lines.append(
            f"Mirrors: {mirrors.error if mirrors.discrepancy is None else build_narrative(mirrors.discrepancy)[0]}"
        )
    model, _, reason = answer.build_model()
    lines.append(f"No model for the whole display: {reason}." if model is None else f"Model of the display: {reason}.")
    return lines


def build_headline(answer: DisplayAnswer) -> str:
    """Return a one-sentence summary."""
    counts = [
        (sum(item.verdict == verdict for item in _list_discrepancies(answer)), verdict)
        for verdict in ("cause", "ambiguous")
    ]
    wrong = [
        f"{count} with {'a named cause' if verdict == 'cause' else 'rival causes'}"
        for count, verdict in counts
        if count
    ]
    unexplained = sum(item.verdict == "unexplained" for item in _list_discrepancies(answer))
    wrong += [f"{unexplained} with no known cause"] if unexplained else []
    doubtful = sum(len(group.doubtful) for group in answer.build_groups())
    wrong += [f"{doubtful} with a cause of uncertain size"] if doubtful else []
    total = sum(count for count, _ in counts) + unexplained
    incomplete = sum(item.verdict == "incomplete" for item in _list_discrepancies(answer))
    undecided = sum(item.verdict == "undecided" for item in _list_discrepancies(answer))
    failed = len(answer.failed)
    prefix = f"Of {format_pixel_count(len(answer.pixels))}, each diagnosed separately,"
    missing = f"; {failed} {'has' if failed == 1 else 'have'} no answer" if failed else ""
    missing += f"; for {incomplete}, the search is incomplete" if incomplete else ""
    missing += f"; {undecided} {'is' if undecided == 1 else 'are'} undecided" if undecided else ""
    if failed == len(answer.pixels):
        return f"{prefix} none has an answer."
    if not total:
        others = f"none of the other {len(answer.pixels) - failed - incomplete - undecided}" if missing else "none"
        return f"{prefix} {others} shows an error of the nominal model{missing}."
    return f"{prefix} {total} show an error of the nominal model: {', '.join(wrong)}{missing}."


def describe_group(group: PixelGroup) -> str:
    """Return the causes of a group as text with their keys."""
    named = [f"{discover_terms()[key].label} ({key})" for key in group.causes]
    if group.verdict == "none":
        return "no error found"
    if group.verdict == "instrument":
        return "no error of the model, but an instrument is disturbed"
    if group.verdict == "incomplete":
        return "no error found, but not every cause could be computed"
    if group.verdict == "cause":
        return " and ".join(named)
    if group.verdict == "ambiguous" and named:
        return f"indistinguishable: {'; or '.join(named)}"
    return "an error that no known cause explains"


def format_pixel_count(pixels: int) -> str:
    """Return a number of pixels as text."""
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
    verdicts = WORST_FIRST[::-1]
    return {
        "summary": {
            "pixels": len(answer.pixels),
            "verdicts": {
                verdict: sum(item.verdict == verdict for item in _list_discrepancies(answer)) for verdict in verdicts
            },
            "errors": _list_indices(answer.failed),
            "groups": [
                {
                    "verdict": group.verdict,
                    "causes": list(group.causes),
                    "pixels": group.pixels,
                    "parameters": {name: _spread_to_json(item) for name, item in group.parameters.items()},
                    "gain": None if group.gain is None else _spread_to_json(group.gain),
                    "height_error": None if group.height_error is None else _spread_to_json(group.height_error),
                    "doubtful": group.doubtful,
                }
                for group in answer.build_groups()
            ],
            "model": {"written": model is not None, "reason": reason},
        },
        "pixels": {str(item.pixel): _build_entry(item) for item in answer.pixels},
        "mirrors": None if answer.mirrors is None else _build_entry(answer.mirrors),
        "elapsed_s": answer.elapsed_s,
        "version": version("optodrive"),
    }


def _build_entry(item: PixelAnswer) -> dict[str, Any]:
    if item.discrepancy is None:
        nothing: dict[str, Any] = {"verdict": None, "causes": [], "parameters": {}, "gain": None}
        return {**nothing, "error": item.error}
    return {**build_answer(item.discrepancy), "error": None}


def _list_discrepancies(answer: DisplayAnswer) -> list[Any]:
    return [item.discrepancy for item in answer.pixels if item.discrepancy is not None]


def _list_indices(answers: list[PixelAnswer]) -> list[int]:
    return [item.pixel for item in answers if item.pixel is not None]


def _format_spread(item: PixelSpread) -> str:
    low, high = format_quantity(item.low, item.unit), format_quantity(item.high, item.unit)
    return f"median {format_quantity(item.median, item.unit)}, from {low} to {high}"


def _spread_to_json(item: PixelSpread) -> dict[str, Any]:
    return {"median": item.median, "range": [item.low, item.high], "unit": item.unit}
