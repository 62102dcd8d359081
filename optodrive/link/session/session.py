"""Host session with one board: arming, lease, commands and streaming.

Theory of operation

Problem. A board that can emit stands at the end of a line that loses, damages and delays bytes, beside a host that may
stall or restart. The board protects itself (rules B1 to B17 of the protocol); the session must never undo that
protection, and must tell its owner the truth about the board. Handshake, clocks, reports of the board's state and
statistics stand in `board_link.py`, which gives nobody light.

Arming is an exchange with nonces of both sides (`arming.py`), two seconds with the indicator on, and belongs to one
epoch of the owner. It is *present* from the request until the board has left the state that it had reached, or until
`end_arming`.

Lease. The board closes the gate when its lease ends. It is renewed only while an arming is present, the board says that
it is in a state that needs it, and the owner permits (`renew_lease`): each is necessary, because a report may be old or
false. A board that needs a lease without a present arming gets ABORT, not a lease.

Points are streamed as the board's queue has room and, for streams, as they become due (`point_stream.py`). Commands and
points share one sequence, so that their order on the board is that of the calls; ABORT and HELLO stand outside it and
overtake everything.

Only `connect` blocks. The loop that owns the session calls `step` repeatedly; all state is that loop's. Decisions: 2,
5, 19, 26, 42.
"""

from collections.abc import Callable
from math import inf

from optodrive.core.clock import Clock
from optodrive.core.errors import NotReadyError
from optodrive.link.protocol import messages as m
from optodrive.link.protocol.quantisation import WirePoints
from optodrive.link.protocol.states import ARMED_STATES, IDLE_STATES, LEASED_STATES, BoardState
from optodrive.link.session.arming import RENEWAL_FRACTION, Arming, BoardRequirements, LeaseRenewal
from optodrive.link.session.board_link import BoardLink
from optodrive.link.session.board_view import get_fault_hint
from optodrive.link.session.plan_job import PlanJob, PointTiming
from optodrive.link.session.point_stream import PointDrain
from optodrive.link.transport.base import Transport

WAIT_MIN_S, WAIT_MAX_S = 0.001, 0.01
RETRANSMISSION_WAIT_S = BATCH_WAIT_S = 0.002
"""Shortest wait for a retransmission, and for further points to become due, so that frames hold several."""
REPORT_S = 0.005
"""Longest time from the begin or end of a job to the board's report of it, unless it is lost."""
SPLICE_LEAD_S = 0.005
"""Minimum time between a splice and the end of the points before it."""


class BoardSession(BoardLink):
    """Session with a board over a transport. Parameters are those of `BoardLink`.

    lease: schedule and statistics of the lease renewals
    on_executed: called with every report of executed points
    """

    def __init__(
        self,
        transport: Transport,
        clock: Clock,
        requirements: BoardRequirements,
        is_one_of_several: bool = False,
    ) -> None:
        super().__init__(transport, clock, requirements, is_one_of_several)
        self._arming = Arming()
        self._drain: PointDrain | None = None
        self._refusal: str | None = None
        self._handlers |= {m.Nak: self._on_nak, m.ArmChallenge: self._on_arm_challenge, m.Executed: self._on_executed}
        self.on_executed: Callable[[m.Executed], None] = lambda message: None
        self.lease = LeaseRenewal(requirements.lease_s)
        self.abort_confirmed = False
        """Whether the board has confirmed the last ABORT: gate off, queue dropped, not armed."""

    @property
    def has_arming(self) -> bool:
        """Whether the board was armed from here, or is being armed, and has not left the state that it had reached."""
        return self._arming.is_present

    @property
    def is_ready(self) -> bool:
        """Whether a job may start now."""
        return (
            self.board.state == BoardState.ARMED and not self._points and not self.is_draining and self.is_acknowledged
        )

    def _reset(self) -> None:
        self.end_arming()
        super()._reset()
        self._refusal = None

    # --- loop ---------------------------------------------------------------------------------------------------

    def step(self, wait_s: float, renew_lease: bool, stalled: str = "planner") -> None:
        """Run one loop iteration: send the due messages, wait at most wait_s for bytes and process them.

        The lease is renewed only while an arming from here is present. ABORT goes out when the board has left it, and
        when it is armed without one.

        renew_lease: whether the processes that the running plan needs are alive
        stalled: process to name if the lease expires because it was not renewed
        Raise LinkError if the link failed or the board does not answer.
        """
        now_s = self._clock.now_s()
        # First: a stall of this loop is measured from its last call, before this step's own work.
        self._watch.on_loop(now_s, "" if renew_lease else stalled, self._count_errors())
        # The lease leaves before points: what follows in this step may fill the line for 10 ms.
        if not self._may_have_lease:
            self.lease.pause()
        elif renew_lease:
            self._send_lease(now_s)
        self._request_due(now_s)
        # Points before the exchange, so that they leave in the same write as the lease.
        self._stream_points()
        self._exchange(wait_s)
        # After the reports of this step. The report of a loss may be false, so the end is sent in any case: dark boards
        # ignore it.
        if self._arming.is_lost or self._is_armed_by_itself:
            self.abort()
        self._require_answers(now_s)

    @property
    def _may_have_lease(self) -> bool:
        return self.has_arming and self.board.state in LEASED_STATES

    @property
    def _is_armed_by_itself(self) -> bool:
        """Whether the board needs a lease although nobody has armed it, or its arming has ended."""
        # Acknowledged: before that, the state may be from before the DISARM that is on its way.
        return not self.has_arming and self.is_acknowledged and self.board.state in LEASED_STATES

    def _send_lease(self, now_s: float) -> None:
        renewal = self.lease.renew(now_s)
        if renewal is not None:
            self._connection.send(renewal)

    def _on_nak(self, message: m.Nak, now_s: float) -> None:
        reason = m.NAK_REASONS[message.reason]
        if reason == "STATE" and self._points.may_have_ended:
            return  # the points are late, see describe_lateness()
        if reason not in m.NOT_CONSUMED and self._refusal is None:  # the first refusal causes the following ones
            self._refusal = reason

    def _on_event(self, message: m.Event, now_s: float) -> None:
        super()._on_event(message, now_s)
        # Peer None: HELLO is out and not answered, so this EVENT is of the session that ABORT ends, and no later one.
        self.abort_confirmed |= self._connection.peer is None and self.last_event_reason == "abort"

    def _follow_state(self) -> None:
        self._arming.follow(self.board.state)
        # A session begins after the ABORT: what its messages report is the state after it.
        self.abort_confirmed |= self._connection.peer is not None and self.board.state in IDLE_STATES

    def _on_clock_reply(self, message: m.ClockReply, now_s: float) -> None:
        super()._on_clock_reply(message, now_s)
        if self._drain is not None:
            self._drain.on_clock_reply(message.host_t, self._count_errors().host_bad_frames)

    def _on_arm_challenge(self, message: m.ArmChallenge, now_s: float) -> None:
        confirmation = self._arming.confirm(message)
        if confirmation is not None:
            self._connection.send(confirmation)

    def _on_executed(self, message: m.Executed, now_s: float) -> None:
        # A report frees queue space at once. With a small queue, waiting for ACK or STATUS would cause an underrun.
        self.board.done_index = max(self.board.done_index, message.first_index + len(message.records))
        self._points.record_executed(message)
        self.on_executed(message)
        if self._drain is not None:
            self._drain.on_report()

    # --- commands -----------------------------------------------------------------------------------------------

    def arm(self) -> None:
        """Request arming. The board shows its indicator and is ARMED two seconds after the confirmation."""
        self.require_disarmed()
        self._refusal = None
        # Gate 2 of the epochs: points that were handed over for an earlier arming must not be lit in this one.
        self._drop_held_points()
        self._connection.send(self._arming.begin())

    def require_disarmed(self, which: str = "") -> None:
        """Raise NotReadyError unless the board can be armed. which: prefix of the message."""
        if self.board.state == BoardState.FAULT:
            hint = get_fault_hint(self.board.fault)
            raise NotReadyError(f"{which}the board is in FAULT {self.board.fault}: {hint}, and arm again")
        if self.board.state != BoardState.DISARMED:
            raise NotReadyError(f"{which}the board is {self.board.state}; only a DISARMED board can be armed")
        if self.has_arming:
            raise NotReadyError(f"{which}the board is being armed already")

    def disarm(self) -> None:
        """Disarm the board, or acknowledge its fault in FAULT."""
        self._refusal = None
        self.end_arming()
        # One verb for both: the caller wants DISARMED, and the board refuses while a fault's cause persists.
        self._connection.send(m.ClearFault() if self.board.state == BoardState.FAULT else m.Disarm())

    def abort(self) -> None:
        """Turn the gate off, drop the queue and disarm, before all other queued messages."""
        self._refusal = None
        self.end_arming()
        self.abort_confirmed = False
        # ABORT, then HELLO: both stand outside the sequence and overtake it. HELLO makes all that is in flight void.
        self._connection.abort()
        self._send_hello()

    def end_arming(self) -> None:
        """End the arming: neither lease nor confirmation, nor points handed over so far. The next one drops them."""
        self._arming.end()
        self._drain = None

    def _drop_held_points(self) -> None:
        self._points.clear()

    def flush(self) -> None:
        """Turn the gate off and drop the queue. The board stays armed."""
        self._points.clear()
        self._connection.send(m.Flush())

    def drain(self) -> None:
        """Turn the gate off, drop the queue and collect the last reports. The board stays armed."""
        # Jobs stay, unlike in flush(): their last reports tell the planner what was lit.
        self._points.drop_unsent()
        self._connection.send(m.Flush())
        self._drain = PointDrain()

    @property
    def is_draining(self) -> bool:
        """Whether reports of points that were sent before drain() may still arrive."""
        return self._drain is not None

    def _step_drain(self, drain: PointDrain) -> None:
        # FLUSH must have arrived: reports before it would say nothing about the end.
        if not self.is_acknowledged:
            return
        missing, now_s = self._points.first_unreported, self._clock.now_s()
        # The board may never report some points, those that FLUSH dropped: then only quiet exchanges tell the end.
        if missing is None or drain.is_complete:
            self._points.clear()
            self._drain = None
        elif drain.is_due(now_s):
            self._connection.send(m.GetExecuted(first_index=missing))
            drain.begin_exchange(self._request_clock(), now_s, self._count_errors().host_bad_frames)

    def pop_refusal(self) -> str | None:
        """Return and clear the reason for which the board refused the last command."""
        refusal, self._refusal = self._refusal, None
        return refusal

    # --- streaming ----------------------------------------------------------------------------------------------

    def begin(
        self, points: WirePoints, start_s: float, send_ahead_s: float = inf, timing: PointTiming | None = None
    ) -> PlanJob:
        """Start to stream a plan whose zero is board time start_s.

        send_ahead_s: maximum time from sending a point to its start; timing: as for `PlanJob`
        """
        start_tick = max(1, round(start_s / self.scale.tick_s))
        return self._points.begin(points, start_tick, send_ahead_s / self.scale.tick_s, timing)

    def can_splice(self, kept_points: int) -> bool:
        """Return whether it is early enough to continue without a pause after `kept_points` points of the last job."""
        return self._points.can_splice(kept_points, (self.board_s() + SPLICE_LEAD_S) / self.scale.tick_s)

    def splice(
        self,
        points: WirePoints,
        kept_points: int,
        send_ahead_s: float,
        timing: PointTiming | None = None,
        holds_first: bool = False,
    ) -> PlanJob | None:
        """Truncate the last job to `kept_points` points and continue with `points` without a pause.

        Return None if it is too late for that. timing, holds_first: as for `PlanJob`
        """
        if not self.can_splice(kept_points):
            return None
        return self._points.splice(points, kept_points, send_ahead_s / self.scale.tick_s, timing, holds_first)

    def can_extend(self, job: PlanJob) -> bool:
        """Return whether it is early enough to append points to a job, which must be the last one, without a pause."""
        return self._points.can_extend(job, (self.board_s() + SPLICE_LEAD_S) / self.scale.tick_s)

    def follow_extended(self) -> None:
        """Count the points that were appended to the last job."""
        self._points.follow_extended()

    @property
    def last_job(self) -> PlanJob | None:
        """The last job of those that are not finished."""
        return self._points.last

    def describe_lateness(self) -> str:
        """Return why the armed board would execute its next point late, '' if it would not."""
        if not self.has_arming or self.board.state not in ARMED_STATES or self.is_draining:
            return ""
        ticks = [(self._points.find_start_tick(), 0.0)]
        # A line that loses bytes: what was sent has not arrived, and the board has not begun, has ended or waits.
        if self.board.state != BoardState.RUNNING:
            ticks.append((self._points.find_sent_tick(self.board.done_index), REPORT_S))
        now_s, tick_s = self.board_s(), self.scale.tick_s
        late_s = max((now_s - tick * tick_s - wait_s for tick, wait_s in ticks if tick is not None), default=0.0)
        return f"light would have been {1e3 * late_s:.3g} ms late" if late_s > 0.0 else ""

    def can_truncate(self, kept_points: int) -> bool:
        """Return whether the last job can be truncated to `kept_points` points."""
        return not self.is_draining and self._points.can_truncate(kept_points)

    def truncate(self, kept_points: int) -> bool:
        """Truncate the last job to `kept_points` points. Return False, unchanged, if more were sent."""
        return not self.is_draining and self._points.truncate(kept_points)

    def _stream_points(self) -> None:
        if self._drain is not None:
            self._step_drain(self._drain)
            return
        # An ended arming keeps its points until the next one drops them, so that their reports still find their job.
        if not self._points or not self.has_arming:
            return
        if self.board.state in ARMED_STATES:  # else the board has ended the job: only collect its reports
            now_tick = self.board_s() / self.scale.tick_s
            self._points.send(self._connection, self.board.done_index, self._queue_points, now_tick)
        self._points.request_missing_reports(self._connection, self.board.done_index, self._clock.now_s())
        self._points.drop_finished(self.board.state == BoardState.ARMED)

    @property
    def has_points(self) -> bool:
        """Whether points were handed over whose execution is not yet reported."""
        return bool(self._points)

    def compute_wait_s(self) -> float:
        """Return the longest time for which the next step may wait if no bytes arrive, s."""
        # ABORT or HELLO: no wait at all.
        if self._connection.has_unsequenced:
            return 0.0
        wait_s = WAIT_MAX_S
        if self.board.state in LEASED_STATES:
            # Half an interval, so that a renewal is late by half at most.
            wait_s = min(wait_s, 0.5 * RENEWAL_FRACTION * self._requirements.lease_s)
        if self._connection.outstanding or self.is_draining:
            wait_s = min(wait_s, RETRANSMISSION_WAIT_S)
        if self.has_arming and self.board.state in ARMED_STATES:
            due_tick = self._points.find_due_tick()
            if due_tick is not None:
                wait_s = min(wait_s, max(due_tick * self.scale.tick_s - self.board_s(), BATCH_WAIT_S))
        return max(wait_s, WAIT_MIN_S)
