"""A stream of frames, of which the newest wins, with an asynchronous interface."""

import asyncio
import time
from collections.abc import Awaitable, Callable
from contextlib import AsyncExitStack
from typing import Self

import httpx
from websockets.asyncio.client import ClientConnection
from websockets.exceptions import ConnectionClosed

from optodrive.client.endpoint import Endpoint
from optodrive.client.exchange import RETRY_S, RETRY_TIMEOUT_MIN_S
from optodrive.client.frame_results import (
    RESULT_TIMEOUT_S,
    FrameCounts,
    ResultBuffer,
    build_closed_error,
    build_stream_path,
    build_timeout_error,
    raise_if_failed,
)
from optodrive.client.heights import HeightsLike, convert_to_pixels, encode_frame
from optodrive.client.http import PROBE, PROBE_PERIOD_S, PROBE_TIMEOUT_S
from optodrive.client.socket_connection import OPEN_TIMEOUT_S, open_connection
from optodrive.core.errors import LinkError
from optodrive.core.types.push_options import Policy, check_keywords
from optodrive.daemon.responses.messages import FrameResult
from optodrive.device.config import PixelLayout


@check_keywords
class AsyncStream:
    """A stream that opens when entered. See `Stream`."""

    def __init__(
        self,
        endpoint: Endpoint,
        read_layout: Callable[[], Awaitable[PixelLayout]],
        policy: Policy,
        standing: bool,
        reconnect_timeout_s: float,
        on_send: Callable[[], None],
    ) -> None:
        self._endpoint = endpoint
        self._read_layout = read_layout
        self._path = build_stream_path(policy, standing)
        self._on_send = on_send
        self._next_frame = 0
        self._results = ResultBuffer()
        self._reconnect_timeout_s = reconnect_timeout_s
        self._was_silent = False
        self._is_closed = False
        self._results_changed = asyncio.Event()
        self._exit_stack = AsyncExitStack()
        self._connection: ClientConnection | None = None
        self._reader_task: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Self:
        await self._connect()
        return self

    async def __aexit__(self, *details: object) -> None:
        await self.close()

    async def close(self) -> None:
        """See `Stream.close`."""
        self._is_closed = True
        await self._exit_stack.aclose()
        reader, self._reader_task = self._reader_task, None
        if reader is not None:
            await asyncio.gather(reader, return_exceptions=True)

    async def send(self, heights_um: HeightsLike) -> int:
        """See `Stream.send`."""
        if self._is_closed:
            raise build_closed_error()
        number, self._next_frame = self._next_frame, self._next_frame + 1
        frame = encode_frame(number, convert_to_pixels(heights_um, await self._read_layout()))
        self._on_send()
        deadline_s = None
        while True:
            try:
                if self._connection is not None:
                    await self._connection.send(frame)
                    return number
            except ConnectionClosed:
                self._connection = None
            if self._is_closed:  # meanwhile, by another task
                raise build_closed_error()
            if deadline_s is None:
                was_silent, self._was_silent = self._was_silent, False
                deadline_s = time.monotonic() + (0.0 if was_silent else self._reconnect_timeout_s)
            try:
                await self._connect(max(deadline_s - time.monotonic(), RETRY_TIMEOUT_MIN_S))
            except LinkError:
                if time.monotonic() >= deadline_s:
                    raise
                await asyncio.sleep(RETRY_S)

    async def results(self) -> list[FrameResult]:
        """See `Stream.results`."""
        return self._results.drain()

    @property
    def counts(self) -> FrameCounts:
        """See `Stream.counts`."""
        return self._results.counts

    async def wait(self, frame: int | None = None, timeout_s: float = RESULT_TIMEOUT_S) -> FrameResult:
        """See `Stream.wait`."""
        number = self._next_frame - 1 if frame is None else frame
        deadline_s = time.monotonic() + timeout_s
        while (result := self._results.find_final(number)) is None:
            if self._is_closed:
                raise build_closed_error()
            self._results_changed.clear()
            try:
                await asyncio.wait_for(self._results_changed.wait(), deadline_s - time.monotonic())
            except TimeoutError:
                raise build_timeout_error(number, timeout_s) from None
        return raise_if_failed(result)

    async def _connect(self, open_timeout_s: float = OPEN_TIMEOUT_S) -> None:
        await self._exit_stack.aclose()
        self._connection = await open_connection(
            self._endpoint, self._path, self._exit_stack, open_timeout_s=min(open_timeout_s, OPEN_TIMEOUT_S)
        )
        self._reader_task = asyncio.create_task(self._read(self._connection))

    async def _read(self, connection: ClientConnection) -> None:
        """Read messages as they arrive: the daemon disconnects a client that leaves too many unread."""
        try:
            while True:
                try:
                    async with asyncio.timeout(PROBE_PERIOD_S):
                        message = await connection.recv()
                except TimeoutError:
                    if self._results.is_owed(self._next_frame - 1):
                        await self._probe(connection)
                    continue
                self._results.add(message)
                self._results_changed.set()
        except ConnectionClosed:
            pass  # the next `send` detects and repairs this
        finally:
            self._results.mark_lost_before(self._next_frame)
            self._results_changed.set()

    async def _probe(self, connection: ClientConnection) -> None:
        """Break the connection if the daemon, which owes an answer, does not answer others either."""
        try:
            async with self._endpoint.open_async_client(PROBE_TIMEOUT_S) as client:
                await client.request(**PROBE)
        except httpx.TransportError:
            self._was_silent = self._endpoint.is_lost = True
            connection.transport.abort()
