"""Connections of the web process to the others, over real sockets."""

import asyncio
import socket
import threading
from contextlib import contextmanager

import pytest

from optodrive.core.errors import LinkError
from optodrive.core.ipc import MESSAGE_MAX_BYTES, Message
from optodrive.daemon.api.peer import Peer
from optodrive.daemon.message_loop import MessageLoop, MessageServer


class Process:
    """A process that answers `echo`, keeps `wait` waiting, and greets every connection with `state`."""

    def __init__(self, path):
        self.received = []
        self._loop = MessageLoop()
        self._server = MessageServer(self._loop, path, self._on_message, lambda connection: None)
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self):
        while not self._closing.is_set():
            self._loop.poll(0.01)

    def _on_message(self, connection, message):
        self.received.append((message.kind, dict(message.fields)))
        if message.kind == "hello":
            self._loop.send(connection, Message("state", {"number": 7}))
        if message.kind == "echo":
            self._loop.send(connection, Message("result", {"id": message.fields["id"]}, message.payload))

    def close(self):
        self._closing.set()
        self._thread.join()
        self._server.close()


@contextmanager
def running(path):
    process = Process(path)
    try:
        yield process
    finally:
        process.close()


async def wait_for(condition):
    while not condition():
        await asyncio.sleep(0.005)


def run(path, scenario):
    """Run a scenario with a peer in an event loop."""

    async def main():
        peer = Peer("planner", path)
        peer.on_connected = lambda: peer.send(Message("hello", {}))
        peer.start()
        try:
            await scenario(peer)
        finally:
            peer.close()

    asyncio.run(main())


def test_a_request_gets_its_own_result(tmp_path):
    async def scenario(peer):
        payloads = [bytes([number]) * 100_000 for number in range(20)]
        results = await asyncio.gather(*(peer.call(Message("echo", {}, payload)) for payload in payloads))
        assert [result.payload for result in results] == payloads

    with running(tmp_path / "s"):
        run(tmp_path / "s", scenario)


def test_without_the_process_a_request_fails_at_once_and_a_message_is_dropped(tmp_path):
    async def scenario(peer):
        with pytest.raises(LinkError, match="planner process does not run"):
            await peer.call(Message("echo", {}))
        peer.send(Message("echo", {}))

    run(tmp_path / "nowhere", scenario)


def test_the_end_of_the_process_fails_its_requests_and_the_next_process_is_found(tmp_path):
    async def scenario(peer):
        lost = []
        peer.on_lost = lambda: lost.append(peer.is_connected)
        first = Process(tmp_path / "s")
        await wait_for(lambda: peer.is_connected)
        waiting = asyncio.ensure_future(peer.call(Message("wait", {})))
        await wait_for(lambda: "wait" in dict(first.received))
        await asyncio.to_thread(first.close)
        with pytest.raises(LinkError, match="does not run"):
            await waiting
        assert lost == [False]
        with running(tmp_path / "s") as second:
            await wait_for(lambda: peer.is_connected)
            assert (await peer.call(Message("echo", {}, b"again"))).payload == b"again"
            assert second.received[0][0] == "hello"

    run(tmp_path / "s", scenario)


def test_the_process_after_one_that_died_without_reading_is_found(tmp_path):
    """Bytes wait in both sockets then, so the connection is reset while its writer is registered."""

    async def scenario(peer):
        with socket.socket(socket.AF_UNIX) as listener:
            listener.bind(str(tmp_path / "s"))
            listener.listen()
            connection, _ = await asyncio.to_thread(listener.accept)
            waiting = asyncio.ensure_future(peer.call(Message("wait", {}, bytes(5_000_000))))
            await wait_for(lambda: peer._socket.wants_write)
            connection.close()
        with pytest.raises(LinkError, match="does not run"):
            await waiting
        with running(tmp_path / "s"):
            await wait_for(lambda: peer.is_connected)
            assert (await peer.call(Message("echo", {}, b"again"))).payload == b"again"

    run(tmp_path / "s", scenario)


def test_a_caller_that_leaves_drops_its_request(tmp_path):
    async def scenario(peer):
        waiting = asyncio.ensure_future(peer.call(Message("wait", {})))
        await wait_for(lambda: any(kind == "wait" for kind, _ in process.received))
        waiting.cancel()
        await wait_for(lambda: any(kind == "drop" for kind, _ in process.received))
        fields = dict(process.received)
        assert fields["drop"]["id"] == fields["wait"]["id"]

    with running(tmp_path / "s") as process:
        run(tmp_path / "s", scenario)


def test_a_message_that_is_too_large_is_refused_and_the_connection_stays(tmp_path):
    async def scenario(peer):
        with pytest.raises(LinkError, match="expected at most"):
            await peer.call(Message("echo", {}, bytes(MESSAGE_MAX_BYTES)))
        assert (await peer.call(Message("echo", {}, b"x"))).payload == b"x"

    with running(tmp_path / "s"):
        run(tmp_path / "s", scenario)


def test_pushed_messages_are_received(tmp_path):
    async def scenario(peer):
        received = []
        peer.on_message = received.append
        await wait_for(lambda: received)
        assert received == [Message("state", {"number": 7})]

    with running(tmp_path / "s"):
        run(tmp_path / "s", scenario)


def test_a_large_request_does_not_hold_the_loop(tmp_path):
    async def scenario(peer):
        turns = 0
        call = asyncio.ensure_future(peer.call(Message("echo", {}, bytes(30_000_000))))
        while not call.done():
            await asyncio.sleep(0)
            turns += 1
        assert len(call.result().payload) == 30_000_000
        assert turns > 50  # it was sent and received in pieces

    with running(tmp_path / "s"):
        run(tmp_path / "s", scenario)
