"""Common parts of both streams: the address, the buffer of results, and the errors of refused frames."""

from collections import deque
from typing import NamedTuple
from urllib.parse import urlencode

from optodrive.client.problems import build_error
from optodrive.core.errors import LinkError, NotReadyError, RefusedError
from optodrive.core.types.push_options import Policy
from optodrive.daemon.responses.messages import FrameResult

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


def build_stream_path(policy: Policy, standing: bool) -> str:
    """Build the path of the stream's WebSocket."""
    return f"/v1/stream?{urlencode({'policy': policy, 'standing': str(standing).lower()})}"


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
