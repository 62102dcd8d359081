"""TOML files: the reader of all, with bounds on its input, and tables as models with one-line errors.

The docstrings below the fields of a model are read from its source when somebody asks for them. Pydantic can read them
as well (`use_attribute_docstrings`), but does so when the model is created: a twentieth of the time of `optodrive
plan`, which shows none of them.
"""

import ast
import inspect
import re
import tomllib
from functools import cache
from pathlib import Path
from textwrap import dedent
from typing import Annotated, Any, TypeVar, get_args

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    GetJsonSchemaHandler,
    ValidationError,
    model_validator,
)
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from optodrive.core.errors import MISSING, InputError, Unquoted, suggest_nearest
from optodrive.core.files import read_regular_file
from optodrive.core.plausibility import check_table, collect_ranges

BYTES_MAX = 1_000_000
"""Largest size of a file without another bound, bytes."""
DEPTH_MAX = 16
"""Most tables and lists within each other."""
KEY_MAX = 255
"""Longest key, characters."""
INTEGER_MIN, INTEGER_MAX = -(2**63), 2**64 - 1
"""Integers of 64 bits, with or without a sign: an attribute in HDF5 may be either."""
MESSAGE_MAX = 100
REMEDIES = {
    "Invalid value": "a number with a decimal point and without unit, true, false, or text in quotation marks",
    "Expected newline": "a number with a decimal point and without unit, true, false, or text in quotation marks",
    "Cannot overwrite": "each key once",
    "Cannot declare": "each section once",
}
"""What a writer most likely meant to state, by the beginning of the parser's message."""
LONG_DOTTED_KEY = re.compile(r"""(?<![\w-])(?:(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){128}""", re.ASCII)
"""A key, or text, of more parts than any file has; the parser's time is quadratic in their number."""


def read_toml(path: Path, bytes_max: int = BYTES_MAX, *, private: bool = False) -> dict[str, Any]:
    """Return a TOML file as a table. Raise InputError, in one line, if it cannot be read or parsed or passes a bound.

    private: require that only the file's owner can read it
    """
    return parse_toml(read_regular_file(path, bytes_max, private=private), str(path))


def parse_toml(content: bytes, where: str) -> dict[str, Any]:
    """Return TOML in UTF-8 as a table. Raise InputError, which shows no value of it, if it cannot be parsed."""
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise InputError(f"{where}, line {line}", content[error.start : error.start + 1], "TOML in UTF-8") from None
    long_key = LONG_DOTTED_KEY.search(text)
    if long_key is not None:
        line = text.count("\n", 0, long_key.start()) + 1
        raise _build_depth_error(f"{where}, line {line}")
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        message, _, place = str(error).rpartition(" (at ")
        remedy = next((f": {text}" for start, text in REMEDIES.items() if message.startswith(start)), "")
        found = Unquoted(message[:MESSAGE_MAX])
        raise InputError(f"{where}, {place.rstrip(')')}", found, f"valid TOML{remedy}") from None
    except RecursionError:
        raise _build_depth_error(where) from None
    except ValueError:  # of int()
        raise _build_integer_error(where) from None
    _check_bounds(where, table, 0)
    return table


def _check_bounds(where: str, value: object, depth: int) -> None:
    """Raise InputError for nesting that is too deep, a long or unprintable key, or a large integer."""
    if isinstance(value, dict | list) and depth == DEPTH_MAX:
        raise _build_depth_error(where)
    if isinstance(value, dict):
        separator = "." if depth else ": "
        for key, item in value.items():
            if len(key) > KEY_MAX or not key.isprintable():
                raise InputError(f"{where}: a key", key, f"at most {KEY_MAX} printable characters")
            _check_bounds(f"{where}{separator}{key}", item, depth + 1)
    elif isinstance(value, list):
        for index, item in enumerate(value):
            _check_bounds(f"{where}[{index}]", item, depth + 1)
    elif isinstance(value, int) and not INTEGER_MIN <= value <= INTEGER_MAX:
        raise _build_integer_error(where)


def _build_depth_error(where: str) -> InputError:
    return InputError(where, Unquoted("deeper nesting"), f"tables and lists at most {DEPTH_MAX} deep")


def _build_integer_error(where: str) -> InputError:
    return InputError(where, Unquoted("an integer of more digits"), "integers of 64 bits")


@cache
def read_field_docstrings(owner: type[BaseModel]) -> dict[str, str]:
    """Return the docstring of each field that has one, by name, with those of the base classes."""
    docstrings: dict[str, str] = {}
    for base in reversed(owner.__mro__):
        if issubclass(base, BaseModel) and base is not BaseModel:
            docstrings |= _read_own_docstrings(base)
    return docstrings


def _read_own_docstrings(owner: type) -> dict[str, str]:
    definition: Any = ast.parse(dedent(inspect.getsource(owner))).body[0]
    return {
        field.target.id: inspect.cleandoc(text.value.value)
        for field, text in zip(definition.body, definition.body[1:], strict=False)
        if isinstance(field, ast.AnnAssign)
        and isinstance(field.target, ast.Name)
        and isinstance(text, ast.Expr)
        and isinstance(text.value, ast.Constant)
        and isinstance(text.value.value, str)
    }


Model = TypeVar("Model", bound=BaseModel)
TYPE_NAMES = {
    "tuple_type": "an array",
    "dict_type": "a table",
    "string_type": "text",
    "bool_type": "true or false",
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "float_type": "a number",
}
"""What a complaint of pydantic about a type expects, in the words of TOML."""
UNION_BRANCHES = frozenset({"str", "int", "float", "bool"})
"""Last part of the place of a complaint about a value that may have several types."""


class ConflictError(ValueError):
    """A value of a table that does not go with another one.

    place: its dotted key within the table
    """

    def __init__(self, place: str, value: object, expected: str) -> None:
        self.place, self.value, self.expected = place, value, expected
        super().__init__(f"{place}: {value!r}, expected {expected}")


class Section(BaseModel):
    """Base of all tables of files: immutable, without unknown keys. Field docstrings are their descriptions.

    Types are strict: a number is neither a boolean nor a text, and a whole number has no decimal point. A validator is
    built at its first use, because a command reads few of the files whose tables it imports.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False, defer_build=True)

    @classmethod
    def __get_pydantic_json_schema__(cls, core_schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        """Return the JSON Schema with the fields' docstrings."""
        schema = handler(core_schema)
        for name, docstring in read_field_docstrings(cls).items():
            handler.resolve_ref_schema(schema)["properties"][name]["description"] = docstring
        return schema

    @model_validator(mode="before")
    @classmethod
    def _freeze_arrays(cls, table: Any) -> Any:
        """Make tuples of a table's arrays, because a strict tuple accepts no list."""
        return {key: _freeze(value) for key, value in table.items()} if isinstance(table, dict) else table


def _freeze(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _freeze(item) for key, item in value.items()}
    return tuple(map(_freeze, value)) if isinstance(value, list) else value


def _require_name(text: str) -> str:
    if not text.isprintable() or set(text) & {'"', "\\"}:
        raise ValueError("printable characters, no quotation mark and no backslash")
    return text


Name = Annotated[str, Field(min_length=1, max_length=100), AfterValidator(_require_name)]
"""A name that fits in one line and in a TOML string."""


def check_format(path: Path, table: dict[str, Any], expected: str, version: int) -> None:
    """Raise InputError for a file of another format or version."""
    if table.get("format") != expected:
        raise InputError(f"{path}: format", table.get("format", MISSING), f"'{expected}'")
    if type(table.get("version")) is not int or table["version"] != version:
        found = table.get("version", MISSING)
        newer = "; a newer release wrote this file" if type(found) is int and found > version else ""
        raise InputError(f"{path}: version", found, f"{version}, the one this release reads{newer}")


def parse_table(path: Path, table: dict[str, Any], model: type[Model]) -> Model:
    """Return a file's table as its model. Raise InputError, first for a quantity that is probably in another unit."""
    check_table(str(path), table, collect_ranges(model))
    return validate_table(path, table, model)


def validate_table(path: Path, table: dict[str, Any], model: type[Model]) -> Model:
    """Return a file's table as its model, whose units were checked. Raise InputError."""
    try:
        return model.model_validate(table)
    except ValidationError as error:
        raise build_input_error(error, str(path), model) from None


def build_input_error(error: ValidationError, where: str, model: type[BaseModel] | None = None) -> InputError:
    """Convert pydantic's first complaint to one line. Suggest the nearest known key for an unknown one."""
    complaints = error.errors(include_url=False)
    first = next((item for item in complaints if item["type"] == "extra_forbidden"), complaints[0])
    place = ".".join(str(part) for part in first["loc"])
    label = f"{where}: {place}" if place else where
    kind, value = first["type"], _thaw(first["input"])
    if kind == "extra_forbidden":
        key = str(first["loc"][-1])
        known = _list_known_keys(model, first["loc"][:-1]) if model else []
        places = _find_places(model, key) if model else ""
        expected = f"a known key, {suggest_nearest(key, known)}" if known else "no such key"
        return InputError(label, key, f"this key {places}" if places else expected, code="unknown_key")
    if kind == "missing":
        return InputError(label, MISSING, "this element" if isinstance(first["loc"][-1], int) else "this key")
    if kind == "value_error" and not isinstance(value, str):
        conflict = first["ctx"]["error"]
        if isinstance(conflict, ConflictError):
            label = f"{where}: {f'{place}.' if place else ''}{conflict.place}"
            return InputError(label, _thaw(conflict.value), conflict.expected)
        return InputError(label, "inconsistent values", _read_message(first))
    if kind in TYPE_NAMES and len(first["loc"]) > 1 and first["loc"][-1] in UNION_BRANCHES:
        label = label.rpartition(".")[0]
        accepted = {TYPE_NAMES.get(each["type"]): None for each in complaints if each["loc"][:-1] == first["loc"][:-1]}
        return InputError(label, value, " or ".join(filter(None, accepted)))
    if kind == "model_type":
        expected = "a table with keys, as in { value = … }" if isinstance(value, int | float) else "a table"
        return InputError(label, value, expected)
    if kind in ("too_long", "too_short") and value:
        value = Unquoted(f"{len(value)} of them")
    return InputError(label, value, TYPE_NAMES.get(kind) or _read_message(first))


def _read_message(complaint: Any) -> str:
    """Return the expectation of a complaint as a phrase."""
    kind, context = complaint["type"], complaint.get("ctx", {})
    unit = " characters" if kind.startswith("string") else ""
    if kind.endswith("too_short"):
        return f"at least {context['min_length']}{unit}"
    if kind.endswith("too_long"):
        return f"at most {context['max_length']}{unit}"
    if kind == "string_pattern_mismatch":
        return f"text of the form {context['pattern']}"
    return str(complaint["msg"]).removeprefix("Value error, ").removeprefix("Input should be ")


def _thaw(value: Any) -> Any:
    """Return a value as the file states it, whose arrays were made tuples."""
    if isinstance(value, dict):
        return {key: _thaw(item) for key, item in value.items()}
    return list(map(_thaw, value)) if isinstance(value, tuple | list) else value


def _list_known_keys(model: type[BaseModel], path: tuple[str | int, ...]) -> list[str]:
    """Return the keys of the table at a path, which may lead through arrays and tables of tables."""
    models = [model]
    for part in path:
        fields = [each.model_fields[str(part)].annotation for each in models if str(part) in each.model_fields]
        if fields:
            models = [found for field in fields for found in _find_models(field)]
    return list(dict.fromkeys(key for each in models for key in each.model_fields))


def _find_places(model: type[BaseModel], key: str) -> str:
    """Return a phrase with the places of a file where a key is known that stands elsewhere by mistake, or nothing."""
    places = ["at the top level"] if key in model.model_fields else []
    for name, field in model.model_fields.items():
        if any(key in each.model_fields for each in _find_models(field.annotation)):
            places.append(f"in '{name}'")
    return " or ".join(places)


def _find_models(annotation: Any) -> list[type[BaseModel]]:
    """Return the models within a type, such as of a list or of a union."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [found for item in get_args(annotation) for found in _find_models(item)]
