"""Responses that the access middleware sends in place of the application."""

import math

from optodrive.daemon.api.request_limits import Send
from optodrive.daemon.api.static_files import SECURITY_HEADERS, load_login_page
from optodrive.daemon.responses.problem import MEDIA_TYPE, Problem


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
