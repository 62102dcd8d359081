"""A stream of frames, of which the newest wins, with a blocking interface."""

import socket
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from types import TracebackType
from typing import Self

import httpx
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection

from optodrive.client.endpoint import Endpoint
from optodrive.client.exchange import RETRY_S, RETRY_TIMEOUT_MIN_S
from optodrive.client.frame_results import (
    RESULT_TIMEOUT_S,
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
from optodrive.core.types.push_options import Policy
from optodrive.daemon.responses.stream import FrameResult
from optodrive.device.config import PixelLayout


class Stream:
    """An open stream. `Display.stream()` builds one. A broken connection is restored at the next frame.

    on_send: called before each frame
    """

    def __init__(
        self,
        endpoint: Endpoint,
        layout: PixelLayout,
        policy: Policy,
        reconnect_timeout_s: float,
        on_send: Callable[[], None],
    ) -> None:
        self._endpoint = endpoint
        self._layout = layout
        self._path = build_stream_path(policy)
        self._on_send = on_send
        self._next_frame = 0
        self._results = ResultBuffer()
        self._reconnect_timeout_s = reconnect_timeout_s
        self._was_silent = False
        self._is_closed = False
        self._results_changed = threading.Condition()
        self._exit_stack = ExitStack()
        self._connection = self._connect()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the stream. The daemon drops the pulses that are not yet committed to the board."""
        self._is_closed = True
        self._exit_stack.close()

    def send(self, heights_um: HeightsLike) -> int:
        """Show a frame in place of the uncommitted rest of the previous one. Return its number.

        LinkError if the daemon does not answer or cannot be reached again. The board of a restarted daemon is not
        armed; frames are then refused until somebody arms it. NotReadyError after `close`.
        """
        if self._is_closed:
            raise build_closed_error()
        number, self._next_frame = self._next_frame, self._next_frame + 1
        frame = encode_frame(number, convert_to_pixels(heights_um, self._layout))
        self._on_send()
        deadline_s = None
        while True:
            try:
                self._connection.send(frame)
                return number
            except ConnectionClosed:
                if self._is_closed:  # meanwhile, by another thread
                    raise build_closed_error() from None
                deadline_s = deadline_s or self._compute_deadline_s()
                self._reconnect(deadline_s)

    def results(self) -> list[FrameResult]:
        """Return the results since the last call, in order."""
        with self._results_changed:
            return self._results.drain()

    def wait(self, frame: int | None = None, timeout_s: float = RESULT_TIMEOUT_S) -> FrameResult:
        """Wait for the final result of a frame, by default the last one sent. Raise its error if it failed."""
        number = self._next_frame - 1 if frame is None else frame
        deadline_s = time.monotonic() + timeout_s
        with self._results_changed:
            while (result := self._results.find_final(number)) is None:
                if not self._results_changed.wait(deadline_s - time.monotonic()):
                    raise build_timeout_error(number, timeout_s)
        return raise_if_failed(result)

    def _connect(self, open_timeout_s: float = OPEN_TIMEOUT_S) -> ClientConnection:
        self._exit_stack.close()
        connection = open_connection(
            self._endpoint, self._path, self._exit_stack, open_timeout_s=min(open_timeout_s, OPEN_TIMEOUT_S)
        )
        threading.Thread(target=self._read, args=(connection,), name="stream", daemon=True).start()
        return connection

    def _compute_deadline_s(self) -> float:
        """Return until when to reconnect: at once, if the daemon was given time to answer before."""
        was_silent, self._was_silent = self._was_silent, False
        return time.monotonic() + (0.0 if was_silent else self._reconnect_timeout_s)

    def _reconnect(self, deadline_s: float) -> None:
        while True:
            try:
                self._connection = self._connect(max(deadline_s - time.monotonic(), RETRY_TIMEOUT_MIN_S))
                return
            except LinkError:
                if time.monotonic() >= deadline_s:
                    raise
                time.sleep(RETRY_S)

    def _read(self, connection: ClientConnection) -> None:
        """Read messages as they arrive: the daemon disconnects a client that leaves too many unread."""
        try:
            while True:
                try:
                    message = connection.recv(timeout=PROBE_PERIOD_S)
                except TimeoutError:
                    if self._results.is_owed(self._next_frame - 1):
                        self._probe(connection)
                    continue
                with self._results_changed:
                    self._results.add(message)
                    self._results_changed.notify_all()
        except ConnectionClosed:
            pass  # the next `send` detects and repairs this
        finally:
            with self._results_changed:
                self._results.mark_lost_before(self._next_frame)
                self._results_changed.notify_all()

    def _probe(self, connection: ClientConnection) -> None:
        """Break the connection if the daemon, which owes an answer, does not answer others either."""
        try:
            with self._endpoint.open_client(PROBE_TIMEOUT_S) as client:
                client.request(**PROBE)
        except httpx.TransportError:
            self._was_silent = self._endpoint.is_lost = True
            with suppress(OSError):
                connection.socket.shutdown(socket.SHUT_RDWR)  # also under a `send` that waits for the daemon
