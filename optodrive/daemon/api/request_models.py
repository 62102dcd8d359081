"""The body of PUT /v1/dim, and the options of a push as parameters of a request's query."""

from inspect import Parameter, signature
from typing import Annotated, Any

from fastapi import Depends, Query
from pydantic import Field, ValidationError

from optodrive.core.errors import InputError, Unquoted
from optodrive.core.json_model import JsonModel
from optodrive.core.toml_model import build_input_error
from optodrive.core.types.push_options import PushOptions, list_push_options, select_push_options
from optodrive.planning.stimuli.json_values import decode_json

BODY_MAX_BYTES = 1000
DIM_SCHEMA: dict[str, Any] = {
    "type": "object",
    "required": ["share"],
    "additionalProperties": False,
    "description": "The largest power of a pulse from now on.",
    "properties": {"share": {"type": "number", "minimum": 0, "maximum": 1, "description": "of full power"}},
}
DIM_EXAMPLE = {"share": 0.4}


class DimRequest(JsonModel):
    """The largest power of a pulse, as a share of the laser's."""

    share: Annotated[float, Field(ge=0, le=1, allow_inf_nan=False, strict=True)]


def parse_dim_request(body: bytes) -> DimRequest:
    """Parse a body. Raise InputError, also for invalid JSON and for a repeated key."""
    if len(body) > BODY_MAX_BYTES:
        raise InputError("body", Unquoted(f"{len(body)} bytes"), f"at most {BODY_MAX_BYTES}")
    decoded = decode_json(body, "body") if body.strip() else {}
    try:
        return DimRequest.model_validate(decoded)
    except ValidationError as error:
        raise build_input_error(error, "body", DimRequest) from None


def _read_push_options(**values: Any) -> PushOptions:
    """Return the options that the query states."""
    return select_push_options(values)


def _build_parameter(name: str, kind: Any, text: str) -> Parameter:
    return Parameter(name, Parameter.KEYWORD_ONLY, default=None, annotation=Annotated[kind, Query(description=text)])


# FastAPI reads a query's parameters from the signature.
_read_push_options.__signature__ = signature(_read_push_options).replace(  # type: ignore[attr-defined]
    parameters=[_build_parameter(*option) for option in list_push_options()]
)
PushOptionsQuery = Annotated[PushOptions, Depends(_read_push_options)]
