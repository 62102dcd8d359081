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
from optodrive.client.heights import Heights, by_pixel, to_bytes
from optodrive.client.http import RETRY_S, Access, problem_error
from optodrive.client.requests import Policy
from optodrive.core.errors import LinkError, OptodriveError
from optodrive.device.config import PixelLayout

KEPT = 1000
"""Results kept for a caller who does not ask for them; the oldest go first."""
OPEN_TIMEOUT_S = 10.0
ANSWER_TIMEOUT_S = 30.0
BROKEN = (OSError, InvalidHandshake, ConnectionClosed, TimeoutError)


class Results:
    """What became of frames, for one reader; whoever takes it in may be another thread."""

    def __init__(self) -> None:
        self._kept: deque[FrameResult] = deque(maxlen=KEPT)
        self._final: dict[int | None, FrameResult] = {}

    def take_in(self, text: str | bytes) -> FrameResult:
        """One answer of the daemon."""
        result = FrameResult.of(json.loads(text))
        self._kept.append(result)
        if result.final:
            self._final[result.frame] = result
            while len(self._final) > KEPT:
                del self._final[next(iter(self._final))]
        return result

    def drained(self) -> list[FrameResult]:
        """Those that came since the last call, in order."""
        found = []
        while self._kept:
            found.append(self._kept.popleft())
        return found

    def final(self, frame: int) -> FrameResult | None:
        """What became of a frame once nothing more comes of it; or, once, of one that the daemon could not read."""
        return self._final.get(frame) or self._final.pop(None, None)


def socket_url(access: Access, policy: Policy) -> str:
    """Where the stream is."""
    return f"ws{access.url.removeprefix('http')}/v1/stream?policy={policy}"


def refusal(error: InvalidStatus) -> OptodriveError:
    """The package's error for a stream that was not let in."""
    try:
        document = json.loads(error.response.body or b"")
    except ValueError:
        document = None
    return problem_error(error.response.status_code, document)


def raised(result: FrameResult) -> FrameResult:
    """The result; its error where it was refused or failed."""
    if result.error is not None and result.status in ("refused", "failed"):
        raise result.error
    return result


class Stream:
    """An open stream; `Display.stream()` makes one. A link that breaks is made again at the next frame."""

    def __init__(
        self, access: Access, layout: PixelLayout, policy: Policy, patience_s: float, begun: Callable[[], None]
    ) -> None:
        self._access = access
        self._layout = layout
        self._url = socket_url(access, policy)
        self._patience_s = patience_s
        self._begun = begun
        self._number = 0
        self._results = Results()
        self._news = threading.Condition()
        self._lost = 0
        self._open = ExitStack()
        self._link = self._connected()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Leave; the daemon drops what has not left for the board."""
        self._open.close()

    def send(self, heights_um: Heights) -> int:
        """Show a frame, in the place of what has not left of the one before; its number.

        LinkError where the daemon cannot be reached again. A daemon that restarted has a board that is not armed: the
        frame is then refused, and stays so until someone arms.
        """
        number, self._number = self._number, self._number + 1
        frame = to_bytes(number, by_pixel(heights_um, self._layout))
        self._begun()
        until_s = time.monotonic() + self._patience_s
        while True:
            try:
                self._link.send(frame)
                return number
            except ConnectionClosed:
                self._reconnect(until_s)

    def results(self) -> list[FrameResult]:
        """What the daemon said since the last call, in order."""
        with self._news:
            return self._results.drained()

    def wait(self, frame: int | None = None, timeout_s: float = ANSWER_TIMEOUT_S) -> FrameResult:
        """What became of a frame, the last one sent if not said; raises its error where it was refused or failed."""
        number = self._number - 1 if frame is None else frame
        until_s = time.monotonic() + timeout_s
        with self._news:
            while (found := self._results.final(number)) is None:
                if number < self._lost:
                    raise LinkError(f"the link broke before it was heard what became of frame {number}")
                if not self._news.wait(until_s - time.monotonic()):
                    raise LinkError(f"nothing was heard of frame {number} for {timeout_s:g} s")
        return raised(found)

    def _connected(self) -> ClientConnection:
        try:
            link = self._opened()
        except InvalidStatus as error:
            if error.response.status_code != 401 or not self._access.renewed():
                raise refusal(error) from None
            link = self._opened()
        except BROKEN as error:
            raise self._access.unreachable(error) from None
        threading.Thread(target=self._read, args=(link,), name="stream", daemon=True).start()
        return link

    def _opened(self) -> ClientConnection:
        self._open.close()
        link = connect(
            self._url,
            additional_headers=self._access.headers,
            sock=self._access.socket(),
            proxy=None,
            open_timeout=OPEN_TIMEOUT_S,
            compression=None,
        )
        return self._open.enter_context(link)

    def _reconnect(self, until_s: float) -> None:
        while True:
            try:
                self._link = self._connected()
                return
            except LinkError:
                if time.monotonic() >= until_s:
                    raise
                time.sleep(RETRY_S)

    def _read(self, link: ClientConnection) -> None:
        """Take answers in as they come: a caller that leaves too many unread is cut off."""
        try:
            for message in link:
                with self._news:
                    self._results.take_in(message)
                    self._news.notify_all()
        except ConnectionClosed:
            pass  # found out, and mended, by whoever sends
        finally:
            with self._news:
                self._lost = self._number
                self._news.notify_all()
