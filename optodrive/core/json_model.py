"""The base of every JSON object that the daemon or the command line writes."""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, SkipValidation

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
