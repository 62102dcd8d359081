"""The access policy: which Host, Origin, token, role, rate, body size and options a request needs.

The checks run in that order, before any route. STOP needs a token of any role; its rate, query and body are not
checked, because a STOP that is refused leaves the laser on.
"""

import asyncio
import time
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal
from urllib.parse import parse_qsl

from optodrive.core.errors import InputError, Unquoted, suggest_nearest
from optodrive.daemon.api.audit import AuditLog, RefusalAudit
from optodrive.daemon.api.error_handlers import send_problem
from optodrive.daemon.api.host_check import (
    LOOPBACK_NAMES,
    TEXT_MAX,
    check_host_and_origin,
    is_websocket_request,
    read_subprotocol_token,
)
from optodrive.daemon.api.request_limits import Message, Receive, Send
from optodrive.daemon.api.route_table import STOP, Route, RouteTable
from optodrive.daemon.api.static_files import is_page_request, read_cookie_token
from optodrive.daemon.api.tokens import ANONYMOUS, Token, Tokens, is_role_sufficient
from optodrive.daemon.responses.problem import Problem, build_error_problem, build_problem
from optodrive.device.config_sections import DaemonSection

POLICY_VIOLATION = 1008
EVENT_STREAM = b"text/event-stream"


def build_revoked_problem(token: Token) -> Problem:
    """Build the answer to a request whose token was revoked meanwhile."""
    return build_problem(401, "token_revoked", "Not authorised", f"the token {token.name!r} was revoked")


class RequestInProgress:
    """Input and output of a request.

    status: of its response, None before that; 101 for an open WebSocket
    """

    def __init__(self, kind: Literal["http", "websocket"], receive: Receive, send: Send) -> None:
        self.status: int | None = None
        self.is_revoked = False
        self._kind = kind
        self._receive = receive
        self._send = send
        self._is_event_stream = False

    async def receive(self) -> Message:
        """Return the next message, the end of the connection once the token is revoked."""
        # The test comes after the wait: most requests are revoked while they wait for input.
        message = await self._receive()
        return {"type": f"{self._kind}.disconnect"} if self.is_revoked else message

    async def send(self, message: Message) -> None:
        """Send a message, unless the token is revoked."""
        if self.is_revoked:
            return
        if message["type"].endswith("response.start"):
            self.status = message["status"]
            self._is_event_stream = any(
                name == b"content-type" and value.startswith(EVENT_STREAM) for name, value in message["headers"]
            )
        elif message["type"] == "websocket.accept":
            self.status = 101
        await self._send(message)

    def revoke(self) -> bool:
        """End the input and output of the application. Return False for a response that is being sent, which may end.

        A stream of events has no end of its own.
        """
        # A response that has begun has a length that its client expects, and ends soon by itself.
        self.is_revoked = self._kind == "websocket" or self.status is None or self._is_event_stream
        return self.is_revoked

    async def send_end(self, problem: Problem) -> None:
        """Send the end of a revoked request, with one line."""
        if self.status is None:
            self.status = problem.status
            await send_problem(self._send, problem, "http" if self._kind == "http" else "websocket.http")
        elif self._kind == "websocket":
            await self._send({"type": "websocket.close", "code": POLICY_VIOLATION, "reason": problem.detail})
        else:
            await self._send({"type": "http.response.body", "body": f": {problem.detail}\n\n".encode()})


class RequestsInProgress:
    """The requests in progress. STOP is not among them: it is never ended."""

    def __init__(self) -> None:
        self._requests: dict[RequestInProgress, Token] = {}

    @contextmanager
    def track(self, request: RequestInProgress, token: Token) -> Iterator[None]:
        """Track a request while it is served."""
        self._requests[request] = token
        try:
            yield
        finally:
            del self._requests[request]

    def revoke(self, tokens: Iterable[Token]) -> list[asyncio.Task[None]]:
        """End the requests of some tokens at once. Return the tasks that say so to their clients."""
        revoked = set(tokens)
        return [
            asyncio.create_task(request.send_end(build_revoked_problem(token)))
            for request, token in self._requests.items()
            # By the token itself and not by its name: a new token of the same name must survive.
            if token in revoked and request.revoke()
        ]


CALLERS_MAX = 1024
"""The number of callers with a bucket; the bucket of the caller with the oldest request is dropped first."""


@dataclass
class _Bucket:
    tokens: float
    updated_s: float


class RateLimiter:
    """Limits each caller to `per_s` requests per second on average and `burst` at once."""

    def __init__(self, per_s: float, burst: float) -> None:
        self._per_s = per_s
        self._burst = max(burst, 1.0)
        self._buckets: OrderedDict[Hashable, _Bucket] = OrderedDict()

    def acquire(self, caller: Hashable, now_s: float) -> float:
        """Take one token: return 0 if there is one, else the time until there is, s."""
        # Popped and inserted again, so that the oldest request is first in the dict.
        bucket = self._buckets.pop(caller, None) or _Bucket(self._burst, now_s)
        bucket.tokens = min(self._burst, bucket.tokens + (now_s - bucket.updated_s) * self._per_s)
        bucket.updated_s = now_s
        self._buckets[caller] = bucket
        while len(self._buckets) > CALLERS_MAX:
            self._buckets.popitem(last=False)
        if bucket.tokens < 1.0:
            return (1.0 - bucket.tokens) / self._per_s
        bucket.tokens -= 1.0
        return 0.0


PLACE_OF_FILE = "the daemon names the file of its tokens at its start"


@dataclass
class RequestContext:
    """A request as far as the policy has identified it: its query, headers, address, token and route."""

    method: str
    path: str
    headers: dict[str, str]
    address: str
    token: Token = ANONYMOUS
    route: Route | None = None
    query: str = ""

    @property
    def audit_fields(self) -> dict[str, object]:
        """Fields for the audit log: the caller, its address and the call."""
        return {
            "name": self.token.name,
            "role": self.token.role if self.token.secret else None,
            "address": self.address,
            "call": f"{self.method} {self.path[:200]}",
        }

    @property
    def provenance(self) -> dict[str, object]:
        """Fields for the audit log of a refusal: the Host and Origin that the request states, if it does."""
        return {name: self.headers[name][:TEXT_MAX] for name in ("host", "origin") if name in self.headers}


class AccessPolicy:
    """The tokens and limits that requests are checked against, and the audit log.

    Tokens and limits may be replaced at run time. now_s: monotonic clock; in_progress: requests that were accepted.
    """

    def __init__(
        self,
        tokens: Tokens,
        daemon: DaemonSection,
        audit: AuditLog | None = None,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self.audit = audit
        self.refusals = RefusalAudit(audit, now_s)
        self.in_progress = RequestsInProgress()
        self.tokens = Tokens(())
        self._now_s = now_s
        self.update(tokens, daemon)

    def update(self, tokens: Tokens, daemon: DaemonSection) -> tuple[Token, ...]:
        """Replace the tokens and limits. Every caller's rate limit starts anew. Return the tokens that are revoked."""
        # In one step of the loop: no request is accepted in between with a token that is revoked.
        revoked, self.tokens = self.tokens.find_revoked(tokens), tokens
        self.body_max_bytes = daemon.body_max_bytes
        self._hosts = {*LOOPBACK_NAMES, *map(str.lower, daemon.hosts)}
        self._rate_limiter = RateLimiter(daemon.requests_per_s, daemon.requests_burst)
        return revoked

    def is_revoked(self, token: Token) -> bool:
        """Return whether a token that was accepted is no longer valid."""
        return token is not ANONYMOUS and token not in self.tokens.all

    def check(self, request: RequestContext, table: RouteTable) -> Problem | None:
        """Identify token and route of a request. Return why it is refused, or None if it is accepted."""
        # First: a page of another site, whose browser sends the cookie along, must learn nothing.
        problem = check_host_and_origin(request.headers, self._hosts)
        if problem is not None:
            return problem
        route = table.find(request.method, request.path)
        is_stop = route is not None and route.key == STOP
        # An unknown path needs a token too, so that nobody without one can list the routes.
        if route is None or route.min_role is not None:
            token = self.find_token(request)
            if token is None:
                # A caller without a valid token has a rate, too.
                rate_problem = None if is_stop else self._check_rate(request)
                return rate_problem or _build_token_problem(_read_presented_token(request))
            request.token = token
        request.route = route
        if is_stop:
            return None
        return (
            self._check_rate(request)
            or self._check_route(request, table)
            or self._check_size(request)
            or _check_options(request)
        )

    def find_token(self, request: RequestContext) -> Token | None:
        """Return the valid token that a request presents, None if there is none."""
        return self.tokens.find(_read_presented_token(request))

    def permits_stop(self, request: RequestContext) -> bool:
        """Return whether `check` accepts this request if it is for STOP, which needs a token of any role."""
        return check_host_and_origin(request.headers, self._hosts) is None and self.find_token(request) is not None

    def acquire_frame(self, request: RequestContext) -> float:
        """Count one streamed frame against the caller's rate, and return the time to wait first, s."""
        return self._rate_limiter.acquire((request.token.name, request.address, "frames"), self._now_s())

    def _check_rate(self, request: RequestContext) -> Problem | None:
        wait_s = self._rate_limiter.acquire((request.token.name, request.address), self._now_s())
        if wait_s <= 0.0:
            return None
        detail = f"this caller exceeds its request rate; retry in {wait_s:.3f} s"
        return build_problem(429, "too_many_requests", "Too many requests", detail, retry_after_s=round(wait_s, 3))

    def _check_route(self, request: RequestContext, table: RouteTable) -> Problem | None:
        method_and_path = f"{request.method} {request.path}"
        if request.route is None:
            methods = table.find_methods(request.path)
            if methods:
                return build_problem(
                    405, "method_not_allowed", "Method Not Allowed", method_and_path, allow=", ".join(methods)
                )
            detail = f"{method_and_path}: {table.suggest_path(request.path)}"
            return build_problem(404, "route_not_found", "Not Found", detail)
        token, min_role = request.token, request.route.min_role
        if min_role is not None and not is_role_sufficient(token.role, min_role):
            detail = (
                f"{method_and_path} requires a token of role {min_role}; token {token.name!r} has role {token.role}"
            )
            return build_problem(403, "insufficient_role", "Forbidden", detail, role=token.role, required_role=min_role)
        return None

    def _check_size(self, request: RequestContext) -> Problem | None:
        length = request.headers.get("content-length", "0")
        limit = self.body_max_bytes
        # Only what the request states; `BoundedBody` counts what arrives.
        if length.isdigit() and int(length) <= limit:
            return None
        detail = f"content-length: got {length[:20]}, expected at most {limit} bytes"
        return build_problem(413, "body_too_large", "Body too large", detail)


def _build_token_problem(presented: str) -> Problem:
    """Build the problem document of a request without a valid token."""
    detail = "a token is required, in the header `Authorization: Bearer TOKEN`"
    if presented:
        detail = "the token of this request is not one of the daemon's"
    return build_problem(401, "bad_token", "Not authorised", f"{detail}; {PLACE_OF_FILE}")


def _check_options(request: RequestContext) -> Problem | None:
    """Return why a request is refused whose query or body says something that its route does not read."""
    assert request.route is not None  # noqa: S101 - checked before
    try:
        check_query(request.query, request.route.options)
    except InputError as error:
        return build_error_problem(error)
    has_body = request.headers.get("content-length", "0") != "0" or "transfer-encoding" in request.headers
    if has_body and not request.route.takes_body:
        return build_error_problem(InputError("body", Unquoted("a body"), f"none: {request.route.key} takes no body"))
    return None


def check_query(query: str, known: Sequence[str]) -> None:
    """Raise InputError for a key that a query may not have, and for one that it has twice."""
    seen = set()
    for key, _ in parse_qsl(query, keep_blank_values=True):
        if key not in known:
            expected = f"a known key, {suggest_nearest(key[:60], list(known))}" if known else "no query"
            raise InputError("query", key, expected, code="unknown_key")
        if key in seen:
            raise InputError("query", key, "each key once", code="repeated_key")
        seen.add(key)


def _read_presented_token(request: RequestContext) -> str:
    scheme, _, credentials = request.headers.get("authorization", "").partition(" ")
    # The cookie opens the page alone: a form of another site could send it to a route that changes something.
    if not scheme and is_page_request(request.method, request.path):
        return read_cookie_token(request.headers)
    if not scheme and is_websocket_request(request.headers):
        return read_subprotocol_token(request.headers)
    return credentials.strip() if scheme.lower() == "bearer" else ""
