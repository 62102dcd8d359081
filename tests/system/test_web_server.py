"""Bounds of the web server, over real sockets and a minimal application."""

import asyncio
import socket
import threading
import time
from collections import Counter
from contextlib import suppress

import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from optodrive.core.child_process import BeatWriter
from optodrive.daemon.api.access_policy import AccessPolicy
from optodrive.daemon.api.request_limits import ARRIVED_S, CALLER, EARLIEST_S
from optodrive.daemon.api.tokens import ANONYMOUS, Token, Tokens
from optodrive.daemon.server import bounded_protocols, connections
from optodrive.daemon.server.acceptor import Acceptor
from optodrive.daemon.server.acceptor_client import AcceptorClient
from optodrive.daemon.server.connections import peek_head
from optodrive.daemon.server.listeners import open_tcp_listener
from optodrive.daemon.server.web_server import Server
from optodrive.device.config_sections import DaemonSection
from rig import wait_for

GET = b"GET /v1/state HTTP/1.1\r\nHost: localhost\r\n\r\n"
SECRET = "a-valid-secret-of-a-viewer"
BEARER = f"Authorization: Bearer {SECRET}\r\n".encode()
STOP = b"POST /v1/stop HTTP/1.1\r\nHost: localhost\r\n" + BEARER + b"Content-Length: 0\r\n\r\n"
ANN = Token("ann", "armer", "a-secret-of-ann")
LONG_S = 1e6
"""A time that passes only on the clock of a test."""


class Application:
    """Answers 200, waits on /wait, blocks the loop on /block, reads bodies on /body, echoes WebSocket messages.

    arrivals: paths of the requests with the times at which they arrived
    message_arrivals: earliest and actual times of the messages
    blocked, go_on: begin, and end, of a request for /block; release: of those for /wait, and of the message "wait"
    """

    def __init__(self):
        self.calls = []
        self.arrivals = []
        self.message_arrivals = []
        self.blocked, self.go_on = threading.Semaphore(0), threading.Semaphore(0)
        self.release = asyncio.Event()

    async def __call__(self, scope, receive, send):
        if scope["type"] == "lifespan":
            while (await receive())["type"] != "lifespan.shutdown":
                await send({"type": "lifespan.startup.complete"})
            await send({"type": "lifespan.shutdown.complete"})
        elif scope["type"] == "websocket":
            await (self.refuse if scope["path"] == "/refused" else self.echo)(receive, send)
        else:
            self.arrivals.append((scope["path"], scope["state"][ARRIVED_S]))
            scope[CALLER] = ANN if scope["path"] == "/trusted" else ANONYMOUS
            await self.answer(scope["path"], receive, send)

    async def refuse(self, receive, send):
        await receive()
        await send({"type": "websocket.http.response.start", "status": 403, "headers": []})
        for piece, more in ((b"no, ", True), (b"not you", False)):
            await send({"type": "websocket.http.response.body", "body": piece, "more_body": more})

    async def echo(self, receive, send):
        await receive()
        await send({"type": "websocket.accept"})
        while (message := await receive())["type"] == "websocket.receive":
            self.message_arrivals.append((message[EARLIEST_S], message[ARRIVED_S]))
            if message.get("text") == "wait":
                await self.release.wait()
            await send({"type": "websocket.send", "text": str(len(message.get("text") or message["bytes"]))})

    async def answer(self, path, receive, send):
        self.calls.append(path)
        if path == "/block":
            self.blocked.release()
            self.go_on.acquire()
        if path == "/wait":
            await self.release.wait()
        if path == "/body":
            while (message := await receive())["type"] == "http.request" and message["more_body"]:
                pass
        await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"2")]})
        await send({"type": "http.response.body", "body": b"ok"})


class Clock:
    """The clock by which acceptor and server close slow connections: the computer's, and the time that a test adds."""

    def __init__(self):
        self._added_s = 0.0
        self._checks = Counter()

    def now_s(self):
        return time.monotonic() + self._added_s

    def drive(self, connections):
        """Let connections be judged by this clock, and count how often they are."""
        close_expired = connections.close_expired

        def close_expired_and_count():
            close_expired()
            self._checks[connections] += 1

        connections._now_s, connections.close_expired = self.now_s, close_expired_and_count
        self._checks[connections] = 0

    def sleep(self, duration_s):
        """Let a time pass, and all connections be judged after it."""
        self._added_s += duration_s
        begin = self._checks.copy()
        wait_for(lambda: all(self._checks[each] >= begin[each] + 2 for each in begin), "the connections to be judged")


class Client:
    """One connection to the server."""

    def __init__(self, port):
        self.link = socket.create_connection(("127.0.0.1", port))

    def send(self, data):
        self.link.sendall(data)

    def receive(self):
        """Return the next bytes that arrive, b'' if the server has closed the connection."""
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
            self.link.setblocking(True)


@pytest.fixture
def application():
    return Application()


@pytest.fixture
def policy():
    return AccessPolicy(Tokens([Token("viewer", "viewer", SECRET)]), DaemonSection())


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def acceptor(tmp_path, policy, clock):
    """Keep an acceptor in a thread."""
    supervisor, channel = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    beat = BeatWriter(channel.detach())
    with supervisor, open_tcp_listener("127.0.0.1", 0) as listener:
        acceptor = Acceptor([listener], policy, DaemonSection(), tmp_path / "acceptor", tmp_path / "link", beat)
        acceptor.port = listener.getsockname()[1]
        clock.drive(acceptor._queue)
        thread = threading.Thread(target=acceptor.run)
        thread.start()
        yield acceptor
        acceptor.end()
        thread.join()
        acceptor.close()
        beat.close()


@pytest.fixture
def server(application, acceptor, tmp_path, policy, clock):
    """Keep a server in a thread."""
    server = Server(application, AcceptorClient(tmp_path / "acceptor"), policy)
    server.config.timeout_keep_alive = LONG_S
    clock.drive(server._connections)
    ready = threading.Event()
    server.on_ready = ready.set
    thread = threading.Thread(target=server.run)
    thread.start()
    ready.wait()
    yield server
    server.loop.call_soon_threadsafe(application.release.set)
    server.should_exit = True
    thread.join()


@pytest.fixture
def port(acceptor, server):
    return acceptor.port


def await_phases(server, phase, count=1):
    """Wait until the server has noticed that a number of connections are in a phase."""
    entries = server._connections._entries
    wait_for(lambda: [entry.phase.phase for entry in list(entries.values())].count(phase) == count, f"phase {phase}")


def await_held(server):
    """Wait until the server has received a connection for which there is no room."""
    wait_for(lambda: server._opener._held, "a connection that waits for room")


def await_unread(server, count):
    """Wait until requests wait in the sockets of a number of clients."""
    wait_for(lambda: sum(map(bool, map(peek_head, server._selector._clients.values()))) == count, "unread requests")


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
def test_a_connection_that_stays_in_a_phase_is_closed(open_client, acceptor, server, clock, monkeypatch, phase):
    monkeypatch.setitem(connections.PHASE_MAX_S, phase, LONG_S)
    for text in HALVES[phase]:
        client = open_client()
        client.send(text)
        if phase in ("idle", "drain"):
            assert client.receive_answer()
        if phase == "headers":  # it waits in front of the server
            wait_for(lambda: len(acceptor._queue) == 1, "the connection")
        else:
            await_phases(server, phase)
        clock.sleep(0.9 * LONG_S)
        assert not client.is_closed()
        clock.sleep(0.2 * LONG_S)
        assert client.receive() == b""


def test_bytes_that_trickle_in_do_not_prolong_a_phase(open_client, clock, monkeypatch):
    monkeypatch.setitem(connections.PHASE_MAX_S, "headers", LONG_S)
    client = open_client()
    for _ in range(3):
        assert not client.is_closed()
        client.send(b"X")
        assert open_client().ask(GET)  # which arrived after the byte
        clock.sleep(0.4 * LONG_S)
    assert client.receive() == b""


def test_a_client_that_does_not_read_its_answers_is_closed(open_client, server, clock, monkeypatch):
    monkeypatch.setitem(connections.PHASE_MAX_S, "stalled", LONG_S)
    monkeypatch.setattr(Application, "answer", send_without_end)
    client = open_client()
    client.send(GET)
    await_phases(server, "stalled")
    clock.sleep(1.1 * LONG_S)
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


def test_who_has_no_token_takes_no_place_from_who_has_one(open_client, server, monkeypatch):
    monkeypatch.setattr(connections, "CONNECTIONS_MAX", 4)
    get_trusted = GET.replace(b"/v1/state", b"/trusted")
    trusted = [open_client() for _ in range(4)]
    assert all(client.ask(get_trusted) for client in trusted)
    newcomers = [open_client() for _ in range(3)]
    for newcomer in newcomers:
        newcomer.send(GET)
    await_held(server)
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


def test_a_slow_body_gives_way_to_a_new_connection(open_client, server, clock, monkeypatch):
    monkeypatch.setattr(connections, "CONNECTIONS_MAX", 5)
    monkeypatch.setattr(connections, "SLOW_BODY_S", LONG_S)
    monkeypatch.setitem(connections.PHASE_MAX_S, "body", 2 * LONG_S)
    slow = [open_client() for _ in range(5)]
    for client in slow:
        client.send(HALVES["body"][0])
    await_phases(server, "body", 5)
    newcomer = open_client()
    newcomer.send(GET)
    await_held(server)
    clock.sleep(0.9 * LONG_S)
    assert not any(client.is_closed() for client in slow)
    clock.sleep(0.2 * LONG_S)
    assert newcomer.receive_answer()
    assert sum(client.is_closed() for client in slow) == 1


def test_stop_precedes_requests_that_arrived_before_it(open_client, acceptor, server, application):
    blocking, stop = open_client(), open_client()
    others = [open_client() for _ in range(60)]
    assert all(client.ask(GET) for client in (stop, *others))
    blocking.send(GET.replace(b"/v1/state", b"/block"))
    application.blocked.acquire()
    application.calls.clear()
    handed_over = acceptor._handed_over
    for client in others:
        client.send(GET)
    stop.send(STOP)
    new = open_client()
    new.send(STOP)
    await_unread(server, 61)
    wait_for(lambda: acceptor._handed_over > handed_over, "the new connection")
    application.go_on.release()
    assert all(client.receive_answer() for client in (stop, new, *others))
    # Of the clients that are ready, STOP is served first; the other one waited as a new connection.
    assert application.calls[0] == "/v1/stop"
    assert "/v1/stop" in application.calls[1:29]


def open_websocket(port, path="/v1/stream", **options):
    return connect(f"ws://127.0.0.1:{port}{path}", proxy=None, ping_interval=None, **options)


def send_and_get_close_code(stream, message):
    """Return the close code, None if the close frame was lost because the client was still sending, else the answer."""
    try:
        stream.send(message)
        return stream.recv()
    except ConnectionClosed as closed:
        return closed.rcvd and closed.rcvd.code


def test_a_message_has_a_maximum_size_and_no_compression(port):
    with open_websocket(port) as stream:
        assert "sec-websocket-extensions" not in stream.response.headers
        stream.send("x" * bounded_protocols.MESSAGE_MAX_BYTES)
        assert stream.recv() == str(bounded_protocols.MESSAGE_MAX_BYTES)
        assert send_and_get_close_code(stream, "x" * (bounded_protocols.MESSAGE_MAX_BYTES + 1)) in (1009, None)


@pytest.mark.parametrize("fragment", ["", "x" * 10_000])
def test_fragments_are_bounded(port, fragment):
    with open_websocket(port) as stream:
        stream.send(["a", "b"])
        assert stream.recv() == "2"
        assert send_and_get_close_code(stream, [fragment] * 200) in (1009, None)


@pytest.mark.parametrize("pieces", [[b"{\xff}"], [b"{", b"\xff}"], [b"caf\xc3"]])
def test_text_that_is_not_utf_8_closes_the_stream_without_a_traceback(port, caplog, pieces):
    """One clear line for the client, and none in the log."""
    with open_websocket(port) as stream:
        stream.send(["caf\u00e9"[:3], "\u00e9"])
        assert stream.recv() == "4"
        stream.send(pieces, text=True)
        with pytest.raises(ConnectionClosed) as closed:
            stream.recv()
    assert (closed.value.rcvd.code, closed.value.rcvd.reason) == (1007, "text that is not UTF-8")
    assert caplog.records == []


def test_a_refused_websocket_is_answered_and_leaves_no_line_in_the_log(port, caplog):
    for _ in range(3):
        with pytest.raises(InvalidStatus) as refused:
            open_websocket(port, "/refused")
        assert (refused.value.response.status_code, refused.value.response.body) == (403, b"no, not you")
    with open_websocket(port) as stream:  # the connection of a refusal ends after its answer, and so does what it logs
        stream.send("abc")
        assert stream.recv() == "3"
    assert caplog.records == []


HANDSHAKE = (
    b"GET /v1/stream HTTP/1.1\r\nHost: localhost\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
)
PING, PONG = b"\x89\x80\x00\x00\x00\x00", b"\x8a\x00"
MESSAGE, ECHO = b"\x81\x81\x00\x00\x00\x00x", b"\x81\x011"


def test_pings_are_paced_and_delay_no_other_client(open_client, monkeypatch):
    monkeypatch.setattr(bounded_protocols, "FRAMES_PER_S", 1.0 / LONG_S)
    stream = open_client()
    stream.send(HANDSHAKE)
    assert stream.receive().startswith(b"HTTP/1.1 101 ")
    stream.send(PING * 2500)  # what the sockets hold beyond this would block this thread
    received = b""
    while len(received) < len(PONG) * bounded_protocols.FRAMES_BURST:
        received += stream.receive()
    for _ in range(20):
        assert open_client().ask(STOP)
    stream.link.setblocking(False)
    with suppress(BlockingIOError):
        while True:
            received += stream.receive()
    slice_frames = bounded_protocols.SLICE_BYTES // len(PING) + 1
    assert len(received) <= len(PONG) * (bounded_protocols.FRAMES_BURST + slice_frames)


def test_messages_wait_for_the_pings_before_them(open_client, monkeypatch):
    monkeypatch.setattr(bounded_protocols, "FRAMES_PER_S", 1000.0)
    stream = open_client()
    stream.send(HANDSHAKE)
    stream.receive()
    stream.send(PING * 500 + MESSAGE + PING * 500 + MESSAGE)
    received = b""
    while received.count(ECHO) < 2:
        received += stream.receive()
    assert received.count(PONG) >= 900


def test_a_request_that_waited_for_its_turn_states_when_it_arrived(open_client, server, application):
    blocking, others = [open_client() for _ in range(2)], [open_client() for _ in range(30)]
    assert all(client.ask(GET) for client in (*blocking, *others))
    blocking[0].send(GET.replace(b"/v1/state", b"/block"))
    application.blocked.acquire()
    for client in (blocking[1], *others):
        client.send(GET.replace(b"/v1/state", b"/block" if client is blocking[1] else b"/v1/state"))
    await_unread(server, 31)
    application.go_on.release()
    application.blocked.acquire()  # among the first of them, while the others wait for their turn
    application.arrivals.clear()
    blocked_s = time.monotonic()
    application.go_on.release()
    assert all(client.receive_answer() for client in (*others, *blocking))
    arrived_s = [at_s for _, at_s in application.arrivals]
    assert len(arrived_s) > 20
    assert max(arrived_s) < blocked_s
    begin_s = time.monotonic()
    assert others[0].ask(GET)
    assert application.arrivals[-1][1] >= begin_s


def test_a_message_that_waited_is_not_taken_for_new(port, server, application):
    with open_websocket(port) as stream:
        (protocol,) = server.server_state.connections
        begin_s = time.monotonic()
        stream.send("first")
        stream.recv()
        stream.send("wait")
        wait_for(lambda: len(application.message_arrivals) == 2, "the message for which the next one waits")
        stream.send("next")
        wait_for(protocol.queue.qsize, "the next message")
        waiting_s = time.monotonic()
        server.loop.call_soon_threadsafe(application.release.set)
        assert [stream.recv(), stream.recv()] == ["4", "4"]
        wait_for(lambda: protocol._unread_since_s is None, "the end of all input")
        new_s = time.monotonic()
        stream.send("new")
        stream.recv()
    assert application.message_arrivals[0][0] >= begin_s
    assert application.message_arrivals[2][1] < waiting_s
    assert application.message_arrivals[3][0] >= new_s


def test_a_message_soon_after_another_arrived_when_it_was_sent(port, application):
    """It may have waited beside the one before, so its earliest time is older."""
    with open_websocket(port) as stream:
        for number in range(20):
            begin_s = time.monotonic()
            stream.send("next")
            end_s = time.monotonic()
            stream.recv()
            earliest_s, arrived_s = application.message_arrivals[number]
            assert earliest_s <= arrived_s
            assert begin_s <= arrived_s <= end_s


def test_a_message_that_is_read_late_arrived_when_it_was_sent(open_client, port, application):
    with open_websocket(port) as stream:
        stream.send("first")
        stream.recv()
        blocking = open_client()
        blocking.send(GET.replace(b"/v1/state", b"/block"))
        application.blocked.acquire()
        stream.send("while the loop is blocked")
        sent_s = time.monotonic()
        application.go_on.release()
        stream.recv()
    assert application.message_arrivals[1][1] <= sent_s


def test_a_message_arrives_with_its_first_byte(open_client, server, application):
    stream = open_client()
    stream.send(HANDSHAKE)
    stream.receive()
    (protocol,) = server.server_state.connections
    stream.send(PING)
    assert PONG in stream.receive()
    ping_s = time.monotonic()
    stream.send(MESSAGE[:3])
    first_s = time.monotonic()
    wait_for(lambda: protocol.conn.reader.buffer, "the first bytes of the message")
    stream.send(MESSAGE[3:])
    assert ECHO in stream.receive()
    ((earliest_s, arrived_s),) = application.message_arrivals
    assert earliest_s <= arrived_s
    assert ping_s <= arrived_s <= first_s
