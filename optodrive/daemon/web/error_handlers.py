"""Problem documents for errors that routes and the framework raise."""

from collections.abc import Awaitable, Callable
from math import inf
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import Response
from starlette.exceptions import HTTPException

from optodrive.core.errors import (
    BoardFaultError,
    InputError,
    LinkError,
    NotReadyError,
    OptodriveError,
    OverBudgetError,
    RefusedError,
    abbreviate,
)
from optodrive.daemon.responses.problem import MEDIA_TYPE, Problem, build_problem
from optodrive.daemon.web.request_limits import BodyTooLargeError

STATUS_BY_ERROR: tuple[tuple[type[OptodriveError], int], ...] = (
    (InputError, 422),
    (RefusedError, 409),
    (NotReadyError, 409),
    (BoardFaultError, 409),
    (LinkError, 503),
)
NOT_FOUND_CODES = ("plan_not_found", "unknown_pattern")


def build_error_problem(error: OptodriveError) -> Problem:
    """Build the problem document of an error of this package."""
    status = next((status for kind, status in STATUS_BY_ERROR if isinstance(error, kind)), 500)
    if error.code in NOT_FOUND_CODES:
        status = 404
    extensions: dict[str, Any] = {}
    if isinstance(error, InputError):
        extensions = {"where": error.where, "value": abbreviate(error.value), "expected": error.expected}
    if isinstance(error, OverBudgetError):
        fits_after_s = error.fits_after_s if error.fits_after_s < inf else None
        extensions = {"pixel": error.pixel, "cap": error.cap, "margin_j": error.margin_j, "fits_after_s": fits_after_s}
    if isinstance(error, RefusedError) and error.feasibility is not None:
        extensions["feasibility"] = error.feasibility
    return build_problem(status, error.code, type(error).__name__.removesuffix("Error"), str(error), **extensions)


def add_error_handlers(app: FastAPI) -> None:
    """Answer every error with a problem document."""

    def handles(kind: type[Exception]) -> Callable[[Callable[[Request, Any], Awaitable[Response]]], None]:
        return lambda handler: app.add_exception_handler(kind, handler)

    @handles(OptodriveError)
    async def handle_optodrive_error(request: Request, error: OptodriveError) -> Response:
        return _build_response(build_error_problem(error))

    @handles(RequestValidationError)
    async def handle_validation_error(request: Request, error: RequestValidationError) -> Response:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        return _build_response(build_problem(422, "bad_input", "Bad input", f"{where}: {first['msg']}", where=where))

    @handles(HTTPException)
    async def handle_http_error(request: Request, error: HTTPException) -> Response:
        code = {404: "route_not_found", 405: "method_not_allowed"}.get(error.status_code, "http_error")
        detail = f"{request.method} {request.url.path}"
        return _build_response(build_problem(error.status_code, code, str(error.detail), detail))

    @handles(BodyTooLargeError)
    async def handle_body_too_large(request: Request, error: BodyTooLargeError) -> Response:
        detail = "the body exceeds the maximum size"
        return _build_response(build_problem(413, "body_too_large", "Body too large", detail))


def _build_response(problem: Problem) -> Response:
    return Response(problem.to_json(), status_code=problem.status, media_type=MEDIA_TYPE)
