"""Ranks of requests by their heads, as they wait in a socket."""

import socket
import string
from urllib.parse import unquote

import h11
import pytest
from hypothesis import given
from hypothesis import strategies as st

from optodrive.daemon.api.access_policy import AccessPolicy
from optodrive.daemon.api.request_limits import join_headers, normalise_path
from optodrive.daemon.api.tokens import Token, Tokens
from optodrive.daemon.server.connections import HEAD_MAX_BYTES, Rank, is_complete, parse_head, peek_head, rank_request
from optodrive.device.config_sections import DaemonSection

SECRET = "a-valid-secret-of-a-viewer"


@pytest.fixture
def policy():
    return AccessPolicy(Tokens([Token("viewer", "viewer", SECRET)]), DaemonSection())


@pytest.mark.parametrize(
    ("line", "headers", "rank"),
    [
        ("POST /v1/stop HTTP/1.1", f"Authorization: Bearer {SECRET}", Rank.STOP),
        ("POST /v1/stop?now HTTP/1.1", f"authorization:bearer   {SECRET} ", Rank.STOP),
        ("POST /v1/%73top HTTP/1.1", f"Authorization: Bearer {SECRET}", Rank.STOP),
        ("POST /v1/stop/ HTTP/1.1", f"Authorization: Bearer {SECRET}", Rank.STOP),
        ("POST http://localhost:80/v1/stop HTTP/1.1", f"Authorization: Bearer {SECRET}", Rank.STOP),
        ("POST HTTPS://lab/v1/stop/?x HTTP/1.1", f"Authorization: Bearer {SECRET}", Rank.STOP),
        ("POST /v1/stop// HTTP/1.1", f"Authorization: Bearer {SECRET}", Rank.TOKEN),
        ("POST /http://lab/v1/stop HTTP/1.1", f"Authorization: Bearer {SECRET}", Rank.TOKEN),
        ("POST /v1/stop HTTP/1.1", f"Authorization: Bearer {SECRET}\r\nAuthorization: Bearer {SECRET}", Rank.OTHER),
        ("POST /v1/stop HTTP/1.1", "Authorization: Bearer guessed-by-nobody", Rank.OTHER),
        ("POST /v1/stop HTTP/1.1", "Accept: */*", Rank.OTHER),
        ("GET /v1/stop HTTP/1.1", f"Authorization: Bearer {SECRET}", Rank.TOKEN),
        ("POST /v1/arm HTTP/1.1", f"Authorization: Bearer {SECRET}", Rank.TOKEN),
        ("GET / HTTP/1.1", f"Cookie: optodrive-80={SECRET}", Rank.TOKEN),
        ("POST /v1/arm HTTP/1.1", f"Cookie: optodrive-80={SECRET}", Rank.OTHER),
        ("GET /v1/health HTTP/1.1", "Accept: */*", Rank.OTHER),
        ("no request", f"Authorization: Bearer {SECRET}", Rank.OTHER),
    ],
)
def test_a_valid_token_precedes_and_stop_with_one_comes_first(policy, line, headers, rank):
    head = f"{line}\r\nHost: localhost:80\r\n{headers}\r\n\r\n"
    assert rank_request(parse_head(head.encode()), policy) is rank


@pytest.mark.parametrize(
    "headers",
    [
        "",
        "Host: evil.example\r\n",
        "Host: localhost\r\nOrigin: https://evil.example\r\n",
        "Host: localhost\r\n" + 2 * "Origin: http://localhost\r\n",
    ],
)
def test_a_stop_that_the_policy_refuses_has_no_precedence(policy, headers):
    head = f"POST /v1/stop HTTP/1.1\r\n{headers}Authorization: Bearer {SECRET}\r\n\r\n"
    assert rank_request(parse_head(head.encode()), policy) is Rank.TOKEN


def test_a_token_in_the_body_gives_no_rank(policy):
    head = f"POST /v1/stop HTTP/1.1\r\nHost: localhost\r\n\r\nAuthorization: Bearer {SECRET}\r\n\r\n"
    assert rank_request(parse_head(head.encode()), policy) is Rank.OTHER


TOKEN = st.text(string.ascii_letters + string.digits + "!#$%&'*+-.^_`|~", min_size=1)
VALUE = st.text(string.printable[:95], max_size=40)
TARGET = st.text(string.ascii_letters + string.digits + "/?%:@.-_~", max_size=40).map("/".__add__)


@given(TOKEN, TARGET, st.lists(st.tuples(TOKEN.map("X-".__add__), VALUE)), st.binary(max_size=20))
def test_a_head_is_parsed_as_the_server_does(method, target, headers, body):
    lines = [f"{method} {target} HTTP/1.1", "Host:  a:1 ", *(f"{name}: {value}" for name, value in headers), "", ""]
    head = "\r\n".join(lines).encode()
    request = parse_head(head + body)
    server = h11.Connection(h11.SERVER)
    server.receive_data(head)
    event = server.next_event()
    assert request.method == event.method.decode()
    assert request.path == normalise_path(unquote(event.target.decode().partition("?")[0]))
    assert request.headers == join_headers((name.decode(), value.decode()) for name, value in event.headers)


def test_a_line_without_a_colon_and_the_body_are_no_headers():
    assert parse_head(b"GET / HTTP/1.1\r\nHost: a\r\nbroken\r\n\r\nbody: 1").headers == {"host": "a"}


@pytest.mark.parametrize(
    ("head", "expected"),
    [
        (b"GET / HTTP/1.1\r\nHost: a\r\n", False),
        (b"GET / HTTP/1.1\r\nHost: a\r\n\r\n", True),
        (b"G" * HEAD_MAX_BYTES, True),
        (b"\x16\x03\x01", True),
    ],
)
def test_a_head_is_complete_at_its_end_or_when_it_can_have_none(head, expected):
    assert is_complete(head) is expected


def test_peeking_takes_nothing_and_tells_silence_from_the_end():
    own, peer = socket.socketpair()
    with own, peer:
        own.setblocking(False)
        assert peek_head(own) is None
        peer.sendall(b"GET")
        assert peek_head(own) == peek_head(own) == own.recv(10) == b"GET"
        peer.close()
        assert peek_head(own) == b""
