"""The base of every JSON object that the daemon or the command line writes."""

import json
from collections.abc import Iterator
from typing import Annotated, Any, Self

from pydantic import BaseModel, ConfigDict, SkipValidation
from pydantic_core import to_json

FloatColumn = Annotated[list[float], SkipValidation]
IntColumn = Annotated[list[int], SkipValidation]
TextColumn = Annotated[list[str], SkipValidation]
OptionalFloatColumn = Annotated[list[float | None], SkipValidation]
"""Columns of up to thousands of values. The items are not validated: that would hold the interpreter lock for
milliseconds, in which the engine's loop and STOP wait."""


class JsonModel(BaseModel):
    """Immutable JSON object with named, typed members and no others.

    Its JSON Schema requires every member and forbids additional ones. NaN and infinity are rejected outside columns.
    """

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        allow_inf_nan=False,
        json_schema_serialization_defaults_required=True,
    )

    @classmethod
    def from_object(cls, source: object, /, **members: Any) -> Self:
        """Build it from the attributes of an object, and from the members that this has not or has otherwise."""
        return cls(**{name: getattr(source, name) for name in cls.model_fields if name not in members}, **members)


def iterate_json(model: BaseModel) -> Iterator[bytes]:
    """Encode a model as JSON in pieces: one for each member that is not a model itself."""
    separator = b"{"
    for name in type(model).model_fields:
        value = getattr(model, name)
        yield separator + json.dumps(name).encode() + b":"
        if isinstance(value, BaseModel):
            yield from iterate_json(value)
        else:
            yield to_json(value)
        separator = b","
    yield b"}" if separator == b"," else b"{}"
