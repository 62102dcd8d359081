"""Options of a push and parameters of a named pattern on the command line."""

import base64
from collections.abc import Callable
from functools import wraps
from inspect import Parameter, signature
from pathlib import Path
from typing import Annotated, Any

import typer

from optodrive.core.errors import InputError
from optodrive.core.files import read_bounded
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


TEXT_SUFFIX = ".txt"


def parse_parameters(command: str, pattern: str, values: list[str]) -> dict[str, str]:
    """Return the parameters as text, with the content of files in base64.

    command: its name, for errors. Raises InputError for an unknown pattern, a value without a key and a file that
    cannot be read.
    """
    from optodrive.planning.stimuli.pattern_registry import find_pattern

    known = find_pattern(pattern).parameters
    parsed: dict[str, str] = {}
    for value in values:
        key, equals, content = value.partition("=")
        if not equals or key not in {p.name for p in known}:
            if known and known[0].name not in parsed and not equals:
                key, content = known[0].name, value  # a value without a key sets the first parameter: play text "hello"
            elif not equals:
                raise InputError(f"{command} {pattern}", value, "key=value")
        if key in parsed:
            raise InputError(f"{command} {pattern}: {key}", content, "each parameter once")
        parsed[key] = content
    for parameter in known:
        if parameter.kind == "file" and parameter.name in parsed:
            path = Path(parsed[parameter.name])
            file = read_bounded(path)
            if path.suffix.lower() == TEXT_SUFFIX and any(each.name == "format" for each in known):
                parsed.setdefault("format", "text")
            parsed[parameter.name] = base64.b64encode(file).decode("ascii")
    return parsed
