"""A stream of frames, of which the newest wins, with an asynchronous and a blocking interface."""

import asyncio
import time
from collections import deque
from collections.abc import Awaitable, Callable
from contextlib import AsyncExitStack
from typing import NamedTuple, Self
from urllib.parse import urlencode

import httpx
from websockets.asyncio.client import ClientConnection
from websockets.exceptions import ConnectionClosed

from optodrive.client.exchange import RETRY_S, RETRY_TIMEOUT_MIN_S, Endpoint
from optodrive.client.heights import HeightsLike, convert_to_pixels, encode_frame
from optodrive.client.http import PROBE, PROBE_PERIOD_S, PROBE_TIMEOUT_S
from optodrive.client.problems import build_error
from optodrive.client.sockets import OPEN_TIMEOUT_S, BlockingConnection, open_connection
from optodrive.core.errors import InputError, LinkError, NotReadyError, RefusedError
from optodrive.core.types.push_options import Policy, check_keywords
from optodrive.daemon.responses.messages import FrameResult
from optodrive.device.config import PixelLayout

RESULTS_MAX = 1000
"""Results that are kept for a caller who does not read them; the oldest are dropped first."""
RESULT_TIMEOUT_S = 30.0


class FrameCounts(NamedTuple):
    """Frames of a stream whose final result has arrived, all of them, whether the results were read or not.

    shown: at least one pulse was emitted, or residual heat held every pixel at its height; superseded: a newer frame
    replaced it before its first pulse; other: refused, stopped, cancelled or failed before it
    """

    shown: int = 0
    superseded: int = 0
    other: int = 0


class ResultBuffer:
    """Results of frames for one reader. Another thread may add them.

    counts: of all final results so far
    """

    def __init__(self) -> None:
        self.counts = FrameCounts()
        self._unread: deque[FrameResult] = deque(maxlen=RESULTS_MAX)
        self._final: dict[int | None, FrameResult] = {}
        self._lost_before = 0

    def add(self, text: str | bytes) -> None:
        """Parse and add one message of the daemon."""
        result = FrameResult.model_validate_json(text, extra="ignore")
        self._unread.append(result)
        if result.is_final:
            outcome = "shown" if result.is_shown else "superseded" if result.status == "superseded" else "other"
            self.counts = self.counts._replace(**{outcome: getattr(self.counts, outcome) + 1})
            self._final[result.frame] = result
            while len(self._final) > RESULTS_MAX:
                del self._final[next(iter(self._final))]

    def mark_lost_before(self, frame: int) -> None:
        """Record that the connection broke: missing results of frames below this one will not arrive."""
        self._lost_before = frame

    def drain(self) -> list[FrameResult]:
        """Return the results since the last call, in order."""
        results = []
        while self._unread:
            results.append(self._unread.popleft())
        return results

    def find_final(self, frame: int) -> FrameResult | None:
        """Return the final result of a frame, or once that of a frame that the daemon could not read.

        None if neither has arrived; LinkError if it was lost with the connection.
        """
        result = self._final.get(frame) or self._final.pop(None, None)
        if result is None and frame < self._lost_before:
            raise LinkError(f"the connection broke before the result of frame {frame} arrived")
        return result

    def is_owed(self, frame: int) -> bool:
        """Return whether the daemon owes the final result of a frame. Nothing is owed for −1, before the first one."""
        return frame >= self._lost_before and frame not in self._final


def build_stream_path(policy: Policy, standing: bool, touched_only: bool) -> str:
    """Build the path of the stream's WebSocket. Raise InputError for touched_only of frames that do not stand."""
    if touched_only and not standing:
        raise InputError("touched_only", touched_only, "standing=True with it: other frames are drawn once")
    flags = {"standing": standing, "touched_only": touched_only}
    return f"/v1/stream?{urlencode({'policy': policy} | {name: str(is_set).lower() for name, is_set in flags.items()})}"


def build_closed_error() -> NotReadyError:
    """Build the error for a frame that is sent after the stream was closed, which nobody would end."""
    return NotReadyError("the stream is closed; open another with `stream()` of the display")


def build_timeout_error(frame: int, timeout_s: float) -> LinkError:
    """Build the error for a result that did not arrive in time."""
    return LinkError(f"no result of frame {frame} arrived within {timeout_s:g} s")


def raise_if_failed(result: FrameResult) -> FrameResult:
    """Return the result. Raise its error if the frame was refused, or its plan failed or was stopped."""
    if result.problem is not None:
        raise build_error(result.problem)
    if result.status in ("failed", "stopped"):
        raise RefusedError(f"frame {result.frame}: {result.error}")
    return result


@check_keywords
class AsyncStream:
    """A stream that opens when entered. See `Stream`."""

    def __init__(
        self,
        endpoint: Endpoint,
        read_layout: Callable[[], Awaitable[PixelLayout]],
        policy: Policy,
        standing: bool,
        touched_only: bool,
        reconnect_timeout_s: float,
        on_send: Callable[[], None],
    ) -> None:
        self._endpoint = endpoint
        self._read_layout = read_layout
        self._path = build_stream_path(policy, standing, touched_only)
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


@check_keywords
class Stream(BlockingConnection[AsyncStream]):
    """An open stream. `Display.stream()` builds one. A broken connection is restored at the next frame.

    Once it is closed, the daemon drops the pulses that are not yet committed to the board.
    """

    def __init__(
        self,
        endpoint: Endpoint,
        layout: PixelLayout,
        policy: Policy,
        standing: bool,
        touched_only: bool,
        reconnect_timeout_s: float,
        on_send: Callable[[], None],
    ) -> None:
        async def get_layout() -> PixelLayout:
            return layout

        stream = (endpoint, get_layout, policy, standing, touched_only, reconnect_timeout_s, on_send)
        super().__init__(AsyncStream(*stream), "stream")

    def send(self, heights_um: HeightsLike) -> int:
        """Show a frame in place of the uncommitted rest of the previous one. Return its number.

        LinkError if the daemon does not answer or cannot be reached again. The board of a restarted daemon is not
        armed; frames are then refused until somebody arms it. NotReadyError after `close`.
        """
        return self._loop.run(self._connection.send(heights_um))

    def results(self) -> list[FrameResult]:
        """Return the results since the last call, in order.

        Of results that nobody reads the newest 1,000 are kept, about 500 frames; `counts` counts all.
        """
        return self._loop.run(self._connection.results())

    @property
    def counts(self) -> FrameCounts:
        """Number of frames shown and superseded so far. Every final result counts, also one that `results` drops."""
        return self._connection.counts

    def wait(self, frame: int | None = None, timeout_s: float = RESULT_TIMEOUT_S) -> FrameResult:
        """Wait for the final result of a frame, by default the last one sent. Raise its error if it failed."""
        return self._loop.run(self._connection.wait(frame, timeout_s))
