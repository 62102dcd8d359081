"""A blocking stream over TLS: threads that send and wait leave its OpenSSL to the thread of its loop."""

import asyncio
import itertools
import json
import os
import signal
import ssl
import sys
import threading
import weakref

import numpy as np
import pytest
from websockets.asyncio.server import serve

from optodrive.client.exchange import Endpoint
from optodrive.client.sockets import LoopThread
from optodrive.client.stream import Stream
from optodrive.core.errors import LinkError, NotReadyError
from optodrive.device.config import PixelLayout

FRAMES, SENDERS = 40, 3
CALLS = 2000
PIXEL = np.zeros(1)


@pytest.fixture
def stream(certificate, monkeypatch):
    """A stream to a server that answers every frame."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(*certificate)
    monkeypatch.setenv("SSL_CERT_FILE", str(certificate[0]))

    async def answer(connection):
        async for frame in connection:
            number = int.from_bytes(frame[4:8], "little")
            await connection.send(json.dumps({"frame": number, "status": "superseded"}))

    loop = LoopThread("server")

    async def start():
        return await serve(answer, "localhost", 0, ssl=context)

    server = loop.run(start())
    port = server.sockets[0].getsockname()[1]
    layout = PixelLayout(PIXEL, PIXEL, PIXEL.astype(int), PIXEL.astype(int))
    with Stream(
        Endpoint(f"https://localhost:{port}", "token"), layout, "trim", False, False, 0.0, lambda: None
    ) as stream:
        yield stream

    async def stop():
        server.close()
        await server.wait_closed()

    loop.run(stop())
    loop.close()


def test_one_thread_alone_enters_the_connection(stream, monkeypatch):
    entered = set()
    for name in ("read", "write"):
        original = getattr(ssl.SSLObject, name)

        def call(self, *arguments, original=original):
            if not self.server_side:
                entered.add(threading.current_thread().name)
            return original(self, *arguments)

        monkeypatch.setattr(ssl.SSLObject, name, call)

    def send():
        for _ in range(FRAMES):
            stream.wait(stream.send([50.0]))

    senders = [threading.Thread(target=send) for _ in range(SENDERS)]
    for sender in senders:
        sender.start()
    for sender in senders:
        sender.join()
    assert len(stream.results()) == FRAMES * SENDERS
    assert entered == {"stream"}


def test_a_closed_stream_still_tells_what_arrived(stream):
    number = stream.send([50.0])
    result = stream.wait(number)
    stream.close()
    assert stream.wait(number) == result
    assert stream.results() == [result]
    with pytest.raises(NotReadyError, match="the stream is closed"):
        stream.send([50.0])
    with pytest.raises(NotReadyError, match="the stream is closed"):
        stream.wait(number + 1)


def test_a_wait_in_another_thread_ends_with_the_stream(stream):
    errors = []

    def wait():
        try:
            stream.wait(7, timeout_s=3600.0)
        except (LinkError, NotReadyError) as error:
            errors.append(error)

    waiter = threading.Thread(target=wait)
    waiter.start()
    stream.close()
    waiter.join()
    assert len(errors) == 1


def test_an_interrupted_caller_cancels_its_coroutine():
    loop, cancelled = LoopThread("test"), threading.Event()

    async def interrupt():
        try:
            os.kill(os.getpid(), signal.SIGINT)
            await asyncio.Event().wait()
        finally:
            cancelled.set()

    with pytest.raises(KeyboardInterrupt):
        loop.run(interrupt())
    loop.close()
    assert cancelled.is_set()


def test_no_task_ends_in_the_thread_of_a_caller():
    """The callback with which asyncio learns of a task's end would drop the exception of Ctrl-C there."""
    loop, ends, references = LoopThread("test"), set(), []

    async def note_end():
        references.append(weakref.ref(asyncio.current_task(), lambda _: ends.add(threading.current_thread().name)))

    for _ in range(CALLS):
        loop.run(note_end())
    loop.close()
    assert ends == {"test"}


def test_ctrl_c_anywhere_in_a_caller_leaves_a_loop_that_works_and_ends():
    """Interrupt each operation of a call in turn, in Python's own modules, too."""
    loop = LoopThread("test")

    async def answer():
        return 42

    for at in itertools.count():
        operations, coroutine = itertools.count(), answer()

        def interrupt(frame, event, argument, at=at, operations=operations):
            frame.f_trace_opcodes = True
            if event == "opcode" and next(operations) == at:
                raise KeyboardInterrupt
            return interrupt

        sys.settrace(interrupt)
        try:
            loop.run(coroutine)
            break
        except KeyboardInterrupt:
            pass
        finally:
            sys.settrace(None)
        assert loop.run(answer()) == 42
        coroutine.close()  # which one that came too early has not started
    assert at > 100
    loop.close()
