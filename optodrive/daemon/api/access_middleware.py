"""ASGI middleware that applies the access policy to every request and writes the audit log.

It runs in front of the application, so that no new route can omit the checks.
"""

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext

from starlette.requests import ClientDisconnect

from optodrive.daemon.api.access_policy import AccessPolicy, RequestContext, RequestInProgress, build_revoked_problem
from optodrive.daemon.api.error_handlers import send_login_page, send_problem
from optodrive.daemon.api.request_limits import (
    CALLER,
    App,
    BoundedBody,
    RateLimitedFrames,
    Receive,
    Scope,
    Send,
    join_headers,
    receive_empty_body,
)
from optodrive.daemon.api.route_table import ARMING, STOP, RouteTable
from optodrive.daemon.api.static_files import is_page_request
from optodrive.daemon.responses.problem import Problem, build_problem

AUDIT_FIELDS = "optodrive.audit_fields"
"""Key in the ASGI scope of the dict to which a route adds fields for the audit log."""
STREAMS = ("GET /v1/telemetry", "WEBSOCKET /v1/stream", "WEBSOCKET /v1/hold")
STREAMS_PER_CALLER_MAX, REQUESTS_PER_CALLER_MAX = 16, 64
"""Streams, and requests in progress, of the same token and address: a part of the server's connections."""
Caller = tuple[str, str]


class AccessMiddleware:
    """Refuses the requests that the policy does not accept, and forwards the others with their input bounded."""

    def __init__(self, app: App, policy: AccessPolicy, table: RouteTable) -> None:
        self._app = app
        self._policy = policy
        self._table = table
        self._load = CallerLoad()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send a refusal, or forward the request."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        request = read_request(scope)
        problem = self._policy.check(request, self._table)
        if problem is None and request.route is not None and request.route.key in ARMING:
            problem = await self._record_intent(request)
            # The disk may take seconds, in which a reload may have revoked the token.
            if self._policy.is_revoked(request.token):
                problem = build_revoked_problem(request.token)
        if problem is None:
            with self._load.count(request) as problem:
                if problem is None:
                    await self._forward(request, scope, receive, send)
                    return
        self._policy.refusals.record(
            problem.code, request.audit_fields | request.provenance | {"status": problem.status}
        )
        prefix = "websocket.http" if scope["type"] == "websocket" else "http"
        if problem.status == 401 and is_page_request(request.method, request.path):
            await send_login_page(send, prefix)
        else:
            await send_problem(send, problem, prefix)

    async def _forward(self, request: RequestContext, scope: Scope, receive: Receive, send: Send) -> None:
        in_progress = RequestInProgress(scope["type"], receive, send)
        body = self._bound_receive(request, in_progress.receive)
        audit_fields: dict[str, object] = {}
        scope[AUDIT_FIELDS] = audit_fields
        scope[CALLER] = request.token
        is_stop = request.route is not None and request.route.key == STOP
        try:
            # STOP goes on after its token is revoked: ending it would leave the light on.
            with nullcontext() if is_stop else self._policy.in_progress.track(in_progress, request.token):
                await self._app(scope, body, in_progress.send)
        except ClientDisconnect:  # within its body: there is nobody to answer
            audit_fields["hung_up"] = True
        finally:
            if isinstance(body, BoundedBody | RateLimitedFrames):
                audit_fields |= body.audit_fields
            if in_progress.is_revoked:
                audit_fields["revoked"] = True
            self._record(request, {**audit_fields, "event": "answered", "status": in_progress.status})

    def _bound_receive(self, request: RequestContext, receive: Receive) -> Receive:
        # Its body is not even read: a slow one would delay it.
        if request.route is not None and request.route.key == STOP:
            return receive_empty_body
        if request.method == "WEBSOCKET":
            return RateLimitedFrames(receive, lambda: self._policy.acquire_frame(request))
        return BoundedBody(receive, self._policy.body_max_bytes)

    async def _record_intent(self, request: RequestContext) -> Problem | None:
        """Write an audit entry to disk before arming. Return why arming is refused if that fails."""
        if self._policy.audit is None:
            return None
        error_text = await self._policy.audit.record_durably(request.audit_fields | {"event": "requested"})
        if error_text is None:
            return None
        detail = f"the audit log cannot be written ({error_text}), and arming requires an audit entry"
        return build_problem(409, "audit_unavailable", "Audit log unavailable", detail)

    def _record(self, request: RequestContext, fields: dict[str, object]) -> None:
        if self._policy.audit is not None and request.route is not None and request.route.is_audited:
            self._policy.audit.record(request.audit_fields | fields)


class CallerLoad:
    """Bounds the requests in progress of each caller, and the streams among them, which have no end of their own."""

    def __init__(self) -> None:
        self._requests: Counter[Caller] = Counter()
        self._streams: Counter[Caller] = Counter()

    @contextmanager
    def count(self, request: RequestContext) -> Iterator[Problem | None]:
        """Count a request while it is served. Yield why it is refused. STOP is not counted."""
        # A caller at its limit must still be able to stop.
        if request.route is None or request.route.key == STOP:
            yield None
            return
        caller = request.token.name, request.address
        if request.route.key in STREAMS and self._streams[caller] >= STREAMS_PER_CALLER_MAX:
            detail = f"this caller has {STREAMS_PER_CALLER_MAX} streams open; close one"
            yield build_problem(429, "too_many_streams", "Too many streams", detail, retry_after_s=1.0)
        elif self._requests[caller] >= REQUESTS_PER_CALLER_MAX:
            detail = f"this caller has {REQUESTS_PER_CALLER_MAX} requests in progress; wait for one to end"
            yield build_problem(429, "too_many_requests", "Too many requests", detail, retry_after_s=1.0)
        else:
            counters = [self._requests, self._streams] if request.route.key in STREAMS else [self._requests]
            for counter in counters:
                counter[caller] += 1
            try:
                yield None
            finally:
                for counter in counters:
                    counter[caller] -= 1
                    if not counter[caller]:
                        del counter[caller]


def read_request(scope: Scope) -> RequestContext:
    """Read the request that an ASGI scope describes."""
    headers = join_headers((name.decode("latin-1"), value.decode("latin-1")) for name, value in scope["headers"])
    client = scope.get("client")
    # A caller on the Unix socket has no address.
    address = client[0] if client and client[0] else "unix"
    query = scope.get("query_string", b"").decode("latin-1")
    return RequestContext(scope.get("method", "WEBSOCKET"), scope["path"], headers, address, query=query)
