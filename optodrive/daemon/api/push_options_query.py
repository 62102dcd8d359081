"""The options of a push as parameters of a request's query."""

from inspect import Parameter, signature
from typing import Annotated, Any

from fastapi import Depends, Query

from optodrive.core.types.push_options import PushOptions, list_push_options, select_push_options


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
