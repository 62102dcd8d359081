"""The options of a push on the command line."""

from collections.abc import Callable
from functools import wraps
from inspect import Parameter, signature
from typing import Annotated, Any

import typer

from optodrive.core.types.push_options import list_push_options, select_push_options


def add_push_options(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command the options of a push, which it takes as keywords. One that is not given is absent."""

    @wraps(command)
    def run(**values: Any) -> None:
        options = select_push_options(values)
        command(**values, **options)

    parameters = [each for each in signature(command).parameters.values() if each.kind is not Parameter.VAR_KEYWORD]
    for name, kind, text in list_push_options():
        option = typer.Option(f"--{name.replace('_', '-')}", help=f"{text[0].upper()}{text[1:]}.")
        optional: Any = kind | None
        parameters.append(Parameter(name, Parameter.KEYWORD_ONLY, default=None, annotation=Annotated[optional, option]))
    run.__signature__ = signature(command).replace(parameters=parameters)  # type: ignore[attr-defined]
    return run
