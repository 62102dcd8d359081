"""Collection of the last reports after a FLUSH, which tell the executed points from those that the board dropped."""

from math import inf

QUIET_EXCHANGES = 2
"""Exchanges in succession without a report, after which there is none that the host does not have."""
RETRY_S = 0.05


class PointDrain:
    """Requests for reports until the board has no more.

    A CLOCK exchange follows each request. The board answers in order: its reply arrives after the report, unless there
    is none, or it was lost. An exchange in which a damaged frame arrived does not count, so that request or report
    would have to be lost without a trace, twice in succession.
    """

    def __init__(self) -> None:
        self._stamp: int | None = None
        self._requested_s = -inf
        self._quiet_exchanges = 0
        self._has_report = False
        self._bad_frames = 0

    @property
    def is_complete(self) -> bool:
        """Whether the board has no more reports."""
        return self._quiet_exchanges >= QUIET_EXCHANGES

    def is_due(self, now_s: float) -> bool:
        """Return whether to request reports now."""
        return self._stamp is None or now_s - self._requested_s > RETRY_S

    def begin_exchange(self, stamp: int, now_s: float, bad_frames: int) -> None:
        """Record a request for reports and the stamp of the CLOCK behind it. bad_frames: damaged frames so far."""
        self._stamp, self._requested_s, self._has_report, self._bad_frames = stamp, now_s, False, bad_frames

    def on_report(self) -> None:
        """Record that a report has arrived."""
        self._has_report = True

    def on_clock_reply(self, stamp: int, bad_frames: int) -> None:
        """Record the end of an exchange. bad_frames: damaged frames so far."""
        if stamp == self._stamp:
            self._stamp = None
            is_quiet = not self._has_report and bad_frames == self._bad_frames
            self._quiet_exchanges = self._quiet_exchanges + 1 if is_quiet else 0
