"""Who may talk to the daemon: a bearer token, the Host it was asked by, the Origin it was asked from, bodies bounded.

One pure-ASGI middleware in front of every route, so that a new route cannot forget it.
"""

import json
import secrets
from collections.abc import Awaitable, Callable, Iterable, MutableMapping
from typing import Any

Scope = MutableMapping[str, Any]
Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

LOOPBACK_NAMES = ("127.0.0.1", "localhost", "[::1]")
OPEN_PATHS = ("/v1/health",)


def problem(status: int, code: str, title: str, detail: str, **more: object) -> dict[str, object]:
    """An RFC 9457 problem document with a stable code."""
    return {"type": f"urn:optodrive:{code}", "title": title, "status": status, "detail": detail, "code": code, **more}


class Guard:
    """ASGI middleware: Host, Origin, token, body size, in that order."""

    def __init__(self, app: App, token: str, hosts: Iterable[str], body_max_bytes: int) -> None:
        self._app = app
        self._token = token.encode()
        self._hosts = {*LOOPBACK_NAMES, *hosts}
        self._body_max_bytes = body_max_bytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a refusal, or pass the request on."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        headers = {name.decode("latin-1"): value.decode("latin-1") for name, value in scope["headers"]}
        refusal = self._refusal(scope["path"], headers)
        if refusal is not None:
            prefix = "websocket.http" if scope["type"] == "websocket" else "http"
            await _answer(send, refusal, prefix)
            return
        bounded = _BoundedBody(receive, self._body_max_bytes)
        await self._app(scope, bounded, send)

    def _refusal(self, path: str, headers: dict[str, str]) -> dict[str, object] | None:
        host = headers.get("host", "")
        if _hostname(host) not in self._hosts:
            return problem(421, "foreign_host", "Misdirected request", f"this daemon does not answer to host {host!r}")
        origin = headers.get("origin")
        if origin is not None and _hostname(origin.partition("://")[2]) not in self._hosts:
            return problem(403, "foreign_origin", "Foreign origin", f"requests from {origin!r} are not answered")
        if path not in OPEN_PATHS:
            scheme, _, given = headers.get("authorization", "").partition(" ")
            if scheme.lower() != "bearer" or not secrets.compare_digest(given.strip().encode(), self._token):
                return problem(
                    401, "bad_token", "Not authorised", "a bearer token is needed; the daemon wrote it to a file"
                )
        length = headers.get("content-length", "0")
        if not length.isdigit() or int(length) > self._body_max_bytes:
            return problem(
                413,
                "body_too_large",
                "Body too large",
                f"at most {self._body_max_bytes} bytes, announced {length[:20]}",
            )
        return None


def _hostname(authority: str) -> str:
    authority = authority.strip().lower()
    if authority.startswith("["):
        return authority.partition("]")[0] + "]"
    return authority.partition(":")[0]


class BodyTooLargeError(Exception):
    """A body grew past its bound while it was read."""


class _BoundedBody:
    """Counts what arrives, for bodies that announce no length."""

    def __init__(self, receive: Receive, limit_bytes: int) -> None:
        self._receive = receive
        self._left = limit_bytes

    async def __call__(self) -> Message:
        message = await self._receive()
        if message["type"] == "http.request":
            self._left -= len(message.get("body", b""))
            if self._left < 0:
                raise BodyTooLargeError
        return message


async def _answer(send: Send, document: dict[str, object], prefix: str) -> None:
    body = json.dumps(document).encode()
    headers = [(b"content-type", b"application/problem+json"), (b"content-length", str(len(body)).encode())]
    if document["status"] == 401:
        headers.append((b"www-authenticate", b"Bearer"))
    if document["status"] == 413:
        headers.append((b"connection", b"close"))
    await send({"type": f"{prefix}.response.start", "status": document["status"], "headers": headers})
    await send({"type": f"{prefix}.response.body", "body": body})
