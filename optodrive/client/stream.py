"""Frames that keep coming, from Python: the newest wins, and each is told what became of it."""

import json
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack
from types import TracebackType
from typing import Self

from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from optodrive.client.answers import FrameResult
from optodrive.client.heights import HeightsLike, convert_to_pixels, encode_frame
from optodrive.client.http import RETRY_S, Endpoint, build_error
from optodrive.client.requests import Policy
from optodrive.core.errors import LinkError, OptodriveError
from optodrive.device.config import PixelLayout

RESULTS_MAX = 1000
"""Results kept for a caller who does not ask for them; the oldest go first."""
OPEN_TIMEOUT_S = 10.0
RESULT_TIMEOUT_S = 30.0
CONNECTION_ERRORS = (OSError, InvalidHandshake, ConnectionClosed, TimeoutError)


class ResultBuffer:
    """What became of frames, for one reader; whoever takes it in may be another thread."""

    def __init__(self) -> None:
        self._unread: deque[FrameResult] = deque(maxlen=RESULTS_MAX)
        self._final: dict[int | None, FrameResult] = {}

    def add(self, text: str | bytes) -> FrameResult:
        """One answer of the daemon."""
        result = FrameResult.from_message(json.loads(text))
        self._unread.append(result)
        if result.final:
            self._final[result.frame] = result
            while len(self._final) > RESULTS_MAX:
                del self._final[next(iter(self._final))]
        return result

    def drain(self) -> list[FrameResult]:
        """Those that came since the last call, in order."""
        results = []
        while self._unread:
            results.append(self._unread.popleft())
        return results

    def find_final(self, frame: int) -> FrameResult | None:
        """What became of a frame once nothing more comes of it; or, once, of one that the daemon could not read."""
        return self._final.get(frame) or self._final.pop(None, None)


def build_stream_url(endpoint: Endpoint, policy: Policy) -> str:
    """Where the stream is."""
    return f"ws{endpoint.url.removeprefix('http')}/v1/stream?policy={policy}"


def parse_refusal(error: InvalidStatus) -> OptodriveError:
    """The package's error for a stream that was not let in."""
    try:
        document = json.loads(error.response.body or b"")
    except ValueError:
        document = None
    return build_error(error.response.status_code, document)


def raise_if_failed(result: FrameResult) -> FrameResult:
    """The result; its error where it was refused or failed."""
    if result.error is not None and result.status in ("refused", "failed"):
        raise result.error
    return result


class Stream:
    """An open stream; `Display.stream()` makes one. A link that breaks is made again at the next frame."""

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
        self._url = build_stream_url(endpoint, policy)
        self._reconnect_timeout_s = reconnect_timeout_s
        self._on_send = on_send
        self._next_frame = 0
        self._results = ResultBuffer()
        self._results_changed = threading.Condition()
        self._lost_before = 0
        self._exit_stack = ExitStack()
        self._connection = self._connect()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Leave; the daemon drops what has not left for the board."""
        self._exit_stack.close()

    def send(self, heights_um: HeightsLike) -> int:
        """Show a frame, in the place of what has not left of the one before; its number.

        LinkError where the daemon cannot be reached again. A daemon that restarted has a board that is not armed: the
        frame is then refused, and stays so until someone arms.
        """
        number, self._next_frame = self._next_frame, self._next_frame + 1
        frame = encode_frame(number, convert_to_pixels(heights_um, self._layout))
        self._on_send()
        deadline_s = time.monotonic() + self._reconnect_timeout_s
        while True:
            try:
                self._connection.send(frame)
                return number
            except ConnectionClosed:
                self._reconnect(deadline_s)

    def results(self) -> list[FrameResult]:
        """What the daemon said since the last call, in order."""
        with self._results_changed:
            return self._results.drain()

    def wait(self, frame: int | None = None, timeout_s: float = RESULT_TIMEOUT_S) -> FrameResult:
        """What became of a frame, the last one sent if not said; raises its error where it was refused or failed."""
        number = self._next_frame - 1 if frame is None else frame
        deadline_s = time.monotonic() + timeout_s
        with self._results_changed:
            while (result := self._results.find_final(number)) is None:
                if number < self._lost_before:
                    raise LinkError(f"the link broke before it was heard what became of frame {number}")
                if not self._results_changed.wait(deadline_s - time.monotonic()):
                    raise LinkError(f"nothing was heard of frame {number} for {timeout_s:g} s")
        return raise_if_failed(result)

    def _connect(self) -> ClientConnection:
        try:
            connection = self._open_connection()
        except InvalidStatus as error:
            if error.response.status_code != 401 or not self._endpoint.renew_token():
                raise parse_refusal(error) from None
            connection = self._open_connection()
        except CONNECTION_ERRORS as error:
            raise self._endpoint.build_unreachable_error(error) from None
        threading.Thread(target=self._read, args=(connection,), name="stream", daemon=True).start()
        return connection

    def _open_connection(self) -> ClientConnection:
        self._exit_stack.close()
        connection = connect(
            self._url,
            additional_headers=self._endpoint.headers,
            sock=self._endpoint.open_unix_socket(),
            proxy=None,
            open_timeout=OPEN_TIMEOUT_S,
            compression=None,
        )
        return self._exit_stack.enter_context(connection)

    def _reconnect(self, deadline_s: float) -> None:
        while True:
            try:
                self._connection = self._connect()
                return
            except LinkError:
                if time.monotonic() >= deadline_s:
                    raise
                time.sleep(RETRY_S)

    def _read(self, connection: ClientConnection) -> None:
        """Take answers in as they come: a caller that leaves too many unread is cut off."""
        try:
            for message in connection:
                with self._results_changed:
                    self._results.add(message)
                    self._results_changed.notify_all()
        except ConnectionClosed:
            pass  # found out, and mended, by whoever sends
        finally:
            with self._results_changed:
                self._lost_before = self._next_frame
                self._results_changed.notify_all()
