"""Labels of a request on the command line: --label KEY=VALUE."""

import json
from typing import Annotated

import typer

from optodrive.core.errors import InputError

LabelOption = Annotated[
    list[str] | None,
    typer.Option("--label", metavar="KEY=VALUE", help="Record this label with the plan; may be repeated."),
]


def parse_label_options(options: list[str]) -> dict[str, str | int | float | bool]:
    """Return labels. Numbers, true and false are values of their own. Raise InputError for one without a key."""
    from optodrive.planning.stimuli.json_values import parse_labels

    labels: dict[str, object] = {}
    for option in options:
        key, equals, text = option.partition("=")
        if not equals:
            raise InputError("--label", option, "KEY=VALUE")
        if key in labels:
            raise InputError("--label", option, "each key once")
        labels[key] = _convert(text)
    return parse_labels(labels, "--label")


def add_labels(source: str, body: bytes, options: list[str]) -> dict[str, object]:
    """Return the decoded body of FRAMES.json with labels, which replace those of the same key."""
    from optodrive.planning.stimuli.json_values import decode_json

    decoded = decode_json(body, source)
    if not isinstance(decoded, dict):
        raise InputError(source, decoded, "an object with frames, trains")
    own = decoded.get("labels", {})
    return {**decoded, "labels": {**(own if isinstance(own, dict) else {}), **parse_label_options(options)}}


def _convert(text: str) -> object:
    try:
        value = json.loads(text)
    except (ValueError, RecursionError):
        return text
    return value if isinstance(value, bool | int | float) else text
