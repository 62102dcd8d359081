"""The host's clock as the time of several boards, each of which keeps a clock of its own.

A line is fitted to the exchanges with each board (`clock_sync.py`), and each point is shifted by as much as its board
has drifted since the one before. Points leave at most `SEND_AHEAD_MAX_S` ahead, because the drift until then is a
guess. A plan starts only if the error of every clock is below the largest skew, which the limiter has counted; until
then exchanges repeat (`seek`), for `CLOCK_PATIENCE_S`, then the start is refused by name (decision 42).
"""

from collections.abc import Callable, Sequence
from functools import partial
from math import inf

from optodrive.core.clock import Clock
from optodrive.core.errors import LinkError, NotReadyError
from optodrive.link.protocol import messages as m
from optodrive.link.session.clock_sync import DRIFT_MAX, ClockFit
from optodrive.link.session.plan_job import PointTiming
from optodrive.link.session.session import BoardSession
from optodrive.link.session.staged_job import StagedJob

SEND_AHEAD_MAX_S = 0.3
"""Longest time for which points are sent ahead to several boards; meanwhile their clocks drift."""
CLOCK_PATIENCE_S = 3.0
"""Time for which a start waits until the boards' clocks are known well enough, then it is refused."""
CLOCK_SEEK_SHARE = 0.5
"""Clocks are compared more often while one may be further off than this share of what a start permits."""


class HostTime:
    """Conversion between the host's time and that of each board.

    skew_max_s: largest error of a board's clock with which a plan may start; tick_s: duration of a tick of all boards
    get_prefix: returns the prefix of messages about a board
    """

    def __init__(
        self, clock: Clock, tick_s: float, skew_max_s: float, get_prefix: Callable[[BoardSession], str]
    ) -> None:
        self._clock = clock
        self._tick_s = tick_s
        self._skew_max_s = skew_max_s
        self._get_prefix = get_prefix
        self._awaited_s = clock.now_s()

    def are_known(self, sessions: Sequence[BoardSession]) -> bool:
        """Return whether the time of each board is known as exactly as a start needs it."""
        return all(self._find_error_s(session) <= self._skew_max_s for session in sessions)

    @property
    def is_patience_over(self) -> bool:
        """Whether boards that are ready have waited so long for their clocks that a start is refused."""
        return self._waited_s > CLOCK_PATIENCE_S

    @property
    def _waited_s(self) -> float:
        return self._clock.now_s() - self._awaited_s

    def _find_error_s(self, session: BoardSession) -> float:
        fit = session.clock_sync.fit(self._clock.now_s())
        return inf if fit is None else fit.uncertainty_s

    def seek(self, sessions: Sequence[BoardSession], are_ready: bool) -> None:
        """Compare the clocks more often while they are not known well enough for the start of a plan.

        are_ready: whether the boards wait for nothing else
        """
        for session in sessions:
            # Before the limit is reached: one narrow exchange takes many tries on a busy computer.
            session.seeks_clock = self._find_error_s(session) > CLOCK_SEEK_SHARE * self._skew_max_s
        # The wait counts only while the clocks are all that is missing.
        if not are_ready or self.are_known(sessions):
            self._awaited_s = self._clock.now_s()

    def require_known(self, sessions: Sequence[BoardSession]) -> None:
        """Raise NotReadyError if the time of a board is not known as exactly as a start needs it."""
        for session in sessions:
            fit = self._fit(session)
            if fit.uncertainty_s > self._skew_max_s:
                raise NotReadyError(
                    f"{self._get_prefix(session)}after {self._waited_s:.1f} s of repeated exchanges its clock "
                    f"is known to {1e6 * fit.uncertainty_s:.0f} µs, "
                    f"limits.stage_skew_max_s permits {1e6 * self._skew_max_s:.0f} µs"
                )
            # Points are shifted by at most that rate (`RETIMING_RATE_MAX`): a faster drift would be followed too
            # slowly.
            if abs(fit.rate - 1.0) > DRIFT_MAX:
                raise NotReadyError(
                    f"{self._get_prefix(session)}its clock drifts by {1e6 * (fit.rate - 1.0):+.0f} ppm, "
                    f"at most {1e6 * DRIFT_MAX:.0f} ppm can be followed"
                )

    def _fit(self, session: BoardSession) -> ClockFit:
        fit = session.clock_sync.fit(self._clock.now_s())
        if fit is None:
            raise LinkError(f"{self._get_prefix(session)}its clock is not known")
        return fit

    def build_timing(self, session: BoardSession, zero_tick: int) -> PointTiming:
        """Return the timing of points whose zero is a tick of the host's time."""
        # A function and no number: each point is converted when it leaves, by what is known of the clock then.
        return PointTiming(zero_tick, partial(self._to_board_tick, session))

    def _to_board_tick(self, session: BoardSession, host_tick: int) -> float:
        return self._fit(session).to_board_s(host_tick * self._tick_s) / self._tick_s

    def convert_report(self, session: BoardSession, message: m.Executed) -> m.Executed:
        """Return a board's report with the host's time in place of its own."""
        fit = self._fit(session)
        records = tuple(
            (round(fit.to_host_s(tick * self._tick_s) / self._tick_s), ticks, duty)
            for tick, ticks, duty in message.records
        )
        return m.Executed(message.first_index, records)

    def find_first_sent_tick(self, job: StagedJob, sessions: Sequence[BoardSession]) -> float | None:
        """Return the tick of the host's time at which the first point of a job was sent, None before."""
        now_s = self._clock.now_s()
        fits = [session.clock_sync.fit(now_s) for session in sessions]
        pairs = ((fit, part.first_sent_tick) for fit, part in zip(fits, job.parts, strict=True))
        sent_s = [fit.to_host_s(tick * self._tick_s) for fit, tick in pairs if fit is not None and tick is not None]
        return min(sent_s) / self._tick_s if sent_s else None
