"""What a pattern is: a name, its parameters with kinds and bounds, and the function that builds its sequence."""

from base64 import b64decode
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import isfinite
from typing import Literal

from optodrive.core.errors import InputError, nearest
from optodrive.core.types.stimuli import FrameSequence
from optodrive.device.config import Config, pixel_layout

Kind = Literal["number", "integer", "choice", "pixel", "flag", "text", "file"]
Value = str | int | float | bytes | bool | None

SI_NAMES = {"_um": ("_m", 1e-6), "_mm": ("_m", 1e-3)}
"""Ending of a parameter's name to the ending and factor under which its builder takes it."""

TEXT_MAX = 2_000


@dataclass(frozen=True)
class PatternParameter:
    """One parameter; least and most bound a number, required ones have no default."""

    name: str
    kind: Kind
    default: Value
    meaning: str
    unit: str = ""
    choices: tuple[str, ...] = ()
    least: float | None = None
    most: float | None = None
    required: bool = False


@dataclass(frozen=True)
class Pattern:
    """A named stimulus; build(config, where, **parameters in SI), notes: what a player must know about it."""

    name: str
    summary: str
    parameters: tuple[PatternParameter, ...]
    build: Callable[..., FrameSequence]
    notes: str = ""

    def arguments(self, given: object, config: Config) -> dict[str, Value]:
        """What the builder takes, from what the caller gave and the defaults; raises InputError."""
        where = f"pattern {self.name}"
        if not isinstance(given, Mapping):
            raise InputError(where, given, "an object of its parameters", code="bad_parameter")
        known = {parameter.name: parameter for parameter in self.parameters}
        for key in given:
            if key not in known:
                expected = f"a known parameter, {nearest(str(key)[:60], list(known))}" if known else "no parameter"
                raise InputError(where, key, expected, code="unknown_parameter")
        values: dict[str, Value] = {}
        for name, parameter in known.items():
            place = f"{where}: {name}"
            if name not in given and parameter.required:
                raise InputError(place, None, f"this parameter ({parameter.meaning})", code="missing_parameter")
            value = converted(given[name], parameter, place, config) if name in given else parameter.default
            argument, factor = _si_name(name)
            values[argument] = value * factor if factor != 1.0 and isinstance(value, int | float) else value
        return values


def converted(value: object, parameter: PatternParameter, where: str, config: Config) -> Value:
    """A given value, or the text of one, as the parameter's kind; raises InputError (bad_parameter, unknown_pixel)."""
    match parameter.kind:
        case "number":
            return _number(value, parameter, where)
        case "integer":
            return _whole(value, where, int(parameter.least or 0), int(parameter.most or 0), "bad_parameter")
        case "pixel":
            return _whole(value, where, 0, len(pixel_layout(config.display)) - 1, "unknown_pixel")
        case "choice":
            return _choice(value, parameter, where)
        case "flag":
            return _flag(value, where)
        case "text":
            return _text(value, where)
        case "file":
            return _file(value, where)


def _number(value: object, parameter: PatternParameter, where: str) -> float:
    unit = f" {parameter.unit}" if parameter.unit else ""
    expected = f"a number from {parameter.least:g} to {parameter.most:g}{unit}"
    try:
        number = float(value) if isinstance(value, str | int | float) and not isinstance(value, bool) else float("nan")
    except (ValueError, OverflowError):
        number = float("nan")
    inside = isfinite(number) and (parameter.least or 0.0) <= number <= (parameter.most or 0.0)
    if not inside:
        raise InputError(where, value, expected, code="bad_parameter")
    return number


def _whole(value: object, where: str, least: int, most: int, code: str) -> int:
    text = str(value) if type(value) is int or isinstance(value, str) else ""
    digits = text.removeprefix("-")
    if digits.isascii() and digits.isdigit() and len(digits) < 10 and least <= int(text) <= most:
        return int(text)
    raise InputError(where, value, f"a whole number, {least}…{most}", code=code)


def _choice(value: object, parameter: PatternParameter, where: str) -> str:
    if str(value) not in parameter.choices:
        raise InputError(where, value, "one of " + ", ".join(parameter.choices), code="bad_parameter")
    return str(value)


def _flag(value: object, where: str) -> bool:
    if isinstance(value, bool):
        return value
    if value not in ("true", "false"):
        raise InputError(where, value, "true or false", code="bad_parameter")
    return value == "true"


def _text(value: object, where: str) -> str:
    text = str(value) if isinstance(value, str | int | float) else ""
    if not 0 < len(text) <= TEXT_MAX:
        raise InputError(where, value, f"1 to {TEXT_MAX} characters", code="bad_parameter")
    return text


def _file(value: object, where: str) -> bytes:
    try:
        content = b64decode(value, validate=True) if isinstance(value, str) else value
    except ValueError:
        content = None
    if not isinstance(content, bytes):
        raise InputError(where, value, "the bytes of a file, in base64 where they are text", code="bad_parameter")
    return content


def _si_name(name: str) -> tuple[str, float]:
    for ending, (si_ending, factor) in SI_NAMES.items():
        if name.endswith(ending):
            return name.removesuffix(ending) + si_ending, factor
    return name, 1.0
