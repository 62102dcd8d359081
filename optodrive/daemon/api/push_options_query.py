"""The options of a push as parameters of a request's query."""

from inspect import Parameter, signature
from typing import Annotated, Any

from fastapi import Depends, Query, Request

from optodrive.core.errors import InputError
from optodrive.core.types.push_options import PushOptions, list_push_options, select_push_options


def _read_push_options(request: Request, **values: Any) -> PushOptions:
    """Return the options that the query states. Raise InputError for `strict`, which policy=refuse has replaced."""
    if "strict" in request.query_params:
        raise InputError("query.strict", request.query_params["strict"], "policy=refuse in its place")
    return select_push_options(values)


def _build_parameter(name: str, kind: Any, text: str) -> Parameter:
    return Parameter(name, Parameter.KEYWORD_ONLY, default=None, annotation=Annotated[kind, Query(description=text)])


# FastAPI reads a query's parameters from the signature.
_read_push_options.__signature__ = signature(_read_push_options).replace(  # type: ignore[attr-defined]
    parameters=[
        signature(_read_push_options).parameters["request"],
        *(_build_parameter(*option) for option in list_push_options()),
    ]
)
PushOptionsQuery = Annotated[PushOptions, Depends(_read_push_options)]
