"""Options of a push: over REST, in Python and on the command line they have the same names and values."""

from collections.abc import Iterator
from typing import Annotated, Any, Literal, NamedTuple, TypedDict, cast, get_args, get_type_hints

Policy = Literal["trim", "delay", "refuse"]
"""Reduce the pulses that exceed a cap, delay them until they fit, or refuse the sequence."""
FitMode = Literal["as_is", "even", "priority"]
"""Treatment of an infeasible sequence: unchanged, all heights scaled evenly, or pixels omitted by priority."""


class PushOptions(TypedDict, total=False):
    """Options of a push. An absent one has its default, which the function that uses it states."""

    policy: Annotated[Policy, "treatment of a frame that exceeds a cap; by default trim, of a pattern its own"]
    fit: Annotated[
        FitMode,
        "treatment of a sequence that does not fit on the beam: even lowers all targets, priority omits the pixels of "
        "lowest priority; by default as_is",
    ]


class OptionDescription(NamedTuple):
    """Name, type and meaning of an option."""

    name: str
    kind: Any
    text: str


def list_push_options() -> Iterator[OptionDescription]:
    """Describe all options of a push, for the interfaces that offer them."""
    for name, annotated in get_type_hints(PushOptions, include_extras=True).items():
        kind, text = get_args(annotated)
        yield OptionDescription(name, kind, text)


def select_push_options(values: dict[str, Any]) -> PushOptions:
    """Remove the options of a push from values, and return those that are not None."""
    names = PushOptions.__annotations__.keys() & values.keys()
    return cast(PushOptions, {name: value for name in names if (value := values.pop(name)) is not None})
