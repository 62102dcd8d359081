"""Ranks of requests by their heads, as they wait in a socket."""

import socket

import pytest

from optodrive.daemon.api.access_policy import AccessPolicy
from optodrive.daemon.api.tokens import Token, Tokens
from optodrive.daemon.server.request_head import HEAD_MAX_BYTES, Rank, is_complete, parse_head, peek_head, rank_request
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


def test_a_head_is_parsed_as_the_server_does():
    request = parse_head(b"GET /v1/plans/p%31?x=1 HTTP/1.1\r\nHost:  a:1 \r\nX-Y: b: c\r\nbroken\r\n\r\nbody: 1")
    assert (request.method, request.path) == ("GET", "/v1/plans/p1")
    assert request.headers == {"host": "a:1", "x-y": "b: c"}


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
