"""A stream of frames, of which the newest wins, with a blocking interface."""

from collections.abc import Callable
from typing import Self

from optodrive.client.async_stream import RESULT_TIMEOUT_S, AsyncStream, FrameCounts
from optodrive.client.endpoint import Endpoint
from optodrive.client.heights import HeightsLike
from optodrive.client.sockets import LoopThread
from optodrive.core.types.push_options import Policy, check_keywords
from optodrive.daemon.responses.messages import FrameResult
from optodrive.device.config import PixelLayout


@check_keywords
class Stream:
    """An open stream. `Display.stream()` builds one. A broken connection is restored at the next frame."""

    def __init__(
        self,
        endpoint: Endpoint,
        layout: PixelLayout,
        policy: Policy,
        standing: bool,
        reconnect_timeout_s: float,
        on_send: Callable[[], None],
    ) -> None:
        async def get_layout() -> PixelLayout:
            return layout

        self._stream = AsyncStream(endpoint, get_layout, policy, standing, reconnect_timeout_s, on_send)
        self._loop = LoopThread("stream")
        try:
            self._loop.run(self._stream.__aenter__())
        except BaseException:
            self._loop.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *details: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the stream. The daemon drops the pulses that are not yet committed to the board."""
        self._loop.run(self._stream.close())
        self._loop.close()

    def send(self, heights_um: HeightsLike) -> int:
        """Show a frame in place of the uncommitted rest of the previous one. Return its number.

        LinkError if the daemon does not answer or cannot be reached again. The board of a restarted daemon is not
        armed; frames are then refused until somebody arms it. NotReadyError after `close`.
        """
        return self._loop.run(self._stream.send(heights_um))

    def results(self) -> list[FrameResult]:
        """Return the results since the last call, in order.

        Of results that nobody reads the newest 1,000 are kept, about 500 frames; `counts` counts all.
        """
        return self._loop.run(self._stream.results())

    @property
    def counts(self) -> FrameCounts:
        """Number of frames shown and superseded so far. Every final result counts, also one that `results` drops."""
        return self._stream.counts

    def wait(self, frame: int | None = None, timeout_s: float = RESULT_TIMEOUT_S) -> FrameResult:
        """Wait for the final result of a frame, by default the last one sent. Raise its error if it failed."""
        return self._loop.run(self._stream.wait(frame, timeout_s))
