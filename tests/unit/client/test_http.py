"""The client's exchanges with a daemon, without one: retries, tokens and errors."""

import asyncio
import socket
import ssl
from contextlib import AsyncExitStack
from http.server import BaseHTTPRequestHandler, HTTPServer
from math import inf
from threading import Thread

import httpx
import pytest

from optodrive.client import api_request
from optodrive.client.api_request import ApiRequest
from optodrive.client.async_display import AsyncHttp
from optodrive.client.exchange import (
    STOP_LOST_TIMEOUTS_S,
    Endpoint,
    ExchangePolicy,
    parse_response,
    run_blocking,
)
from optodrive.client.hold import SILENCE_MAX_S
from optodrive.client.http import (
    PROBE_PERIOD_S,
    PROBE_TIMEOUT_S,
    READ_TIMEOUT_S,
    BlockingHttp,
)
from optodrive.client.plan import report_loss
from optodrive.client.problems import build_error, parse_problem
from optodrive.client.requests import READ_STATE, STOP, build_push_request, parse_as
from optodrive.client.sockets import OPEN_TIMEOUT_S, open_connection
from optodrive.core.errors import (
    BoardFaultError,
    InputError,
    LinkError,
    NotReadyError,
    OverBudgetError,
    RefusedError,
)
from optodrive.daemon.api.error_handlers import build_error_problem
from optodrive.daemon.responses.problem import build_problem
from optodrive.daemon.responses.state import HealthReport

HEALTH = ApiRequest("GET", "/v1/health", parse_as(HealthReport), idempotent=True)
PUSH = build_push_request({}, {}, dry_run=False)
HEALTHY = 200, b'{"status": "ok", "version": "1", "added later": {}}'
REFUSED_TOKEN = 401, build_problem(401, "bad_token", "Not authorised", "no").to_json()


@pytest.mark.parametrize(
    "error",
    [
        InputError("frames[0].target_um", 9, "a height", "unknown_pixel"),
        RefusedError("refused: it does not fit"),
        OverBudgetError("too hot", 17, "absorber_temperature", 0.01, 2.5),
        OverBudgetError("always too hot", 17, "touch_temperature", 0.01, inf),
        NotReadyError("the board is DISARMED"),
        BoardFaultError("the board is in FAULT"),
        LinkError("no link to the board"),
    ],
)
def test_an_error_of_the_daemon_arrives_at_the_caller_unchanged(error):
    problem = build_error_problem(error)
    found = parse_problem(problem.status, problem.to_json())
    assert type(found) is type(error)
    assert str(found) == str(error)
    assert found.code == error.code
    assert found.problem == problem.to_dict()
    for name in ("where", "expected", "pixel", "cap", "margin_j", "fits_after_s"):
        assert getattr(found, name, None) == getattr(error, name, None)


def test_a_response_without_a_problem_document_is_a_link_error():
    for body in (b"<html>", b"[1]", b'{"error": 1}'):
        with pytest.raises(LinkError, match="500 without a problem document: a proxy or another program answered"):
            parse_response(HEALTH, httpx.Response(500, content=body))
        for status in (502, 503, 504):
            with pytest.raises(LinkError, match=f"a proxy answered {status}: the daemon behind it is not there"):
                parse_response(HEALTH, httpx.Response(status, content=body))


@pytest.mark.parametrize("body", [b"<html>", b"[]", b"\xff"])
def test_a_response_of_something_else_is_a_link_error(body):
    for request in (READ_STATE, api_request.READ_STATE):
        with pytest.raises(LinkError, match="GET /v1/state is not that of this API: a daemon of another version"):
            parse_response(request, httpx.Response(200, content=body))


def test_an_unknown_code_is_a_refusal_that_keeps_the_code():
    error = build_error(build_problem(429, "too_many_requests", "Too many requests", "too often"))
    assert type(error) is RefusedError
    assert error.code == "too_many_requests"
    assert type(build_error(build_problem(500, "internal", "Internal", "?"))) is RefusedError


@pytest.mark.parametrize("url", ["127.0.0.1:8450", "ftp://127.0.0.1", "http://", "unix:", "unix://host/path", "unix:/"])
def test_an_invalid_address_is_refused(url):
    with pytest.raises(InputError, match=r"^url: got"):
        Endpoint(url, "token")


class Scripted:
    """An HTTP transport that replies from a list: errors, or status and body."""

    def __init__(self, replies):
        self.replies = list(replies)
        self.requests = []

    def __call__(self, request):
        self.requests.append((request.method, request.url.path, request.headers["authorization"]))
        reply = self.replies.pop(0)
        if isinstance(reply, Exception):
            raise reply
        status, body = reply
        return httpx.Response(status, content=body)


@pytest.fixture(params=["blocking", "asynchronous"])
def call(request, monkeypatch):
    """Runs exchanges with scripted replies, in both clients: call(replies, *exchanges) → results, requests."""
    monkeypatch.setattr("optodrive.client.exchange.RETRY_S", 0.0)

    def blocking(replies, *exchanges, reconnect_timeout_s=0.0):
        script = Scripted(replies)
        transport = httpx.MockTransport(script)
        monkeypatch.setattr(
            Endpoint, "open_client", lambda self, timeout_s: httpx.Client(base_url=self.url, transport=transport)
        )
        policy = ExchangePolicy(BlockingHttp(Endpoint("http://localhost", "token")), reconnect_timeout_s)
        return [run_blocking(exchange(policy)) for exchange in exchanges], script.requests

    def asynchronous(replies, *exchanges, reconnect_timeout_s=0.0):
        script = Scripted(replies)
        transport = httpx.MockTransport(script)
        monkeypatch.setattr(
            Endpoint,
            "open_async_client",
            lambda self, timeout_s: httpx.AsyncClient(base_url=self.url, transport=transport),
        )

        async def run():
            policy = ExchangePolicy(AsyncHttp(Endpoint("http://localhost", "token")), reconnect_timeout_s)
            return [await exchange(policy) for exchange in exchanges]

        return asyncio.run(run()), script.requests

    return {"blocking": blocking, "asynchronous": asynchronous}[request.param]


def send(request):
    return lambda policy: policy.call(request)


def stop(policy):
    return policy.stop(STOP)


def test_a_response_is_the_requests_model_and_members_added_later_are_ignored(call):
    (report,), requests = call([HEALTHY], send(HEALTH))
    assert report == HealthReport(version="1")
    assert requests == [("GET", "/v1/health", "Bearer token")]


def test_an_idempotent_request_is_repeated_once_the_daemon_has_responded(call):
    lost = httpx.ReadError("connection reset")
    results, requests = call([HEALTHY, lost, lost, HEALTHY], send(HEALTH), send(HEALTH), reconnect_timeout_s=60.0)
    assert len(results) == 2
    assert len(requests) == 4
    with pytest.raises(LinkError, match="no daemon answers"):
        call([lost], send(HEALTH), reconnect_timeout_s=60.0)


def test_a_request_with_an_effect_is_repeated_only_if_it_was_not_sent(call):
    with pytest.raises(LinkError, match="connection reset"):
        call([HEALTHY, httpx.ReadError("connection reset")], send(HEALTH), send(PUSH), reconnect_timeout_s=60.0)
    refused = 409, build_problem(409, "refused", "Refused", "no").to_json()
    with pytest.raises(RefusedError):
        call([HEALTHY, httpx.ConnectError("down"), refused], send(HEALTH), send(PUSH), reconnect_timeout_s=60.0)


def test_a_refused_token_is_read_again_once(call, monkeypatch):
    tokens = iter(["second", "second"])
    monkeypatch.setattr("optodrive.client.exchange.read_token", lambda port: next(tokens))
    monkeypatch.setattr(Endpoint, "__init__", explicit_first_token(Endpoint.__init__))
    _, requests = call([REFUSED_TOKEN, HEALTHY], send(HEALTH))
    assert [authorization for _, _, authorization in requests] == ["Bearer token", "Bearer second"]


def explicit_first_token(init):
    """An endpoint that got its first token from a file, which is then read again."""

    def patched(self, address, token):
        init(self, address, token)
        self._explicit_token = None

    return patched


def test_a_given_token_that_is_refused_is_an_input_error(call):
    with pytest.raises(InputError, match="token"):
        call([REFUSED_TOKEN], send(READ_STATE))


def test_stop_is_attempted_twice_but_once_at_a_daemon_that_has_just_not_answered(call):
    silence = httpx.ReadTimeout("silence")
    with pytest.raises(LinkError, match="emergency stop"):
        call([silence] * 2, stop)

    async def fail_and_stop(policy):
        try:
            await policy.call(HEALTH)
        except LinkError:
            await policy.stop(STOP)

    with pytest.raises(LinkError, match="emergency stop"):
        call([silence] * 2, fail_and_stop)


def test_a_call_at_a_suspended_daemon_leaves_time_for_its_stop():
    """The silence that a stream, a hold, a request and a new connection wait for, and the stop of the client's exit."""
    longest_s = max(PROBE_PERIOD_S + PROBE_TIMEOUT_S, READ_TIMEOUT_S, OPEN_TIMEOUT_S, SILENCE_MAX_S)
    assert longest_s + sum(STOP_LOST_TIMEOUTS_S) <= 3.5
    waits_s = []

    class Watched(BlockingHttp):
        async def send_alone(self, request, timeout_s):
            waits_s.append(timeout_s)
            raise httpx.ReadTimeout("silence")

    with socket.create_server(("127.0.0.1", 0)) as listener:  # accepts, and nobody answers
        http = Watched(Endpoint(f"http://127.0.0.1:{listener.getsockname()[1]}", "token"))
        with pytest.raises(LinkError):
            asyncio.run(open_connection(http.endpoint, "/v1/hold", AsyncExitStack(), open_timeout_s=0.05))
    with pytest.raises(LinkError, match="emergency stop"):
        run_blocking(ExchangePolicy(http).stop(STOP))
    assert waits_s == [1.0]


@pytest.mark.parametrize(("scheme", "mode"), [("https", ssl.CERT_REQUIRED), ("http", ssl.CERT_NONE)])
def test_certificates_are_verified_where_there_are_some(scheme, mode):
    """Loading the certificates takes tens of milliseconds for each of the clients that stop and probe."""
    endpoint = Endpoint(f"{scheme}://localhost", "token")
    for client in (endpoint.open_client(1.0), endpoint.open_async_client(1.0)):
        assert client._transport._pool._ssl_context.verify_mode == mode


@pytest.mark.parametrize(
    ("is_encrypted", "says"), [(False, "without TLS: state http://"), (True, "does not hold here: name the file")]
)
def test_an_answer_without_valid_tls_is_not_told_as_none(certificate, is_encrypted, says):
    with HTTPServer(("127.0.0.1", 0), BaseHTTPRequestHandler) as server:
        if is_encrypted:
            context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
            context.load_cert_chain(*certificate)
            server.socket = context.wrap_socket(server.socket, server_side=True)
        thread = Thread(target=server.serve_forever)
        thread.start()
        try:
            endpoint = Endpoint(f"https://localhost:{server.server_port}", "token")
            with endpoint.open_client(None) as client, pytest.raises(httpx.TransportError) as failed:
                client.get("/v1/health")
        finally:
            server.shutdown()
            thread.join()
    message = str(endpoint.build_unreachable_error(failed.value))
    assert message.startswith(f"{endpoint.address} answers, but ")
    assert says in message


def test_a_plan_that_the_daemon_has_forgotten_was_lost_with_its_planner():
    with pytest.raises(RefusedError, match="plan p1 failed: the planner process has ended"), report_loss("p1"):
        raise InputError("plan", "p1", "a known plan", "plan_not_found")


def test_stop_is_not_answered_by_a_problem_document(call):
    with pytest.raises(LinkError, match="no link"):
        call([(503, build_problem(503, "link", "Link", "no link").to_json())], stop)


def test_a_request_without_a_model_is_the_same_request():
    assert STOP.parsed_by(api_request.STOP.parse) == api_request.STOP
    assert api_request.READ_STATE.parse(b'{"pixels": 1}') == {"pixels": 1}
