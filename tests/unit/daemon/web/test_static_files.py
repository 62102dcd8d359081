"""Who may have the page, and by what."""

import asyncio

import pytest

from optodrive.daemon.web.access_policy import Door, Guard
from optodrive.daemon.web.static_files import HEADERS, cookie_token, is_page
from optodrive.daemon.web.tokens import Token, Tokens
from optodrive.device.config import DaemonSection

TOKEN = "the-token"
DOOR = Door(Tokens((Token("test", "viewer", TOKEN),)), DaemonSection())


async def inner(scope, receive, send):
    await send({"type": "http.response.start", "status": 200, "headers": []})
    await send({"type": "http.response.body", "body": b"inside"})


def ask(path, method="GET", **headers):
    """Status, headers and body of what the guard lets through or answers itself."""
    sent = []

    async def send(message):
        sent.append(message)

    async def receive():
        return {"type": "http.request", "body": b""}

    given = {"host": "127.0.0.1:8450", **headers}
    scope = {
        "type": "http",
        "method": method,
        "path": path,
        "headers": [(name.encode(), value.encode()) for name, value in given.items()],
    }
    asyncio.run(Guard(inner, DOOR)(scope, receive, send))
    heads = {name.decode(): value.decode() for name, value in sent[0]["headers"]}
    return sent[0]["status"], heads, sent[1]["body"]


def test_without_a_token_the_page_asks_for_it_and_the_api_answers_a_problem():
    status, heads, body = ask("/")
    assert (status, heads["content-type"]) == (401, "text/html")
    assert heads["content-security-policy"] == HEADERS["Content-Security-Policy"]
    assert b"<form" in body
    assert ask("/page/main.js")[0] == 401
    status, heads, _ = ask("/v1/state")
    assert (status, heads["content-type"]) == (401, "application/problem+json")


def test_the_cookie_opens_the_page_for_get_alone():
    cookie = f"optodrive-8450={TOKEN}"
    assert ask("/", cookie=cookie)[0] == 200
    assert ask("/page/vendor/uplot/uPlot.esm.js", cookie=cookie)[0] == 200
    for path, method in [("/v1/state", "GET"), ("/v1/telemetry", "GET"), ("/v1/stop", "POST"), ("/", "POST")]:
        assert ask(path, method, cookie=cookie)[0] == 401
    assert ask("/pages", cookie=cookie)[0] == 401


@pytest.mark.parametrize("cookie", ["optodrive-8450=wrong", "optodrive-8451=the-token", "optodrive-8450=", "=;=;", ""])
def test_any_other_cookie_opens_nothing(cookie):
    assert ask("/", cookie=cookie)[0] == 401


def test_a_wrong_bearer_is_not_made_good_by_a_cookie():
    assert ask("/", cookie=f"optodrive-8450={TOKEN}", authorization="Bearer wrong")[0] == 401
    assert ask("/", authorization=f"Bearer {TOKEN}")[0] == 200


def test_a_foreign_host_or_origin_is_refused_with_the_cookie_too():
    cookie = f"optodrive-8450={TOKEN}"
    assert ask("/", cookie=cookie, host="elsewhere.example:8450")[0] == 421
    assert ask("/", cookie=cookie, origin="http://elsewhere.example")[0] == 403


def test_what_asks_for_the_token_is_open_and_holds_none():
    for path in ("/page/login.js", "/page/login.css", "/page/colours.css"):
        assert ask(path)[0] == 200


def test_a_policy_that_lets_no_inline_script_run():
    policy = HEADERS["Content-Security-Policy"]
    assert "default-src 'self'" in policy
    assert "unsafe" not in policy
    assert not is_page("POST", "/")


def test_cookies_are_told_apart_by_port():
    both = {"cookie": "optodrive-1=a; optodrive-2=b", "host": "localhost:2"}
    assert cookie_token(both) == "b"
    assert cookie_token({"host": "localhost"}) == ""
