"""Tables of TOML files as pydantic models, with one-line errors."""

from pathlib import Path
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
from optodrive.core.field_docstrings import read_field_docstrings
from optodrive.core.plausibility import check_table, collect_ranges

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
