"""Parameters of a named pattern on the command line: KEY=VALUE, or the first one without its key."""

import base64
from pathlib import Path

from optodrive.core.errors import InputError
from optodrive.core.files import read_bounded

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
