"""Who may talk to the daemon: the Host it was asked by, the Origin it was asked from, a bearer token and its role.

One pure-ASGI middleware in front of every route, so that a new route cannot forget it: what is not in the table of
`roles.py` is not answered. Requests are counted and bodies bounded, but for STOP.
"""

import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass

from optodrive.daemon.web.audit import Audit
from optodrive.daemon.web.rate_limit import Rates
from optodrive.daemon.web.request_limits import App, BoundedBody, Message, PacedFrames, Receive, Scope, Send, nothing
from optodrive.daemon.web.roles import ARM, ROUTES, STOP, Route, RouteTable, allows
from optodrive.daemon.web.static_files import HEADERS, cookie_token, is_page, login_page
from optodrive.daemon.web.tokens import Token, Tokens
from optodrive.device.config import DaemonSection

LOOPBACK_NAMES = ("127.0.0.1", "localhost", "[::1]")
FACTS = "optodrive.facts"
"""Where a route leaves what the audit file is to say of a call, in its scope."""
NOBODY = Token("", "viewer", "")
Problem = dict[str, object]


def problem(status: int, code: str, title: str, detail: str, **more: object) -> Problem:
    """An RFC 9457 problem document with a stable code."""
    return {"type": f"urn:optodrive:{code}", "title": title, "status": status, "detail": detail, "code": code, **more}


class Door:
    """What the guard goes by: tokens and bounds, which may change while it stands, and the audit file."""

    def __init__(
        self,
        tokens: Tokens,
        daemon: DaemonSection,
        audit: Audit | None = None,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self.audit = audit
        self.now_s = now_s
        self.table = RouteTable(ROUTES)
        self.take(tokens, daemon)

    def take(self, tokens: Tokens, daemon: DaemonSection) -> None:
        """Go by other tokens and bounds from now on."""
        self.tokens = tokens
        self.hosts = {*LOOPBACK_NAMES, *daemon.hosts}
        self.body_max_bytes = daemon.body_max_bytes
        self.rates = Rates(daemon.requests_per_s, daemon.requests_burst)


@dataclass
class _Call:
    """A request on its way through the guard."""

    method: str
    path: str
    headers: dict[str, str]
    address: str
    who: Token = NOBODY
    route: Route | None = None

    @property
    def facts(self) -> dict[str, object]:
        """Who calls what, for the audit file."""
        return {
            "name": self.who.name,
            "role": self.who.role,
            "address": self.address,
            "call": f"{self.method} {self.path[:200]}",
        }


class Guard:
    """ASGI middleware: Host, Origin, token, rate, route, role, body size, in that order."""

    def __init__(self, app: App, door: Door) -> None:
        self._app = app
        self._door = door

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a refusal, or pass the request on."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        call = _call(scope)
        refusal = self._refusal(call)
        if refusal is None and call.route is not None and call.route.key == ARM:
            refusal = await self._unaudited(call)
        if refusal is not None:
            if call.route is not None and refusal["status"] != 429:
                self._note(call, {"event": "refused", "status": refusal["status"], "code": refusal["code"]})
            prefix = "websocket.http" if scope["type"] == "websocket" else "http"
            page = login_page() if refusal["status"] == 401 and is_page(call.method, call.path) else None
            await _answer(send, refusal, prefix, page)
            return
        await self._pass_on(call, scope, receive, send)

    async def _pass_on(self, call: _Call, scope: Scope, receive: Receive, send: Send) -> None:
        body = self._bounded(call, receive)
        facts: dict[str, object] = {}
        scope[FACTS] = facts
        told = _Told(send)
        try:
            await self._app(scope, body, told)
        finally:
            if isinstance(body, BoundedBody | PacedFrames):
                facts |= body.facts
            self._note(call, {**facts, "event": "answered", "status": told.status})

    def _bounded(self, call: _Call, receive: Receive) -> Receive:
        if call.route is not None and call.route.key == STOP:
            return nothing
        if call.method == "WEBSOCKET":
            door, caller = self._door, (call.who.name, call.address, "frames")
            return PacedFrames(receive, lambda: door.rates.wait_s(caller, door.now_s()))
        return BoundedBody(receive, self._door.body_max_bytes)

    # --- refusals, in this order --------------------------------------------------------------------------------

    def _refusal(self, call: _Call) -> Problem | None:
        refusal = self._foreign(call)
        if refusal is not None:
            return refusal
        route = self._door.table.find(call.method, call.path)
        stop = route is not None and route.key == STOP
        if route is None or route.least is not None:
            found = self._door.tokens.find(_presented(call))
            if found is None:
                too_many = None if stop else self._too_many(call)
                return too_many or problem(
                    401, "bad_token", "Not authorised", "a bearer token is needed; the daemon wrote it to a file"
                )
            call.who = found
        call.route = route
        if stop:
            return None
        return self._too_many(call) or self._out_of_place(call) or self._too_large(call)

    def _foreign(self, call: _Call) -> Problem | None:
        host = call.headers.get("host", "")
        if _hostname(host) not in self._door.hosts:
            return problem(421, "foreign_host", "Misdirected request", f"this daemon does not answer to host {host!r}")
        origin = call.headers.get("origin")
        if origin is not None and _hostname(origin.partition("://")[2]) not in self._door.hosts:
            return problem(403, "foreign_origin", "Foreign origin", f"requests from {origin!r} are not answered")
        return None

    def _too_many(self, call: _Call) -> Problem | None:
        wait_s = self._door.rates.wait_s((call.who.name, call.address), self._door.now_s())
        if wait_s <= 0.0:
            return None
        detail = f"this caller asks too often; again in {wait_s:.3f} s"
        return problem(429, "too_many_requests", "Too many requests", detail, retry_after_s=round(wait_s, 3))

    def _out_of_place(self, call: _Call) -> Problem | None:
        asked = f"{call.method} {call.path}"
        if call.route is None:
            methods = self._door.table.methods(call.path)
            if methods:
                return problem(405, "method_not_allowed", "Method Not Allowed", asked, allow=", ".join(methods))
            return problem(404, "no_such_route", "Not Found", asked)
        least = call.route.least
        if least is not None and not allows(call.who.role, least):
            detail = f"{asked} asks for a token of role {least}; this one, {call.who.name!r}, is a {call.who.role}'s"
            return problem(403, "role_too_low", "Forbidden", detail, role=call.who.role, needed=least)
        return None

    def _too_large(self, call: _Call) -> Problem | None:
        length = call.headers.get("content-length", "0")
        limit = self._door.body_max_bytes
        if length.isdigit() and int(length) <= limit:
            return None
        return problem(413, "body_too_large", "Body too large", f"at most {limit} bytes, announced {length[:20]}")

    # --- the audit file -----------------------------------------------------------------------------------------

    async def _unaudited(self, call: _Call) -> Problem | None:
        if self._door.audit is None:
            return None
        trouble = await self._door.audit.must(call.facts | {"event": "asked"})
        if trouble is None:
            return None
        detail = f"the audit file cannot be written ({trouble}), and nothing is armed without it"
        return problem(409, "not_audited", "Not audited", detail)

    def _note(self, call: _Call, facts: dict[str, object]) -> None:
        if self._door.audit is not None and call.route is not None and call.route.changes_something:
            self._door.audit.note(call.facts | facts)


class _Told:
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


def _call(scope: Scope) -> _Call:
    headers = {name.decode("latin-1"): value.decode("latin-1") for name, value in scope["headers"]}
    client = scope.get("client")
    # A caller at the Unix socket has no address.
    address = client[0] if client and client[0] else "unix"
    return _Call(scope.get("method", "WEBSOCKET"), scope["path"], headers, address)


def _presented(call: _Call) -> str:
    scheme, _, given = call.headers.get("authorization", "").partition(" ")
    if not scheme and is_page(call.method, call.path):
        return cookie_token(call.headers)
    return given.strip() if scheme.lower() == "bearer" else ""


def _hostname(authority: str) -> str:
    authority = authority.strip().lower()
    if authority.startswith("["):
        return authority.partition("]")[0] + "]"
    return authority.partition(":")[0]


async def _answer(send: Send, document: Problem, prefix: str, page: bytes | None = None) -> None:
    body, kind = (json.dumps(document).encode(), b"application/problem+json") if page is None else (page, b"text/html")
    headers = [(b"content-type", kind), (b"content-length", str(len(body)).encode())]
    if page is not None:
        headers += [(name.lower().encode(), value.encode()) for name, value in HEADERS.items()]
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
