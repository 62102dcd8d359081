"""A display's answer in plain words, and as JSON."""

from importlib.metadata import version
from itertools import pairwise
from typing import Any

from optodrive.lab.diagnosis.display_diagnosis import DisplayAnswer, PixelAnswer, PixelGroup, PixelSpread
from optodrive.lab.diagnosis.narrative import CAUSE_PHRASES, build_answer, build_narrative, format_quantity

MAX_ERRORS = 6
"""So many errors are told one by one."""


def build_display_narrative(answer: DisplayAnswer) -> list[str]:
    """How many pixels suffer from what, which, how much, what mending gains; then what has no answer."""
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
                f"  Of the avoidable error on held-out runs, {gain.median:.0%} goes "
                f"(median; from {gain.low:.0%} to {gain.high:.0%})."
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
    """One sentence."""
    counts = [
        (sum(item.verdict == word for item in _list_discrepancies(answer)), word) for word in ("cause", "ambiguous")
    ]
    wrong = [
        f"{count} with {'a named cause' if word == 'cause' else 'rival causes'}" for count, word in counts if count
    ]
    unexplained = sum(item.verdict == "unexplained" for item in _list_discrepancies(answer))
    wrong += [f"{unexplained} with no known cause"] if unexplained else []
    total = sum(item.verdict != "none" for item in _list_discrepancies(answer))
    of = f"Of {format_pixel_count(len(answer.pixels))}, each diagnosed for itself,"
    if not total:
        return f"{of} none shows anything that the nominal model gets wrong."
    return f"{of} {total} show that the nominal model is wrong: {', '.join(wrong)}."


def describe_group(group: PixelGroup) -> str:
    """What a group suffers from, in words and keys."""
    named = [f"{CAUSE_PHRASES.get(key, key)} ({key})" for key in group.causes]
    if group.verdict == "none":
        return "nothing found"
    if group.verdict == "cause":
        return " and ".join(named)
    if group.verdict == "ambiguous" and named:
        return f"cannot be told apart: {'; or '.join(named)}"
    return "something is wrong, and none of the known causes explains it"


def format_pixel_count(pixels: int) -> str:
    """As words."""
    return f"{pixels:,} pixel{'s' if pixels != 1 else ''}"


def format_ranges(pixels: list[int]) -> str:
    """3, 7, 12 to 15."""
    breaks = [at for at, (one, two) in enumerate(pairwise(pixels), start=1) if two != one + 1]
    runs = [pixels[a:b] for a, b in pairwise([0, *breaks, len(pixels)])]
    return ", ".join(
        f"{run[0]} to {run[-1]}" if len(run) > 2 else ", ".join(str(pixel) for pixel in run) for run in runs if run
    )


def build_display_answer(found: DisplayAnswer) -> dict[str, Any]:
    """JSON: a summary, and under each pixel's index what a recording of it alone would have as its answer."""
    model, _, reason = found.build_model()
    verdicts = ("none", "cause", "ambiguous", "unexplained")
    return {
        "summary": {
            "pixels": len(found.pixels),
            "verdicts": {word: sum(item.verdict == word for item in _list_discrepancies(found)) for word in verdicts},
            "errors": _list_indices(found.failed),
            "groups": [
                {
                    "verdict": group.verdict,
                    "causes": list(group.causes),
                    "pixels": group.pixels,
                    "parameters": {name: _spread_to_json(item) for name, item in group.parameters.items()},
                    "gain": None if group.gain is None else _spread_to_json(group.gain),
                }
                for group in found.build_groups()
            ],
            "model": {"written": model is not None, "why": reason},
        },
        "pixels": {str(item.pixel): _build_entry(item) for item in found.pixels},
        "mirrors": None if found.mirrors is None else _build_entry(found.mirrors),
        "seconds": found.elapsed_s,
        "version": version("optodrive"),
    }


def _build_entry(item: PixelAnswer) -> dict[str, Any]:
    if item.discrepancy is None:
        nothing: dict[str, Any] = {"verdict": None, "causes": [], "parameters": {}, "gain": None}
        return {**nothing, "error": item.error}
    return {**build_answer(item.discrepancy), "error": None}


def _list_discrepancies(found: DisplayAnswer) -> list[Any]:
    return [item.discrepancy for item in found.pixels if item.discrepancy is not None]


def _list_indices(answers: list[PixelAnswer]) -> list[int]:
    return [item.pixel for item in answers if item.pixel is not None]


def _format_spread(item: PixelSpread) -> str:
    low, high = format_quantity(item.low, item.unit), format_quantity(item.high, item.unit)
    return f"median {format_quantity(item.median, item.unit)}, from {low} to {high}"


def _spread_to_json(item: PixelSpread) -> dict[str, Any]:
    return {"median": item.median, "range": [item.low, item.high], "unit": item.unit}
