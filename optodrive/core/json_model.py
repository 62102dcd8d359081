"""The base of every JSON object that the daemon or the command line writes."""

from pydantic import BaseModel, ConfigDict


class JsonModel(BaseModel):
    """Immutable JSON object with named, typed members and no others.

    Its JSON Schema requires every member and forbids additional ones. NaN and infinity are rejected.
    """

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        allow_inf_nan=False,
        json_schema_serialization_defaults_required=True,
    )
