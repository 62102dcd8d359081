"""Callers who may have the page, and the credentials that open it."""

import asyncio
from functools import partial

import pytest

from optodrive.daemon.api.access_middleware import AccessMiddleware
from optodrive.daemon.api.access_policy import AccessPolicy
from optodrive.daemon.api.route_table import RouteTable
from optodrive.daemon.api.static_files import SECURITY_HEADERS, is_page_request, read_cookie_token
from optodrive.daemon.api.tokens import Token, Tokens
from optodrive.device.config_sections import DaemonSection

TOKEN = "the-token"
POLICY = AccessPolicy(Tokens((Token("test", "viewer", TOKEN),)), DaemonSection())


async def serve_inner(scope, receive, send):
    await send({"type": "http.response.start", "status": 200, "headers": []})
    await send({"type": "http.response.body", "body": b"inside"})


def request(app, path, method="GET", **headers):
    """Status, headers and body of the response that the guard lets through or gives itself."""
    sent = []

    async def send(message):
        sent.append(message)

    async def receive():
        return {"type": "http.request", "body": b""}

    request_headers = {"host": "127.0.0.1:8450", **headers}
    scope = {
        "type": "http",
        "method": method,
        "path": path,
        "headers": [(name.encode(), value.encode()) for name, value in request_headers.items()],
    }
    asyncio.run(AccessMiddleware(serve_inner, POLICY, RouteTable(app.routes))(scope, receive, send))
    response_headers = {name.decode(): value.decode() for name, value in sent[0]["headers"]}
    return sent[0]["status"], response_headers, sent[1]["body"]


@pytest.fixture
def send_request(app):
    return partial(request, app)


def test_without_a_token_the_page_asks_for_it_and_the_api_answers_a_problem(send_request):
    status, response_headers, body = send_request("/")
    assert (status, response_headers["content-type"]) == (401, "text/html")
    assert response_headers["content-security-policy"] == SECURITY_HEADERS["Content-Security-Policy"]
    assert b"<form" in body
    assert send_request("/page/main.js")[0] == 401
    status, response_headers, _ = send_request("/v1/state")
    assert (status, response_headers["content-type"]) == (401, "application/problem+json")


def test_the_cookie_opens_the_page_for_get_alone(send_request):
    cookie = f"optodrive-8450={TOKEN}"
    assert send_request("/", cookie=cookie)[0] == 200
    assert send_request("/page/vendor/uplot/uPlot.esm.js", cookie=cookie)[0] == 200
    for path, method in [("/v1/state", "GET"), ("/v1/telemetry", "GET"), ("/v1/stop", "POST"), ("/", "POST")]:
        assert send_request(path, method, cookie=cookie)[0] == 401
    assert send_request("/pages", cookie=cookie)[0] == 401
    assert send_request("/", cookie=f"other=1; {cookie}; optodrive-8450=of-the-shorter-path")[0] == 200
    assert send_request("/", cookie=f"optodrive-8450=of-the-longer-path; {cookie}")[0] == 401


@pytest.mark.parametrize("cookie", ["optodrive-8450=wrong", "optodrive-8451=the-token", "optodrive-8450=", "=;=;", ""])
def test_any_other_cookie_opens_nothing(send_request, cookie):
    assert send_request("/", cookie=cookie)[0] == 401


def test_a_wrong_bearer_is_not_made_good_by_a_cookie(send_request):
    assert send_request("/", cookie=f"optodrive-8450={TOKEN}", authorization="Bearer wrong")[0] == 401
    assert send_request("/", authorization=f"Bearer {TOKEN}")[0] == 200


def test_what_asks_for_the_token_is_open_and_holds_none(send_request):
    for path in ("/page/login.js", "/page/login.css", "/page/colours.css"):
        assert send_request(path)[0] == 200


def test_a_policy_that_lets_no_inline_script_run():
    policy = SECURITY_HEADERS["Content-Security-Policy"]
    assert "default-src 'self'" in policy
    assert "unsafe" not in policy
    assert not is_page_request("POST", "/")


def test_cookies_are_told_apart_by_port():
    both = {"cookie": "optodrive-1=a; optodrive-2=b", "host": "localhost:2"}
    assert read_cookie_token(both) == "b"
    assert read_cookie_token({"host": "localhost"}) == ""
