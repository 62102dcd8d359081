"""Bounds of the web server, over real sockets and a minimal application."""

import asyncio
import socket
import threading
import time
from contextlib import suppress

import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from optodrive.core.beat import BeatWriter
from optodrive.daemon.web import bounded_websocket, connections
from optodrive.daemon.web.acceptor import Acceptor
from optodrive.daemon.web.acceptor_client import AcceptorClient
from optodrive.daemon.web.access_policy import AccessPolicy
from optodrive.daemon.web.listeners import open_tcp_listener
from optodrive.daemon.web.server_state import ARRIVED_S, CALLER
from optodrive.daemon.web.tokens import ANONYMOUS, Token, Tokens
from optodrive.daemon.web.web_server import Server
from optodrive.device.config_sections import DaemonSection

GET = b"GET /v1/state HTTP/1.1\r\nHost: localhost\r\n\r\n"
SECRET = "a-valid-secret-of-a-viewer"
BEARER = f"Authorization: Bearer {SECRET}\r\n".encode()
STOP = b"POST /v1/stop HTTP/1.1\r\nHost: localhost\r\n" + BEARER + b"Content-Length: 0\r\n\r\n"
ANN = Token("ann", "armer", "a-secret-of-ann")


class Application:
    """Answers 200; waits on /wait, blocks the loop on /block, reads bodies on /body, echoes WebSocket messages."""

    def __init__(self):
        self.calls = []
        self.ages_s = []
        self.message_ages_s = []
        self.release = asyncio.Event()

    async def __call__(self, scope, receive, send):
        if scope["type"] == "lifespan":
            while (await receive())["type"] != "lifespan.shutdown":
                await send({"type": "lifespan.startup.complete"})
            await send({"type": "lifespan.shutdown.complete"})
        elif scope["type"] == "websocket":
            await self.echo(receive, send)
        else:
            self.ages_s.append(time.monotonic() - scope["state"][ARRIVED_S])
            scope[CALLER] = ANN if scope["path"] == "/trusted" else ANONYMOUS
            await self.answer(scope["path"], receive, send)

    async def echo(self, receive, send):
        await receive()
        await send({"type": "websocket.accept"})
        while (message := await receive())["type"] == "websocket.receive":
            self.message_ages_s.append(time.monotonic() - message[ARRIVED_S])
            if message.get("text") == "block":
                await asyncio.sleep(0.5)
            await send({"type": "websocket.send", "text": str(len(message.get("text") or message["bytes"]))})

    async def answer(self, path, receive, send):
        self.calls.append(path)
        if path == "/block":
            time.sleep(0.5)
        if path == "/wait":
            await self.release.wait()
        if path == "/body":
            while (message := await receive())["type"] == "http.request" and message["more_body"]:
                pass
        await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"2")]})
        await send({"type": "http.response.body", "body": b"ok"})


class Client:
    """One connection to the server."""

    def __init__(self, port):
        self.link = socket.create_connection(("127.0.0.1", port), timeout=20)

    def send(self, data):
        self.link.sendall(data)

    def receive(self):
        """Return what arrives next, b'' if the server has closed the connection."""
        try:
            return self.link.recv(4096)
        except ConnectionResetError:
            return b""

    def receive_answer(self):
        """Return whether the answer of the application arrives."""
        answer = b""
        while not answer.endswith(b"ok"):
            data = self.receive()
            if not data:
                return False
            answer += data
        return answer.startswith(b"HTTP/1.1 200 ")

    def ask(self, data):
        self.send(data)
        return self.receive_answer()

    def is_closed(self):
        self.link.setblocking(False)
        try:
            return self.receive() == b""
        except BlockingIOError:
            return False
        finally:
            self.link.settimeout(20)


@pytest.fixture
def application():
    return Application()


@pytest.fixture
def policy():
    return AccessPolicy(Tokens([Token("viewer", "viewer", SECRET)]), DaemonSection())


@pytest.fixture
def acceptor_port(tmp_path, policy):
    """Keep an acceptor in a thread and return the port that it listens on."""
    supervisor, channel = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    beat = BeatWriter(channel.detach())
    with supervisor, open_tcp_listener("127.0.0.1", 0) as listener:
        acceptor = Acceptor([listener], policy, DaemonSection(), tmp_path / "acceptor", tmp_path / "link", beat)
        thread = threading.Thread(target=acceptor.run)
        thread.start()
        yield listener.getsockname()[1]
        acceptor.end()
        thread.join(20)
        acceptor.close()
        beat.close()
    assert not thread.is_alive()


@pytest.fixture
def port(application, acceptor_port, tmp_path, policy):
    server = Server(application, AcceptorClient(tmp_path / "acceptor"), policy)
    ready = threading.Event()
    server.on_ready = ready.set
    thread = threading.Thread(target=server.run)
    thread.start()
    assert ready.wait(20)
    yield acceptor_port
    server.loop.call_soon_threadsafe(application.release.set)
    server.should_exit = True
    thread.join(20)
    assert not thread.is_alive()


@pytest.fixture
def open_client(port):
    clients = []

    def open_client():
        clients.append(Client(port))
        return clients[-1]

    yield open_client
    for client in clients:
        client.link.close()


HALVES = {
    "headers": (b"", b"GET /v1/state HTTP/1.1\r\nHost: lo"),
    "idle": (GET,),
    "body": (b"POST /body HTTP/1.1\r\nHost: localhost\r\nContent-Length: 100\r\n\r\nabc",),
    "drain": (b"POST /v1/state HTTP/1.1\r\nHost: localhost\r\nContent-Length: 100\r\n\r\nabc",),
}


@pytest.mark.parametrize("phase", HALVES)
def test_a_connection_that_stays_in_a_phase_is_closed(open_client, monkeypatch, phase):
    monkeypatch.setitem(connections.PHASE_MAX_S, phase, 0.3)
    for text in HALVES[phase]:
        client = open_client()
        client.send(text)
        begin_s = time.monotonic()
        if phase in ("idle", "drain"):
            assert client.receive_answer()
        assert client.receive() == b""
        assert time.monotonic() - begin_s > 0.2


def test_bytes_that_trickle_in_do_not_prolong_a_phase(open_client, monkeypatch):
    monkeypatch.setitem(connections.PHASE_MAX_S, "headers", 0.5)
    client = open_client()
    begin_s = time.monotonic()
    with suppress(OSError):
        while not client.is_closed():
            client.send(b"X")
            time.sleep(0.05)
    assert 0.4 < time.monotonic() - begin_s < 5.0


def test_a_client_that_does_not_read_its_answers_is_closed(open_client, monkeypatch):
    monkeypatch.setitem(connections.PHASE_MAX_S, "stalled", 0.3)
    monkeypatch.setattr(Application, "answer", send_without_end)
    client = open_client()
    client.send(GET)
    time.sleep(2.0)
    size = 0
    while data := client.receive():
        size += len(data)
    assert size < 50_000_000


async def send_without_end(self, path, receive, send):
    await send({"type": "http.response.start", "status": 200, "headers": []})
    for _ in range(1_000_000):
        await send({"type": "http.response.body", "body": bytes(65_536), "more_body": True})


def test_a_connection_with_a_valid_token_gives_way_last(open_client, monkeypatch):
    monkeypatch.setattr(connections, "CONNECTIONS_MAX", 10)
    trusted = open_client()
    assert trusted.ask(GET.replace(b"/v1/state", b"/trusted"))
    others = [open_client() for _ in range(9)]
    assert all(other.ask(GET) for other in others)
    newcomers = [open_client() for _ in range(9)]
    assert all(newcomer.ask(GET) for newcomer in newcomers)
    assert all(other.is_closed() for other in others)
    assert trusted.ask(GET)


def test_who_has_no_token_takes_no_place_from_who_has_one(open_client, monkeypatch):
    monkeypatch.setattr(connections, "CONNECTIONS_MAX", 4)
    get_trusted = GET.replace(b"/v1/state", b"/trusted")
    trusted = [open_client() for _ in range(4)]
    assert all(client.ask(get_trusted) for client in trusted)
    newcomers = [open_client() for _ in range(3)]
    for newcomer in newcomers:
        newcomer.send(GET)
    time.sleep(0.3)
    assert not any(client.is_closed() for client in trusted)
    with_token = open_client()
    assert with_token.ask(STOP.replace(b"POST /v1/stop", b"GET /trusted"))
    assert [client.is_closed() for client in trusted] == [True, False, False, False]


def test_the_longest_idle_connection_gives_way_to_a_new_one(open_client, monkeypatch):
    monkeypatch.setattr(connections, "CONNECTIONS_MAX", 10)
    idle = [open_client() for _ in range(10)]
    for client in idle:
        assert client.ask(GET)
    assert idle[0].ask(GET)  # now the second one is idle longest
    others = [open_client() for _ in range(3)]
    assert all(client.ask(GET) for client in others)
    assert [client.is_closed() for client in idle] == [False, True, True, True] + [False] * 6


def test_only_stop_enters_while_every_connection_is_busy(open_client, application, monkeypatch):
    monkeypatch.setattr(connections, "CONNECTIONS_MAX", 5)
    for _ in range(5):
        open_client().send(GET.replace(b"/v1/state", b"/wait"))
    while len(application.calls) < 5:
        time.sleep(0.01)
    refused, stop = open_client(), open_client()
    refused.send(GET)
    assert stop.ask(STOP)
    assert refused.receive() == b""


def test_a_slow_body_gives_way_to_a_new_connection(open_client, monkeypatch):
    monkeypatch.setattr(connections, "CONNECTIONS_MAX", 5)
    monkeypatch.setattr(connections, "SLOW_BODY_S", 0.3)
    slow = [open_client() for _ in range(5)]
    for client in slow:
        client.send(HALVES["body"][0])
    time.sleep(0.5)
    assert open_client().ask(GET)
    assert sum(client.is_closed() for client in slow) == 1


def test_stop_precedes_requests_that_arrived_before_it(open_client, application):
    blocking, stop = open_client(), open_client()
    others = [open_client() for _ in range(60)]
    assert all(client.ask(GET) for client in (stop, *others))
    application.calls.clear()
    blocking.send(GET.replace(b"/v1/state", b"/block"))
    time.sleep(0.1)
    for client in others:
        client.send(GET)
    stop.send(STOP)
    new = open_client()
    new.send(STOP)
    assert all(client.receive_answer() for client in (stop, new, *others))
    # Of the clients that are ready, STOP is served first; the other one waited as a new connection.
    assert application.calls[:2] == ["/block", "/v1/stop"]
    assert "/v1/stop" in application.calls[2:30]


def open_websocket(port, **options):
    return connect(f"ws://127.0.0.1:{port}/v1/stream", proxy=None, ping_interval=None, **options)


def send_and_get_close_code(stream, message):
    """Return the code, None if the close frame was lost because the client was still sending; else the answer."""
    try:
        stream.send(message)
        return stream.recv(20)
    except ConnectionClosed as closed:
        return closed.rcvd and closed.rcvd.code


def test_a_message_has_a_maximum_size_and_no_compression(port):
    with open_websocket(port) as stream:
        assert "sec-websocket-extensions" not in stream.response.headers
        stream.send("x" * bounded_websocket.MESSAGE_MAX_BYTES)
        assert stream.recv(20) == str(bounded_websocket.MESSAGE_MAX_BYTES)
        assert send_and_get_close_code(stream, "x" * (bounded_websocket.MESSAGE_MAX_BYTES + 1)) in (1009, None)


@pytest.mark.parametrize("fragment", ["", "x" * 10_000])
def test_fragments_are_bounded(port, fragment):
    with open_websocket(port) as stream:
        stream.send(["a", "b"])
        assert stream.recv(20) == "2"
        assert send_and_get_close_code(stream, [fragment] * 200) in (1009, None)


HANDSHAKE = (
    b"GET /v1/stream HTTP/1.1\r\nHost: localhost\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
)
PING, PONG = b"\x89\x80\x00\x00\x00\x00", b"\x8a\x00"
MESSAGE, ECHO = b"\x81\x81\x00\x00\x00\x00x", b"\x81\x011"


def test_pings_are_paced_and_delay_no_other_client(open_client):
    stream = open_client()
    stream.send(HANDSHAKE)
    assert stream.receive().startswith(b"HTTP/1.1 101 ")
    begin_s = time.monotonic()
    stream.send(PING * 2500)  # what the sockets hold beyond this would block this thread
    for _ in range(20):
        assert open_client().ask(STOP)
    received = b""
    while time.monotonic() < begin_s + 1.0:
        stream.link.settimeout(0.1)
        with suppress(TimeoutError):
            received += stream.receive()
    elapsed_s = time.monotonic() - begin_s
    slice_frames = bounded_websocket.SLICE_BYTES // len(PING) + 1
    allowed = bounded_websocket.FRAMES_BURST + bounded_websocket.FRAMES_PER_S * elapsed_s + slice_frames
    assert len(PONG) * 100 <= len(received) <= len(PONG) * allowed


def test_messages_wait_for_the_pings_before_them(open_client, monkeypatch):
    monkeypatch.setattr(bounded_websocket, "FRAMES_PER_S", 1000.0)
    stream = open_client()
    stream.send(HANDSHAKE)
    stream.receive()
    stream.send(PING * 500 + MESSAGE + PING * 500 + MESSAGE)
    received = b""
    while received.count(ECHO) < 2:
        received += stream.receive()
    assert received.count(PONG) >= 900


def test_a_request_that_waited_for_its_turn_states_when_it_arrived(open_client, application):
    blocking, others = [open_client() for _ in range(4)], [open_client() for _ in range(30)]
    assert all(client.ask(GET) for client in (*blocking, *others))
    application.ages_s.clear()
    for client in others:
        client.send(GET)
    for client in blocking:  # each holds the loop for half a second, while some of the others wait
        client.send(GET.replace(b"/v1/state", b"/block"))
    assert all(client.receive_answer() for client in (*others, *blocking))
    assert max(application.ages_s) > 0.4
    application.ages_s.clear()
    assert others[0].ask(GET)
    assert application.ages_s[0] < 0.4


def test_a_message_that_waited_in_the_socket_is_not_taken_for_new(port, application):
    with open_websocket(port) as stream:
        stream.send("first")
        stream.recv(20)
        stream.send("block")
        time.sleep(0.1)
        stream.send("waits")  # read half a second later
        assert [stream.recv(20), stream.recv(20)] == ["5", "5"]
        time.sleep(0.3)
        stream.send("new")
        stream.recv(20)
    assert application.message_ages_s[0] < 0.3
    assert application.message_ages_s[2] > 0.35
    assert application.message_ages_s[3] < 0.25
