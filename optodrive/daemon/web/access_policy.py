"""Who may talk to the daemon: the Host it was asked by, the Origin it was asked from, a bearer token and its role.

One pure-ASGI middleware in front of every route, so that a new route cannot forget it: what is not in the table of
`roles.py` is not answered. Requests are counted and bodies bounded, but for STOP.
"""

import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass

from optodrive.daemon.web.audit import AuditLog
from optodrive.daemon.web.rate_limit import RateLimiter
from optodrive.daemon.web.request_limits import (
    App,
    BoundedBody,
    Message,
    RateLimitedFrames,
    Receive,
    Scope,
    Send,
    receive_empty_body,
)
from optodrive.daemon.web.roles import ARM, ROUTES, STOP, Route, RouteTable, is_role_sufficient
from optodrive.daemon.web.static_files import SECURITY_HEADERS, is_page_request, load_login_page, read_cookie_token
from optodrive.daemon.web.tokens import Token, Tokens
from optodrive.device.config import DaemonSection

LOOPBACK_NAMES = ("127.0.0.1", "localhost", "[::1]")
AUDIT_FIELDS = "optodrive.facts"
"""Where a route leaves what the audit file is to say of a call, in its scope."""
ANONYMOUS = Token("", "viewer", "")
Problem = dict[str, object]


def build_problem(status: int, code: str, title: str, detail: str, **more: object) -> Problem:
    """An RFC 9457 problem document with a stable code."""
    return {"type": f"urn:optodrive:{code}", "title": title, "status": status, "detail": detail, "code": code, **more}


class AccessPolicy:
    """What the guard goes by: tokens and bounds, which may change while it stands, and the audit file."""

    def __init__(
        self,
        tokens: Tokens,
        daemon: DaemonSection,
        audit: AuditLog | None = None,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self.audit = audit
        self.now_s = now_s
        self.route_table = RouteTable(ROUTES)
        self.update(tokens, daemon)

    def update(self, tokens: Tokens, daemon: DaemonSection) -> None:
        """Go by other tokens and bounds from now on."""
        self.tokens = tokens
        self.hosts = {*LOOPBACK_NAMES, *daemon.hosts}
        self.body_max_bytes = daemon.body_max_bytes
        self.rate_limiter = RateLimiter(daemon.requests_per_s, daemon.requests_burst)


@dataclass
class _RequestContext:
    """A request on its way through the guard."""

    method: str
    path: str
    headers: dict[str, str]
    address: str
    token: Token = ANONYMOUS
    route: Route | None = None

    @property
    def audit_fields(self) -> dict[str, object]:
        """Who calls what, for the audit file."""
        return {
            "name": self.token.name,
            "role": self.token.role,
            "address": self.address,
            "call": f"{self.method} {self.path[:200]}",
        }


class AccessMiddleware:
    """ASGI middleware: Host, Origin, token, rate, route, role, body size, in that order."""

    def __init__(self, app: App, policy: AccessPolicy) -> None:
        self._app = app
        self._policy = policy

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a refusal, or pass the request on."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        request = _build_request_context(scope)
        refusal = self._check_request(request)
        if refusal is None and request.route is not None and request.route.key == ARM:
            refusal = await self._record_intent(request)
        if refusal is not None:
            if request.route is not None and refusal["status"] != 429:
                self._record(request, {"event": "refused", "status": refusal["status"], "code": refusal["code"]})
            prefix = "websocket.http" if scope["type"] == "websocket" else "http"
            page = (
                load_login_page()
                if refusal["status"] == 401 and is_page_request(request.method, request.path)
                else None
            )
            await _send_problem(send, refusal, prefix, page)
            return
        await self._forward(request, scope, receive, send)

    async def _forward(self, request: _RequestContext, scope: Scope, receive: Receive, send: Send) -> None:
        body = self._bound_receive(request, receive)
        audit_fields: dict[str, object] = {}
        scope[AUDIT_FIELDS] = audit_fields
        status_recorder = _StatusRecorder(send)
        try:
            await self._app(scope, body, status_recorder)
        finally:
            if isinstance(body, BoundedBody | RateLimitedFrames):
                audit_fields |= body.audit_fields
            self._record(request, {**audit_fields, "event": "answered", "status": status_recorder.status})

    def _bound_receive(self, request: _RequestContext, receive: Receive) -> Receive:
        if request.route is not None and request.route.key == STOP:
            return receive_empty_body
        if request.method == "WEBSOCKET":
            policy, caller = self._policy, (request.token.name, request.address, "frames")
            return RateLimitedFrames(receive, lambda: policy.rate_limiter.acquire(caller, policy.now_s()))
        return BoundedBody(receive, self._policy.body_max_bytes)

    # --- refusals, in this order --------------------------------------------------------------------------------

    def _check_request(self, request: _RequestContext) -> Problem | None:
        refusal = self._check_origin(request)
        if refusal is not None:
            return refusal
        route = self._policy.route_table.find(request.method, request.path)
        stop = route is not None and route.key == STOP
        if route is None or route.min_role is not None:
            token = self._policy.tokens.find(_read_presented_token(request))
            if token is None:
                rate_problem = None if stop else self._check_rate(request)
                return rate_problem or build_problem(
                    401, "bad_token", "Not authorised", "a bearer token is needed; the daemon wrote it to a file"
                )
            request.token = token
        request.route = route
        if stop:
            return None
        return self._check_rate(request) or self._check_route(request) or self._check_size(request)

    def _check_origin(self, request: _RequestContext) -> Problem | None:
        host = request.headers.get("host", "")
        if _parse_hostname(host) not in self._policy.hosts:
            return build_problem(
                421, "foreign_host", "Misdirected request", f"this daemon does not answer to host {host!r}"
            )
        origin = request.headers.get("origin")
        if origin is not None and _parse_hostname(origin.partition("://")[2]) not in self._policy.hosts:
            return build_problem(403, "foreign_origin", "Foreign origin", f"requests from {origin!r} are not answered")
        return None

    def _check_rate(self, request: _RequestContext) -> Problem | None:
        wait_s = self._policy.rate_limiter.acquire((request.token.name, request.address), self._policy.now_s())
        if wait_s <= 0.0:
            return None
        detail = f"this caller asks too often; again in {wait_s:.3f} s"
        return build_problem(429, "too_many_requests", "Too many requests", detail, retry_after_s=round(wait_s, 3))

    def _check_route(self, request: _RequestContext) -> Problem | None:
        method_and_path = f"{request.method} {request.path}"
        if request.route is None:
            methods = self._policy.route_table.find_methods(request.path)
            if methods:
                return build_problem(
                    405, "method_not_allowed", "Method Not Allowed", method_and_path, allow=", ".join(methods)
                )
            return build_problem(404, "no_such_route", "Not Found", method_and_path)
        min_role = request.route.min_role
        if min_role is not None and not is_role_sufficient(request.token.role, min_role):
            detail = f"{method_and_path} asks for a token of role {min_role}; this one, {request.token.name!r}, is a {request.token.role}'s"
            return build_problem(403, "role_too_low", "Forbidden", detail, role=request.token.role, needed=min_role)
        return None

    def _check_size(self, request: _RequestContext) -> Problem | None:
        length = request.headers.get("content-length", "0")
        limit = self._policy.body_max_bytes
        if length.isdigit() and int(length) <= limit:
            return None
        return build_problem(413, "body_too_large", "Body too large", f"at most {limit} bytes, announced {length[:20]}")

    # --- the audit file -----------------------------------------------------------------------------------------

    async def _record_intent(self, request: _RequestContext) -> Problem | None:
        if self._policy.audit is None:
            return None
        error_text = await self._policy.audit.record_durably(request.audit_fields | {"event": "asked"})
        if error_text is None:
            return None
        detail = f"the audit file cannot be written ({error_text}), and nothing is armed without it"
        return build_problem(409, "not_audited", "Not audited", detail)

    def _record(self, request: _RequestContext, audit_fields: dict[str, object]) -> None:
        if self._policy.audit is not None and request.route is not None and request.route.is_audited:
            self._policy.audit.record(request.audit_fields | audit_fields)


class _StatusRecorder:
    """Passes answers on and remembers the status."""

    def __init__(self, send: Send) -> None:
        self._send = send
        self.status: int | None = None

    async def __call__(self, message: Message) -> None:
        if message["type"] == "http.response.start":
            self.status = message["status"]
        elif message["type"] == "websocket.accept":
            self.status = 101
        await self._send(message)


def _build_request_context(scope: Scope) -> _RequestContext:
    headers = {name.decode("latin-1"): value.decode("latin-1") for name, value in scope["headers"]}
    client = scope.get("client")
    # A caller at the Unix socket has no address.
    address = client[0] if client and client[0] else "unix"
    return _RequestContext(scope.get("method", "WEBSOCKET"), scope["path"], headers, address)


def _read_presented_token(request: _RequestContext) -> str:
    scheme, _, credentials = request.headers.get("authorization", "").partition(" ")
    if not scheme and is_page_request(request.method, request.path):
        return read_cookie_token(request.headers)
    return credentials.strip() if scheme.lower() == "bearer" else ""


def _parse_hostname(authority: str) -> str:
    authority = authority.strip().lower()
    if authority.startswith("["):
        return authority.partition("]")[0] + "]"
    return authority.partition(":")[0]


async def _send_problem(send: Send, document: Problem, prefix: str, login_page_html: bytes | None = None) -> None:
    body, content_type = (
        (json.dumps(document).encode(), b"application/problem+json")
        if login_page_html is None
        else (login_page_html, b"text/html")
    )
    headers = [(b"content-type", content_type), (b"content-length", str(len(body)).encode())]
    if login_page_html is not None:
        headers += [(name.lower().encode(), value.encode()) for name, value in SECURITY_HEADERS.items()]
    if document["status"] == 401:
        headers.append((b"www-authenticate", b"Bearer"))
    if document["status"] == 405:
        headers.append((b"allow", str(document["allow"]).encode()))
    if document["status"] == 413:
        headers.append((b"connection", b"close"))
    if document["status"] == 429:
        headers.append((b"retry-after", str(math.ceil(float(str(document["retry_after_s"])))).encode()))
    await send({"type": f"{prefix}.response.start", "status": document["status"], "headers": headers})
    await send({"type": f"{prefix}.response.body", "body": body})
