"""Options of a push: over REST, in Python and on the command line they have the same names and values."""

from collections.abc import Callable, Iterator
from functools import wraps
from inspect import Parameter, iscoroutinefunction, isfunction, signature
from typing import Annotated, Any, Literal, NamedTuple, TypedDict, TypeVar, cast, get_args, get_type_hints

from optodrive.core.errors import InputError, suggest_nearest

Class = TypeVar("Class")
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


def check_keywords(kind: type[Class]) -> type[Class]:
    """Make the methods of a class refuse, by InputError, keywords that they do not have and flags that are not bool.

    Python itself accepts any keyword for an unpacked TypedDict, and any value: a misspelt `dry_run` would emit, and so
    would `dry_run="false"` in a request. A method that takes keywords of other names checks them itself.
    """
    for name, method in list(vars(kind).items()):
        if isfunction(method) and (name == "__init__" or not name.startswith("_")):
            setattr(kind, name, _check_keywords_of(method, kind.__name__ if name == "__init__" else name))
    return kind


def _check_keywords_of(method: Callable[..., Any], called: str) -> Callable[..., Any]:
    parameters = signature(method).parameters.values()
    named = {each.name: each.annotation for each in parameters if each.kind in _NAMED and each.name != "self"}
    others = next((each.annotation for each in parameters if each.kind is Parameter.VAR_KEYWORD), None)
    is_open = others is Any
    if others is not None and not is_open:
        named |= get_args(others)[0].__annotations__  # of Unpack[…]

    def check(keywords: dict[str, Any]) -> None:
        for name, value in keywords.items():
            if name not in named and not is_open:
                expected = f"a known keyword, {suggest_nearest(name[:60], list(named))}" if named else "no keyword"
                raise InputError(called, name, expected, code="unknown_keyword")
            if named.get(name) is bool and not isinstance(value, bool):
                raise InputError(f"{called}: {name}", value, "True or False")

    if iscoroutinefunction(method):

        @wraps(method)
        async def wait_checked(*arguments: Any, **keywords: Any) -> Any:
            check(keywords)
            return await method(*arguments, **keywords)

        return wait_checked

    @wraps(method)
    def run_checked(*arguments: Any, **keywords: Any) -> Any:
        check(keywords)
        return method(*arguments, **keywords)

    return run_checked


_NAMED = (Parameter.POSITIONAL_OR_KEYWORD, Parameter.KEYWORD_ONLY)
