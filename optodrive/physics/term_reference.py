"""Description of every term for people: equation, parameters, and the lines that state it in a parameter set."""

from typing import Any

from optodrive.physics.hypothesis import TermParameter
from optodrive.physics.parameters import FORMAT, VERSION
from optodrive.physics.term import Term
from optodrive.physics.terms import discover_terms


def describe_term(term: Term) -> dict[str, Any]:
    """Return a term as JSON values.

    if_omitted: a parameter's value where a set does not state it; None if it must be stated
    """
    return {
        "key": term.key,
        "label": term.label,
        "equation": " ".join((type(term).__doc__ or "").split()),
        "visible_in": term.signature,
        "requires": list(term.requires),
        "planned_with": term.in_pixel,
        "parameters": [_describe_parameter(item) for item in term.parameters],
    }


def _describe_parameter(item: TermParameter) -> dict[str, Any]:
    return {
        "name": item.name,
        "unit": item.unit,
        "if_omitted": item.if_omitted,
        "start": item.default,
        "low": item.low,
        "high": item.high,
        "source": item.source,
    }


def build_example(term: Term) -> list[str]:
    """Return the lines of a parameter set that state a term. Shapes and neutral values are omitted."""
    stated = [item for item in term.parameters if item.if_omitted is None] or list(term.parameters[:1])
    lines = [f"[terms.{term.key}]"]
    lines += [
        f'{item.name} = {{ value = {item.default!r}, unit = "{item.unit}", source = "measured on …" }}'
        for item in stated
    ]
    return lines


def build_example_file(term: Term) -> list[str]:
    """Return the lines of a complete parameter set that states a term and those that it requires."""
    lines = [
        f'format = "{FORMAT}"',
        f"version = {VERSION}",
        f'name = "{term.key}"',
        'base = "calibrated"',
        f'claims = "an example: {term.label}"',
    ]
    for stated in (*(discover_terms()[key] for key in term.requires), term):
        lines += ["", *build_example(stated)]
    return lines
