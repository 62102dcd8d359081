"""Definition of a pattern with its parameters and the function that builds its sequence."""

from base64 import b64decode
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from hashlib import sha256
from math import isfinite
from typing import Literal

from optodrive.core.errors import MISSING, InputError, suggest_nearest
from optodrive.core.plausibility import PlausibleRange, describe_likely_unit
from optodrive.core.types.push_options import Policy
from optodrive.core.types.stimuli import FrameSequence
from optodrive.device.config import Config, build_pixel_layout

ParameterKind = Literal["number", "integer", "choice", "pixel", "flag", "text", "file"]
"""Kind of a pattern parameter, which selects its conversion."""
ParameterValue = str | int | float | bytes | bool | None

SI_SUFFIXES = {"_um": ("_m", 1e-6), "_mm": ("_m", 1e-3), "_mw": ("_w", 1e-3)}
"""Unit suffix of a parameter's name to the suffix and factor of its builder's argument in SI."""

TEXT_MAX = 2_000
"""Largest length of a text parameter, characters."""


@dataclass(frozen=True)
class PatternParameter:
    """One parameter of a pattern. `min` and `max` bound a number. A required parameter has no default.

    name: of the parameter
    kind: of its value
    default: value when it is not given, null for none
    description: of the parameter, in a line
    unit: of its value, '' without one
    choices: values of a choice
    min, max: bounds of a number, in `unit`
    required: whether it must be given
    """

    name: str
    kind: ParameterKind
    default: str | int | float | bool | None
    description: str
    unit: str = ""
    choices: tuple[str, ...] = ()
    min: float | None = None
    max: float | None = None
    required: bool = False


@dataclass(frozen=True)
class PatternDescription:
    """A pattern without its builder, as GET /v1/patterns lists it.

    policy: how it is treated above a cap by default
    name: of the pattern
    summary: what it shows, in a line
    notes: its particulars, '' without any
    parameters: of the pattern
    """

    name: str
    summary: str
    notes: str
    parameters: tuple[PatternParameter, ...]
    policy: Policy


@dataclass(frozen=True)
class Pattern:
    """A named stimulus: build(config, where, **parameters in SI) builds it, notes state its particulars.

    policy: treatment above a cap unless the caller states another
    """

    name: str
    summary: str
    parameters: tuple[PatternParameter, ...]
    build: Callable[..., FrameSequence]
    notes: str = ""
    policy: Policy = "trim"

    def describe_arguments(self, given: Mapping[str, object], config: Config) -> dict[str, str | float | bool | None]:
        """Return all parameters in their own units, also those by default, and a file by the digest of its bytes.

        An intensity stands in place of the height.

        Raises InputError as `resolve_arguments`.
        """
        described: dict[str, str | float | bool | None] = {}
        for parameter in self.parameters:
            value: ParameterValue = parameter.default
            if parameter.name in given:
                place = f"pattern {self.name}: {parameter.name}"
                value = convert_value(given[parameter.name], parameter, place, config)
            if isinstance(value, bytes):
                value = f"sha256:{sha256(value).hexdigest()}, {len(value)} bytes"
            described[parameter.name] = value
        if described.get("intensity") is not None:
            described["height_um"] = None
        return described

    def resolve_arguments(self, given: object, config: Config) -> dict[str, ParameterValue]:
        """Return the builder's arguments from the given parameters and the defaults.

        Raises InputError (bad_parameter, unknown_parameter, missing_parameter, unknown_pixel).
        """
        where = f"pattern {self.name}"
        if not isinstance(given, Mapping):
            raise InputError(where, given, "an object of its parameters", code="bad_parameter")
        known = {parameter.name: parameter for parameter in self.parameters}
        for key in given:
            if key not in known:
                expected = (
                    f"a known parameter, {suggest_nearest(str(key)[:60], list(known))}" if known else "no parameter"
                )
                raise InputError(where, key, expected, code="unknown_parameter")
        values: dict[str, ParameterValue] = {}
        for name, parameter in known.items():
            place = f"{where}: {name}"
            if name not in given and parameter.required:
                raise InputError(place, MISSING, f"this parameter ({parameter.description})", code="missing_parameter")
            value = convert_value(given[name], parameter, place, config) if name in given else parameter.default
            argument, factor = _convert_name(name)
            values[argument] = value * factor if factor != 1.0 and isinstance(value, int | float) else value
        return values


def convert_value(value: object, parameter: PatternParameter, where: str, config: Config) -> ParameterValue:
    """Convert a value, or its text, to the parameter's kind. Raise InputError (bad_parameter, unknown_pixel)."""
    match parameter.kind:
        case "number":
            return _convert_number(value, parameter, where)
        case "integer":
            return _convert_integer(value, where, int(parameter.min or 0), int(parameter.max or 0), "bad_parameter")
        case "pixel":
            return _convert_integer(value, where, 0, len(build_pixel_layout(config.display)) - 1, "unknown_pixel")
        case "choice":
            return _convert_choice(value, parameter, where)
        case "flag":
            return _convert_flag(value, where)
        case "text":
            return _convert_text(value, where)
        case "file":
            return _convert_file(value, where)


def _convert_number(value: object, parameter: PatternParameter, where: str) -> float:
    unit = f" {parameter.unit}" if parameter.unit else ""
    expected = f"a number from {parameter.min:g} to {parameter.max:g}{unit}"
    try:
        number = float(value) if isinstance(value, str | int | float) and not isinstance(value, bool) else float("nan")
    except (ValueError, OverflowError):
        number = float("nan")
    low, high = parameter.min or 0.0, parameter.max or 0.0
    inside = isfinite(number) and low <= number <= high
    if not inside:
        expected += describe_likely_unit(number, PlausibleRange(low, high, parameter.unit)) if isfinite(number) else ""
        raise InputError(where, value, expected, code="bad_parameter")
    return number


def _convert_integer(value: object, where: str, minimum: int, maximum: int, code: str) -> int:
    text = str(value) if type(value) is int or isinstance(value, str) else ""
    digits = text.removeprefix("-")
    if digits.isascii() and digits.isdigit() and len(digits) < 10 and minimum <= int(text) <= maximum:
        return int(text)
    raise InputError(where, value, f"a whole number, {minimum}…{maximum}", code=code)


def _convert_choice(value: object, parameter: PatternParameter, where: str) -> str:
    if str(value) not in parameter.choices:
        raise InputError(where, value, "one of " + ", ".join(parameter.choices), code="bad_parameter")
    return str(value)


def _convert_flag(value: object, where: str) -> bool:
    if isinstance(value, bool):
        return value
    if value not in ("true", "false"):
        raise InputError(where, value, "true or false", code="bad_parameter")
    return value == "true"


def _convert_text(value: object, where: str) -> str:
    text = str(value) if isinstance(value, str | int | float) else ""
    if not 0 < len(text) <= TEXT_MAX:
        raise InputError(where, value, f"1 to {TEXT_MAX} characters", code="bad_parameter")
    return text


def _convert_file(value: object, where: str) -> bytes:
    try:
        content = b64decode(value, validate=True) if isinstance(value, str) else value
    except ValueError:
        content = None
    if not isinstance(content, bytes):
        raise InputError(where, value, "the bytes of a file, in base64 where they are text", code="bad_parameter")
    return content


def _convert_name(name: str) -> tuple[str, float]:
    for ending, (si_ending, factor) in SI_SUFFIXES.items():
        if name.endswith(ending):
            return name.removesuffix(ending) + si_ending, factor
    return name, 1.0
