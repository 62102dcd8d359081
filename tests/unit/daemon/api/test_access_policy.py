"""Which Host and Origin are accepted, and the audit entry of every refusal."""

import asyncio
import json
import logging
import re
from contextlib import ExitStack

import pytest
from starlette.requests import ClientDisconnect

from optodrive.daemon.api.access_middleware import (
    REQUESTS_PER_CALLER_MAX,
    STREAMS,
    STREAMS_PER_CALLER_MAX,
    AccessMiddleware,
    CallerLoad,
)
from optodrive.daemon.api.access_policy import AccessPolicy, RequestContext
from optodrive.daemon.api.audit import AuditLog
from optodrive.daemon.api.route_table import Route, RouteTable
from optodrive.daemon.api.tokens import Token, Tokens
from optodrive.device.config_sections import DaemonSection

TOKENS = Tokens((Token("eve", "viewer", "eve"), Token("bob", "operator", "bob")))


@pytest.fixture
def check(app):
    """Function that returns the code of a refusal, or None."""
    policy = AccessPolicy(TOKENS, DaemonSection(hosts=("Display.example",)))
    table = RouteTable(app.routes)

    def check(**headers):
        problem = policy.check(RequestContext("GET", "/v1/health", headers, "127.0.0.1"), table)
        return problem and problem.code

    return check


@pytest.mark.parametrize(
    "host",
    ["127.0.0.1", "127.0.0.1:8450", "LOCALHOST:1", "[::1]", "[::1]:8450", "localhost:", "display.example:443"],
)
def test_a_host_of_this_daemon_is_accepted(check, host):
    assert check(host=host) is None


@pytest.mark.parametrize(
    "host",
    [
        "",
        "[::1].evil",
        "[::1]evil:8450",
        "[::1]:8450:1",
        "[::1",
        "localhost:evil",
        "localhost:80@evil",
        "localhost.evil",
        "evil@localhost",
        "localhost/evil",
        "127.0.0.1:8450:9",
        "::1",
    ],
)
def test_any_other_host_is_refused(check, host):
    assert check(host=host) == "host_not_allowed"


@pytest.mark.parametrize(
    ("host", "origin"),
    [
        ("localhost:8450", "http://localhost:8450"),
        ("[::1]:8450", "http://[::1]:8450"),
        ("localhost", "http://localhost:80"),
        ("display.example", "https://display.example"),
        ("display.example:8443", "https://display.example:8443"),
        ("display.example:8450", "http://display.example:8450"),
    ],
)
def test_the_page_of_this_daemon_is_accepted(check, host, origin):
    assert check(host=host, origin=origin) is None


@pytest.mark.parametrize(
    ("host", "origin"),
    [
        ("localhost:8450", "http://localhost:3000"),
        ("localhost:8450", "http://localhost"),
        ("localhost:8450", "https://localhost:8450"),
        ("localhost:8450", "http://127.0.0.1:8450"),
        ("localhost:8450", "ftp://localhost:8450"),
        ("localhost:8450", "localhost:8450"),
        ("localhost:8450", "null"),
        ("localhost:8450", ""),
        ("localhost:8450", "http://localhost:8450.evil"),
        ("[::1]:8450", "http://[::1].evil:8450"),
        ("display.example", "https://display.example:8443"),
        ("display.example", "http://display.example:443"),
    ],
)
def test_a_page_from_elsewhere_is_refused(check, host, origin):
    assert check(host=host, origin=origin) == "origin_not_allowed"


@pytest.mark.parametrize(
    ("path", "token", "status", "title", "says"),
    [
        (
            "/v1/state",
            None,
            401,
            "Not authorised",
            "a token is required, in the header `Authorization: Bearer TOKEN`; the",
        ),
        ("/v1/state", "guessed", 401, "Not authorised", "the token of this request is not one of the daemon's; the"),
        ("/v1/plan", "eve", 404, "Not Found", "GET /v1/plan: no such route, nearest is '/v1/plans"),
        ("/openapi", "eve", 404, "Not Found", "GET /openapi: no such route, nearest is '/openapi.json'"),
        ("/x9z", "eve", 404, "Not Found", "GET /x9z: no such route, /openapi.json lists all"),
    ],
)
def test_a_refusal_tells_a_missing_token_from_another_and_the_nearest_route(app, path, token, status, title, says):
    policy, headers = AccessPolicy(TOKENS, DaemonSection()), {"host": "localhost"}
    if token is not None:
        headers["authorization"] = f"Bearer {token}"
    problem = policy.check(RequestContext("GET", path, headers, "127.0.0.1"), RouteTable(app.routes))
    assert (problem.status, problem.title) == (status, title)
    assert problem.detail.startswith(says)


@pytest.fixture
def audited(app, tmp_path):
    """Function that sends one request through the middleware. It returns the audit's entries after all requests."""
    audit = AuditLog(tmp_path / "audit.jsonl", print)
    policy = AccessPolicy(TOKENS, DaemonSection(requests_per_s=1, requests_burst=1), audit)

    async def serve_body(scope, receive, send):
        if (await receive())["type"] == "http.disconnect":
            raise ClientDisconnect
        await send({"type": "http.response.start", "status": 200, "headers": []})
        await send({"type": "http.response.body", "body": b""})

    def request(method, path, token=None, first_message="http.request", **headers):
        if token is not None:
            headers["authorization"] = f"Bearer {token}"
        raw = [(name.encode(), value.encode()) for name, value in {"host": "localhost", **headers}.items()]
        scope = {"type": "http", "method": method, "path": path, "headers": raw, "client": ("10.0.0.9", 1)}
        sent = []

        async def receive():
            return {"type": first_message}

        async def send(message):
            sent.append(message)

        asyncio.run(AccessMiddleware(serve_body, policy, RouteTable(app.routes))(scope, receive, send))
        return sent[0]["status"] if sent else None

    def read():
        audit.close()
        return [json.loads(line) for line in (tmp_path / "audit.jsonl").read_text().splitlines()]

    request.read = read
    yield request
    audit.close()


@pytest.mark.parametrize(
    ("code", "status", "method", "path", "token", "headers"),
    [
        ("bad_token", 401, "POST", "/v1/arm", "guessed-secret", {}),
        ("bad_token", 401, "GET", "/v1/state", None, {}),
        ("host_not_allowed", 421, "POST", "/v1/arm", "eve", {"host": "evil.example"}),
        ("origin_not_allowed", 403, "POST", "/v1/stop", "eve", {"origin": "http://evil.example"}),
        ("insufficient_role", 403, "POST", "/v1/arm", "bob", {}),
        ("route_not_found", 404, "GET", "/v1/secret", "eve", {}),
        ("method_not_allowed", 405, "PUT", "/v1/arm", "eve", {}),
        ("body_too_large", 413, "POST", "/v1/plans", "bob", {"content-length": "99999999"}),
    ],
)
def test_every_refusal_leaves_an_audit_entry(audited, code, status, method, path, token, headers):
    assert audited(method, path, token, **headers) == status
    (entry,) = audited.read()
    assert (entry["event"], entry["code"], entry["status"], entry["call"]) == (
        "refused",
        code,
        status,
        f"{method} {path}",
    )
    assert entry["address"] == "10.0.0.9"
    known = status not in (401, 421) and code != "origin_not_allowed"
    assert entry["name"] == (token if known else "")
    assert "guessed-secret" not in repr(entry)


def test_a_refused_rate_leaves_an_audit_entry(audited):
    assert [audited("GET", "/v1/state", "eve") for _ in range(2)] == [200, 429]
    assert [entry["code"] for entry in audited.read()] == ["too_many_requests"]


def test_a_client_that_hangs_up_during_its_body_is_no_error(audited, caplog):
    with caplog.at_level(logging.DEBUG, "uvicorn.error"):
        assert audited("POST", "/v1/plans", "bob", first_message="http.disconnect") is None
    (entry,) = audited.read()
    assert (entry["event"], entry["hung_up"], entry["status"]) == ("answered", True, None)


def build_request(token, key, address="127.0.0.1"):
    method, _, path = key.partition(" ")
    return RequestContext(method, path, {}, address, token, Route(key, "viewer", method, re.compile(path), (), False))


def test_the_streams_of_one_caller_are_bounded():
    load = CallerLoad()
    ask = build_request
    eve, bob = TOKENS.all
    with ExitStack() as stack:
        for _ in range(STREAMS_PER_CALLER_MAX):
            assert stack.enter_context(load.count(ask(eve, "GET /v1/telemetry"))) is None
        for key in STREAMS:
            assert stack.enter_context(load.count(ask(eve, key))).code == "too_many_streams"
        for request in (
            ask(bob, "GET /v1/telemetry"),
            ask(eve, "GET /v1/telemetry", "10.0.0.1"),
            ask(eve, "GET /v1/state"),
        ):
            assert stack.enter_context(load.count(request)) is None
    with load.count(ask(eve, "WEBSOCKET /v1/stream")) as problem:
        assert problem is None


def test_the_requests_in_progress_of_one_caller_are_bounded_but_for_stop():
    load = CallerLoad()
    eve, bob = TOKENS.all
    with ExitStack() as stack:
        for _ in range(REQUESTS_PER_CALLER_MAX):
            assert stack.enter_context(load.count(build_request(eve, "POST /v1/plans"))) is None
        assert stack.enter_context(load.count(build_request(eve, "GET /v1/state"))).code == "too_many_requests"
        assert stack.enter_context(load.count(build_request(eve, "POST /v1/stop"))) is None
        assert stack.enter_context(load.count(build_request(bob, "POST /v1/arm"))) is None
    with load.count(build_request(eve, "POST /v1/plans")) as problem:
        assert problem is None
