"""Stream of points to the board: consecutive jobs, of which a newer one may truncate and follow the last.

Sent points are final. Points not yet sent may be replaced by a newer plan without a pause.

END leaves with the last point, a lead before the light ends, so that a stall of the host is no underrun. What follows
after that moves the end: of several ENDs of a running job the board obeys the last, so each DATA has its own. If the
host stalls until the board has ended the job at the former END, it is armed with points in its queue, which are late,
as after an underrun: the owner drops them (`BoardSession.describe_lateness`).

After a FLUSH the last reports are collected, which tell the executed points from those that the board dropped.
"""

from collections import deque
from math import inf

from optodrive.link.protocol import messages as m
from optodrive.link.protocol.connection import HostConnection
from optodrive.link.protocol.quantisation import WirePoints
from optodrive.link.session.plan_job import PlanJob, PointTiming

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
            # A damaged frame may have been the report that was asked for.
            is_quiet = not self._has_report and bad_frames == self._bad_frames
            self._quiet_exchanges = self._quiet_exchanges + 1 if is_quiet else 0


MISSING_REPORT_RETRY_S = 0.1
WATERMARK_POINTS = 48


class PointStream:
    """Jobs in order of execution.

    The board treats consecutive jobs as one, from START to END. Point indices count over the session.
    """

    def __init__(self) -> None:
        self._jobs: deque[PlanJob] = deque()
        self._number = 0
        self._next_index = 0
        self._sent_index = 0
        self._started = self._ended = self._end_was_moved = False
        self._reports_requested_s = 0.0

    def __bool__(self) -> bool:
        return bool(self._jobs)

    def reset_indices(self) -> None:
        """Restart the point indices at 0 for a new session."""
        self._next_index = self._sent_index = 0

    def begin(
        self,
        points: WirePoints,
        start_tick: int,
        send_ahead_ticks: float = inf,
        timing: PointTiming | None = None,
    ) -> PlanJob:
        """Start a job whose zero is board tick start_tick.

        send_ahead_ticks: maximum time from sending a point to its start; timing: as for `PlanJob`
        """
        self._number += 1
        # START leaves with the first DATA, not here: it names a point that the board must have.
        self._started = self._ended = self._end_was_moved = False
        return self._append(points, start_tick, send_ahead_ticks, timing, holds_first=False)

    @property
    def sent_index(self) -> int:
        """Index after the last point that was sent in this session."""
        return self._sent_index

    def find_contradiction(self, message: m.Executed) -> str:
        """Return how a report contradicts the points that were sent, or '' if it does not."""
        return next((text for job in self._jobs if (text := job.find_contradiction(message))), "")

    @property
    def last(self) -> PlanJob | None:
        """The last job, None without any."""
        return self._jobs[-1] if self._jobs else None

    def can_truncate(self, kept_points: int) -> bool:
        """Return whether the last job can be truncated to `kept_points` points: no more were sent."""
        return bool(self._jobs) and self._jobs[-1].can_truncate(kept_points)

    def can_splice(self, kept_points: int, min_end_tick: float) -> bool:
        """Return whether other points may follow the first `kept_points` of the last job without a pause.

        They may not if more were sent, or if the kept points end before min_end_tick, where the board might run out of
        points. Several boards end each job together: nothing follows the END of one.
        """
        if not self._started or not self.can_truncate(kept_points):
            return False
        # The END of one board cannot be moved without those of the others, which may have ended already.
        if self._ended and self._jobs[-1].follows_host:
            return False
        # Later than now by SPLICE_LEAD_S, or the board could run empty before the first new point arrives.
        return self._jobs[-1].end_tick_after(kept_points) >= min_end_tick

    def splice(
        self,
        points: WirePoints,
        kept_points: int,
        send_ahead_ticks: float,
        timing: PointTiming | None = None,
        holds_first: bool = False,
    ) -> PlanJob:
        """Truncate the last job to `kept_points` points and append others without a pause, if can_splice().

        timing, holds_first: as for `PlanJob`
        """
        self.truncate(kept_points)
        return self._append(points, self._jobs[-1].end_tick_after(kept_points), send_ahead_ticks, timing, holds_first)

    def can_extend(self, job: PlanJob, min_end_tick: float) -> bool:
        """Return whether other points may follow those of a whole job without a pause. min_end_tick: as above."""
        is_last = self.last is job and not job.is_truncated
        return is_last and self.can_splice(job.end_index - job.first_index, min_end_tick)

    def follow_extended(self) -> None:
        """Count the points that were appended to the last job."""
        self._next_index = self._jobs[-1].end_index

    def truncate(self, kept_points: int) -> bool:
        """Truncate the last job to `kept_points` points. Return False, unchanged, if more were sent."""
        if not self.can_truncate(kept_points):
            return False
        self._jobs[-1].truncate(kept_points)
        self._next_index = self._jobs[-1].end_index
        return True

    def _append(
        self,
        points: WirePoints,
        start_tick: int,
        send_ahead_ticks: float,
        timing: PointTiming | None,
        holds_first: bool,
    ) -> PlanJob:
        job = PlanJob(self._number, points, self._next_index, start_tick, send_ahead_ticks, timing, holds_first)
        self._next_index = job.end_index
        self._jobs.append(job)
        return job

    def clear(self) -> None:
        """Drop all points not yet sent, and all jobs. The job objects keep their reports."""
        # Indices of points that never left are used again: the board expects them without a gap.
        self._next_index = self._sent_index
        self._jobs.clear()

    def drop_unsent(self) -> None:
        """Drop all points not yet sent. The jobs stay, for the reports of those that were sent."""
        for job in self._jobs:
            # Never shorter than what was sent: those points may have been lit.
            job.truncate(job.next_to_send - job.first_index)
        self._next_index = self._sent_index

    @property
    def first_unreported(self) -> int | None:
        """First index not yet reported, None if all are."""
        return next((job.first_unreported for job in self._jobs if job.first_unreported is not None), None)

    def record_executed(self, message: m.Executed) -> None:
        """Record the board's report of executed points."""
        for job in self._jobs:
            job.record_executed(message)

    @property
    def may_have_ended(self) -> bool:
        """Whether the board may have ended the job before it got an END that moves the end. It refuses that one."""
        return self._end_was_moved

    def send(self, link: HostConnection, done_index: int, queue_points: int, now_tick: float) -> None:
        """Send the points that are due and that the board has room for, START and END."""
        for job in self._jobs:
            while link.outstanding < link.window:
                # What was sent and not yet done occupies the queue, wherever it is on the line.
                free_points = queue_points - (job.next_to_send - max(self._jobs[0].first_index, done_index))
                count = min(m.POINTS_MAX, free_points, job.count_sendable(now_tick))
                if count <= 0:
                    break
                self._send_points(link, job, count, now_tick)
            # In order: no point of a later job before the last one of this.
            if not job.is_fully_sent:
                return
        if self._jobs and not self._ended and link.outstanding < link.window:
            self._send_end(link)

    def _send_end(self, link: HostConnection) -> None:
        self._ended = True
        link.send(m.End(self._number, self._sent_index))

    def find_start_tick(self) -> int | None:
        """Return the board tick at which the next unsent point begins, None if all were sent."""
        return next((job.find_start_tick() for job in self._jobs if not job.is_fully_sent), None)

    def find_sent_tick(self, done_index: int) -> int | None:
        """Return the board tick at which the next point behind done_index begins, None unless it was sent."""
        for job in self._jobs:
            index = max(done_index, job.first_index)
            if index < job.next_to_send:
                return job.end_tick_after(index - job.first_index)
        return None

    def find_due_tick(self) -> float | None:
        """Return the board tick from which the next point may be sent, None if no point waits for its time."""
        for job in self._jobs:
            if not job.is_fully_sent:
                return job.next_due_tick
        return None

    def _send_points(self, link: HostConnection, job: PlanJob, count: int, now_tick: float) -> None:
        watermark = min(WATERMARK_POINTS, job.count_sendable(now_tick))
        link.send(m.Data(job.next_to_send, job.take_payload(count, now_tick)))
        self._sent_index = job.next_to_send
        if not self._started:
            # After the first DATA, so that START finds a point; the watermark never exceeds what is about to leave.
            link.send(m.Start(self._number, job.first_index, job.start_tick, watermark))
            self._started = True
        elif self._ended:
            self._send_end(link)
            self._end_was_moved = True

    def request_missing_reports(self, link: HostConnection, done_index: int, now_s: float) -> None:
        """Request lost reports again if the board has executed more points than it reported."""
        missing = self.first_unreported
        if missing is None or missing >= done_index or now_s - self._reports_requested_s < MISSING_REPORT_RETRY_S:
            return
        self._reports_requested_s = now_s
        link.send(m.GetExecuted(first_index=missing))

    def drop_finished(self, armed: bool) -> None:
        """Drop completely reported jobs, the last one only after the board has ended it."""
        # The last job stays until the board is ARMED again: a newer plan may still be spliced behind it.
        while self._jobs and self._jobs[0].is_finished and (len(self._jobs) > 1 or (self._ended and armed)):
            self._jobs.popleft()
