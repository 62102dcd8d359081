"""A display's answer in plain words, and as JSON."""

from importlib.metadata import version
from itertools import pairwise
from typing import Any

from optodrive.lab.diagnosis.display_diagnosis import DisplayAnswer, Group, PixelAnswer, Spread
from optodrive.lab.diagnosis.narrative import WORDS, answer, quantity, story

ERRORS = 6
"""So many errors are told one by one."""


def display_story(found: DisplayAnswer) -> list[str]:
    """How many pixels suffer from what, which, how much, what mending gains; then what has no answer."""
    groups = found.groups()
    lines = [headline(found), ""]
    for group in groups:
        lines.append(f"- {counted(len(group.answers))}: {meaning(group)}: {ranges(group.pixels)}.")
        lines += [f"  {name}: {_spread(item)}" for name, item in group.parameters.items()]
        if group.gain is not None:
            gain = group.gain
            lines.append(
                f"  Of the avoidable error on held-out runs, {gain.median:.0%} goes "
                f"(median; from {gain.low:.0%} to {gain.high:.0%})."
            )
    failed = found.failed
    if failed:
        lines.append(f"- {counted(len(failed))} without an answer: {ranges(_indices(failed))}.")
        lines += [f"  pixel {item.pixel}: {item.error}" for item in failed[:ERRORS]]
        lines += [f"  and {len(failed) - ERRORS} more"] if len(failed) > ERRORS else []
    if found.mirrors is not None:
        told = found.mirrors
        lines.append(f"Mirrors: {told.error if told.found is None else story(told.found)[0]}")
    model, _, why = found.model()
    lines.append(f"No model for the whole display: {why}." if model is None else f"Model of the display: {why}.")
    return lines


def headline(found: DisplayAnswer) -> str:
    """One sentence."""
    counts = [(sum(item.verdict == word for item in _founds(found)), word) for word in ("cause", "ambiguous")]
    wrong = [
        f"{count} with {'a named cause' if word == 'cause' else 'rival causes'}" for count, word in counts if count
    ]
    unexplained = sum(item.verdict == "unexplained" for item in _founds(found))
    wrong += [f"{unexplained} with no known cause"] if unexplained else []
    total = sum(item.verdict != "none" for item in _founds(found))
    of = f"Of {counted(len(found.pixels))}, each diagnosed for itself,"
    if not total:
        return f"{of} none shows anything that the nominal model gets wrong."
    return f"{of} {total} show that the nominal model is wrong: {', '.join(wrong)}."


def meaning(group: Group) -> str:
    """What a group suffers from, in words and keys."""
    named = [f"{WORDS.get(key, key)} ({key})" for key in group.causes]
    if group.verdict == "none":
        return "nothing found"
    if group.verdict == "cause":
        return " and ".join(named)
    if group.verdict == "ambiguous" and named:
        return f"cannot be told apart: {'; or '.join(named)}"
    return "something is wrong, and none of the known causes explains it"


def counted(pixels: int) -> str:
    """As words."""
    return f"{pixels:,} pixel{'s' if pixels != 1 else ''}"


def ranges(pixels: list[int]) -> str:
    """3, 7, 12 to 15."""
    breaks = [at for at, (one, two) in enumerate(pairwise(pixels), start=1) if two != one + 1]
    runs = [pixels[a:b] for a, b in pairwise([0, *breaks, len(pixels)])]
    return ", ".join(
        f"{run[0]} to {run[-1]}" if len(run) > 2 else ", ".join(str(pixel) for pixel in run) for run in runs if run
    )


def display_answer(found: DisplayAnswer) -> dict[str, Any]:
    """JSON: a summary, and under each pixel's index what a recording of it alone would have as its answer."""
    model, _, why = found.model()
    words = ("none", "cause", "ambiguous", "unexplained")
    return {
        "summary": {
            "pixels": len(found.pixels),
            "verdicts": {word: sum(item.verdict == word for item in _founds(found)) for word in words},
            "errors": _indices(found.failed),
            "groups": [
                {
                    "verdict": group.verdict,
                    "causes": list(group.causes),
                    "pixels": group.pixels,
                    "parameters": {name: _spread_json(item) for name, item in group.parameters.items()},
                    "gain": None if group.gain is None else _spread_json(group.gain),
                }
                for group in found.groups()
            ],
            "model": {"written": model is not None, "why": why},
        },
        "pixels": {str(item.pixel): _entry(item) for item in found.pixels},
        "mirrors": None if found.mirrors is None else _entry(found.mirrors),
        "seconds": found.seconds,
        "version": version("optodrive"),
    }


def _entry(item: PixelAnswer) -> dict[str, Any]:
    if item.found is None:
        nothing: dict[str, Any] = {"verdict": None, "causes": [], "parameters": {}, "gain": None}
        return {**nothing, "error": item.error}
    return {**answer(item.found), "error": None}


def _founds(found: DisplayAnswer) -> list[Any]:
    return [item.found for item in found.pixels if item.found is not None]


def _indices(answers: list[PixelAnswer]) -> list[int]:
    return [item.pixel for item in answers if item.pixel is not None]


def _spread(item: Spread) -> str:
    low, high = quantity(item.low, item.unit), quantity(item.high, item.unit)
    return f"median {quantity(item.median, item.unit)}, from {low} to {high}"


def _spread_json(item: Spread) -> dict[str, Any]:
    return {"median": item.median, "range": [item.low, item.high], "unit": item.unit}
