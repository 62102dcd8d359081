"""Problem documents for errors that routes and the framework raise."""

import math
from collections.abc import Awaitable, Callable
from functools import partial
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError, ValidationException, WebSocketRequestValidationError
from fastapi.responses import Response
from starlette.exceptions import HTTPException
from starlette.websockets import WebSocket

from optodrive.core.errors import BusyError, InputError, OptodriveError
from optodrive.daemon.api.request_limits import BodyTooLargeError, Send
from optodrive.daemon.api.static_files import SECURITY_HEADERS, load_login_page
from optodrive.daemon.responses.problem import MEDIA_TYPE, Problem, build_error_problem, build_problem


async def send_problem(send: Send, problem: Problem, prefix: str) -> None:
    """Send a problem document. prefix: of the messages, `http` or `websocket.http`."""
    headers = []
    if problem.status == 401:
        headers.append((b"www-authenticate", b"Bearer"))
    if problem.required_role is not None:  # RFC 6750, section 3
        headers.append(
            (b"www-authenticate", f'Bearer error="insufficient_scope", scope="{problem.required_role}"'.encode())
        )
    if problem.allow is not None:
        headers.append((b"allow", problem.allow.encode()))
    if problem.status == 413:
        headers.append((b"connection", b"close"))
    if problem.retry_after_s is not None:
        headers.append((b"retry-after", str(math.ceil(problem.retry_after_s)).encode()))
    await _send_response(send, prefix, problem.status, problem.to_json(), MEDIA_TYPE, headers)


async def send_login_page(send: Send, prefix: str) -> None:
    """Send the login page. prefix: as of send_problem."""
    headers = [(name.lower().encode(), value.encode()) for name, value in SECURITY_HEADERS.items()]
    headers.append((b"www-authenticate", b"Bearer"))
    await _send_response(send, prefix, 401, load_login_page(), "text/html", headers)


async def _send_response(
    send: Send, prefix: str, status: int, body: bytes, content_type: str, headers: list[tuple[bytes, bytes]]
) -> None:
    headers = [
        (b"content-type", content_type.encode()),
        (b"content-length", str(len(body)).encode()),
        *headers,
    ]
    await send({"type": f"{prefix}.response.start", "status": status, "headers": headers})
    await send({"type": f"{prefix}.response.body", "body": body})


def add_error_handlers(app: FastAPI) -> None:
    """Answer every error with a problem document."""

    def handles(kind: type[Exception]) -> Callable[[Callable[[Request, Any], Awaitable[Response]]], None]:
        return lambda handler: app.add_exception_handler(kind, handler)

    @handles(OptodriveError)
    async def handle_optodrive_error(request: Request, error: OptodriveError) -> Response:
        return _build_response(build_error_problem(error))

    @handles(RequestValidationError)
    async def handle_validation_error(request: Request, error: RequestValidationError) -> Response:
        return _build_response(_describe_invalid_value(error))

    @partial(app.add_exception_handler, WebSocketRequestValidationError)
    async def handle_socket_validation_error(socket: WebSocket, error: Any) -> None:
        await socket.send_denial_response(_build_response(_describe_invalid_value(error)))

    @handles(HTTPException)
    async def handle_http_error(request: Request, error: HTTPException) -> Response:
        code = {404: "route_not_found", 405: "method_not_allowed"}.get(error.status_code, "http_error")
        detail = f"{request.method} {request.url.path}"
        return _build_response(build_problem(error.status_code, code, str(error.detail), detail))

    @handles(BodyTooLargeError)
    async def handle_body_too_large(request: Request, error: BodyTooLargeError) -> Response:
        detail = "the body exceeds the maximum size"
        response = _build_response(build_problem(413, "body_too_large", "Body too large", detail))
        response.headers["Connection"] = "close"  # the rest of its body may follow
        return response

    @handles(MemoryError)
    async def handle_memory_error(request: Request, error: MemoryError) -> Response:
        return _build_response(build_error_problem(BusyError("not enough memory for this request; try again later")))


def _describe_invalid_value(error: ValidationException) -> Problem:
    """Return the problem document for the first value of a query or a path that is invalid."""
    first = error.errors()[0]
    where = ".".join(str(part) for part in first["loc"])
    return build_error_problem(InputError(where, first["input"], first["msg"].removeprefix("Input should be ")))


def _build_response(problem: Problem) -> Response:
    return Response(problem.to_json(), status_code=problem.status, media_type=MEDIA_TYPE)
