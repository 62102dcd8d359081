"""Every request to a daemon ends: one that no longer answers is noticed, one that only takes long is not."""

import asyncio
import socket
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from optodrive.client import http
from optodrive.client.api_request import ApiRequest
from optodrive.client.async_display import AsyncHttp
from optodrive.client.exchange import Endpoint, ExchangePolicy
from optodrive.client.http import DaemonClient
from optodrive.client.requests import parse_as
from optodrive.core.errors import LinkError
from optodrive.daemon.responses.state import HealthReport

READ = ApiRequest("GET", "/v1/read", parse_as(HealthReport), idempotent=True)
ACT = ApiRequest("POST", "/v1/act", parse_as(HealthReport))
PROBES = 3
"""Number of probes during an action of the server."""


class Server(BaseHTTPRequestHandler):
    def do_GET(self):
        self.reply()
        self.server.probes.release()

    def do_POST(self):
        for _ in range(PROBES):
            self.server.probes.acquire()
        self.reply()

    def reply(self):
        body = b'{"status": "ok", "version": "1"}'
        self.send_response(200)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *values):
        pass


@pytest.fixture(autouse=True)
def frequent_probes(monkeypatch):
    """Only a probe or a read has a limit that the tests outlast: an action does not end by itself."""
    monkeypatch.setattr(http, "TIMEOUT_S", 3600.0)
    monkeypatch.setattr(http, "PROBE_PERIOD_S", 0.1)


@pytest.fixture(params=["blocking", "asynchronous"])
def call(request):
    """Return a function that sends a request to a URL with one of the clients."""

    def blocking(url, sent):
        return DaemonClient(url, "token").call(sent)

    def asynchronous(url, sent):
        async def run():
            client = AsyncHttp(Endpoint(url, "token"))
            try:
                return await ExchangePolicy(client).call(sent)
            finally:
                await client.close()

        return asyncio.run(run())

    return {"blocking": blocking, "asynchronous": asynchronous}[request.param]


@pytest.mark.parametrize("sent", [READ, ACT], ids=["read", "act"])
def test_a_daemon_that_is_suspended_is_noticed(call, sent, monkeypatch):
    monkeypatch.setattr(http, "READ_TIMEOUT_S", 0.2)
    monkeypatch.setitem(http.PROBE, "timeout", 0.2)
    listener = socket.create_server(("127.0.0.1", 0), backlog=8)  # the kernel accepts, nobody answers
    with listener, pytest.raises(LinkError, match="no daemon answers"):
        call(f"http://127.0.0.1:{listener.getsockname()[1]}", sent)


def test_an_action_may_take_as_long_as_the_daemon_answers_others(call, monkeypatch):
    monkeypatch.setitem(http.PROBE, "timeout", 3600.0)
    with ThreadingHTTPServer(("127.0.0.1", 0), Server) as server:
        server.probes = threading.Semaphore(0)
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        try:
            assert call(f"http://127.0.0.1:{server.server_port}", ACT) == HealthReport(version="1")
        finally:
            server.shutdown()
            thread.join()
