"""The acceptor, in a thread of its own, between real sockets."""

import asyncio
import json
import socket
import threading
import time
from contextlib import ExitStack, suppress

import pytest

from optodrive.core.child_process import BeatWriter
from optodrive.core.ipc import MessageSocket
from optodrive.daemon.api.access_policy import AccessPolicy
from optodrive.daemon.api.tokens import Token, Tokens
from optodrive.daemon.server import acceptor_client, connection_queue
from optodrive.daemon.server.acceptor import UNOPENED_MAX, Acceptor
from optodrive.daemon.server.acceptor_client import AcceptorClient
from optodrive.daemon.server.connections import Rank, parse_head
from optodrive.daemon.server.listeners import open_tcp_listener
from optodrive.device.config_sections import DaemonSection

SECRET = "a-valid-secret-of-a-viewer"
BEARER = f"Authorization: Bearer {SECRET}"
HEADERS = {Rank.STOP: ("POST /v1/stop", BEARER), Rank.TOKEN: ("GET /v1/state", BEARER), Rank.OTHER: ("GET /", "A: b")}


def build_head(line, header):
    return f"{line} HTTP/1.1\r\nHost: localhost\r\n{header}\r\n\r\n".encode()


class AcceptorRig:
    """An acceptor in a thread, with the listening socket of a link process and the end of a supervisor."""

    def __init__(self, folder, stack):
        self._stack = stack
        self.path = folder / "acceptor"
        self._link_listener = stack.enter_context(socket.socket(socket.AF_UNIX))
        self._link_listener.bind(str(folder / "link"))
        self._link_listener.listen()
        self.supervisor, channel = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        stack.enter_context(self.supervisor)
        self.policy = AccessPolicy(Tokens([Token("viewer", "viewer", SECRET)]), DaemonSection())
        listener = stack.enter_context(open_tcp_listener("127.0.0.1", 0))
        self._port = listener.getsockname()[1]
        beat = BeatWriter(channel.detach())
        stack.callback(beat.close)
        self.acceptor = Acceptor([listener], self.policy, DaemonSection(), self.path, folder / "link", beat)
        stack.callback(self.acceptor.close)
        self.thread = thread = threading.Thread(target=self.acceptor.run)
        thread.start()
        stack.callback(thread.join)
        stack.callback(self.acceptor.end)
        self._link = MessageSocket(self._link_listener.accept()[0])
        stack.callback(self._link.close)
        self._messages = []
        assert self.await_message().fields["role"] == "acceptor"

    def await_message(self):
        """Return the next message to the link process."""
        while not self._messages:
            self._messages += self._link.receive()
            time.sleep(0.005)
        return self._messages.pop(0)

    def collect_kinds(self, rank):
        """Return the kinds of all messages to the link process once a connection waits with a rank."""
        while not self.acceptor._queue.count(rank):
            time.sleep(0.005)
        return [message.kind for message in self._link.receive()]

    def await_report(self, kind):
        """Return the next message of a kind to the supervisor."""
        while (fields := json.loads(self.supervisor.recv(10_000)))["kind"] != kind:
            pass
        return fields

    def send(self, head):
        """Send the head of a request on a new connection, which stays open."""
        link = self._stack.enter_context(socket.create_connection(("127.0.0.1", self._port)))
        link.sendall(head)
        return link


@pytest.fixture
def rig(tmp_path):
    with ExitStack() as stack:
        yield AcceptorRig(tmp_path, stack)


def test_stop_reaches_the_link_process_without_a_web_process(rig):
    rig.send(build_head(*HEADERS[Rank.STOP]))
    assert rig.await_message().kind == "stop"


@pytest.mark.parametrize(
    "head",
    [
        build_head("POST /v1/stop", "Authorization: Bearer guessed-by-nobody"),
        build_head("POST /v1/stop", f"Origin: https://evil.example\r\n{BEARER}"),
        build_head("POST /v1/arm", BEARER),
        build_head(*HEADERS[Rank.STOP])[:-2],
    ],
    ids=["wrong token", "foreign origin", "another route", "half a head"],
)
def test_nothing_but_a_permitted_stop_reaches_the_link_process(rig, head):
    rig.send(head)
    rig.send(build_head(*HEADERS[Rank.STOP]))
    assert rig.collect_kinds(Rank.STOP) == ["stop"]


def test_a_revoked_token_does_not_stop(rig):
    section = DaemonSection()
    daemon = {name: getattr(section, name) for name in ("hosts", "requests_per_s", "requests_burst")}
    message = {"kind": "reload", "id": 1, "daemon": daemon, "tokens": [["other", "viewer", "x" * 16]]}
    rig.supervisor.send(json.dumps(message).encode())
    revoked = parse_head(build_head(*HEADERS[Rank.STOP]))
    while rig.policy.find_token(revoked) is not None:
        time.sleep(0.005)
    rig.send(build_head(*HEADERS[Rank.STOP]))
    assert rig.collect_kinds(Rank.OTHER) == []
    rig.send(build_head("POST /v1/stop", "Authorization: Bearer " + "x" * 16))
    assert rig.await_message().kind == "stop"


def test_a_stop_that_nobody_answers_is_audited(rig, monkeypatch):
    monkeypatch.setattr(connection_queue, "WAIT_MAX_S", 0.2)
    link = rig.send(build_head(*HEADERS[Rank.STOP]))
    fields = rig.await_report("audit")["fields"]
    assert (fields["name"], fields["call"], fields["event"]) == ("viewer", "POST /v1/stop", "unanswered")
    with suppress(ConnectionResetError):
        assert link.recv(1) == b""


def run_client(rig, act):
    """Run a client of the acceptor in an event loop.

    act: receives it and the connections handed over
    """

    async def run():
        client, taken = AcceptorClient(rig.path), []
        client.on_connection = taken.append
        client.start()
        try:
            return await act(client, taken)
        finally:
            client.close()
            for waiting in taken:
                waiting.sock.close()

    return asyncio.run(run())


async def await_count(client, taken, count):
    """Return the ranks of the connections handed over.

    It waits until as many have come and the acceptor has had further turns.
    """
    while len(taken) < count:
        await asyncio.sleep(0.01)
    await await_beats(client)
    return [waiting.rank for waiting in taken]


async def await_beats(client):
    """Wait for two beats of the acceptor, between which it has handed over all connections that it may."""
    for _ in range(2):
        beaten_s = client._beaten_s
        while client._beaten_s == beaten_s:
            await asyncio.sleep(0.01)


def test_a_connection_is_handed_over_with_its_request_while_few_of_its_rank_are_unopened(rig):
    for rank in reversed(Rank):
        for _ in range(4):
            rig.send(build_head(*HEADERS[rank]))

    async def act(client, taken):
        first = await await_count(client, taken, 4 + UNOPENED_MAX[Rank.TOKEN] + UNOPENED_MAX[Rank.OTHER])
        assert taken[0].sock.recv(1000) == build_head(*HEADERS[Rank.STOP])
        client.confirm(next(waiting.number for waiting in taken if waiting.rank is Rank.OTHER))
        return first, await await_count(client, taken, len(first) + 1)

    first, later = run_client(rig, act)
    assert first == [Rank.STOP] * 4 + [Rank.TOKEN] * UNOPENED_MAX[Rank.TOKEN] + [Rank.OTHER] * UNOPENED_MAX[Rank.OTHER]
    assert later == [*first, Rank.OTHER]


def open_first_of(count):
    """Return a function that receives connections, opens the first and returns the ranks of all."""

    async def act(client, taken):
        ranks = await await_count(client, taken, count)
        client.confirm(taken[0].number)
        await await_beats(client)
        return ranks

    return act


def test_the_next_web_process_gets_what_waits(rig):
    rig.send(build_head(*HEADERS[Rank.TOKEN]))
    for _ in range(2):
        assert run_client(rig, open_first_of(1)) == [Rank.TOKEN]
        rig.send(build_head(*HEADERS[Rank.TOKEN]))


def test_the_next_web_process_gets_what_its_predecessor_has_not_opened(rig):
    for _ in range(2):
        rig.send(build_head(*HEADERS[Rank.TOKEN]))
    assert run_client(rig, open_first_of(2)) == [Rank.TOKEN] * 2
    assert run_client(rig, open_first_of(1)) == [Rank.TOKEN]


def test_an_acceptor_without_beats_is_not_alive_and_its_end_is_reported(rig, monkeypatch):
    async def act(client, taken):
        lost = []
        client.on_lost = lambda: lost.append(True)
        await await_beats(client)
        seen = [client.check_beats()]
        monkeypatch.setattr(acceptor_client, "BEAT_AGE_MAX_S", -1.0)
        seen.append(client.check_beats())
        monkeypatch.undo()
        rig.acceptor.end()
        await asyncio.to_thread(rig.thread.join)
        rig.acceptor.close()
        while not lost:
            await asyncio.sleep(0.01)
        return seen, lost, client.check_beats()

    assert run_client(rig, act) == ([True, False], [True], False)
