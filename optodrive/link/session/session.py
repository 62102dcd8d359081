"""Host session with one board: handshake, limits, clock, arming, lease, streaming and faults.

Theory of operation

Problem. A board that can emit stands at the end of a line that loses, damages and delays bytes, beside a host that may
stall or restart. The board protects itself (rules B1 to B15 of the protocol); the session must never undo that
protection, and must tell its owner the truth about the board.

Handshake. HELLO with a nonce begins a session number; bytes of an earlier one are discarded. The board states its
limits, the session refuses a board that does not meet the configuration, tightens the limits to it, and exchanges
clocks a few times. Only then do commands go out, and the tightened limits before all others. After a reconnect or ABORT
all of this is done again: the board is DISARMED, and the session never arms on its own.

Arming is an exchange with nonces of both sides (`arming.py`), two seconds with the indicator on, and belongs to one
epoch of the owner. It is *present* from the request until the board has left the state that it had reached, or until
`end_arming`.

Lease. The board closes the gate when its lease ends. It is renewed only while an arming is present, the board says that
it is in a state that needs it, and the owner permits (`renew_lease`): each is necessary, because a report may be old or
false. A board that needs a lease without a present arming gets ABORT, not a lease.

Points are streamed as the board's queue has room and, for streams, as they become due (`point_stream.py`). Commands and
points share one sequence, so that their order on the board is that of the calls; ABORT and HELLO stand outside it and
overtake everything.

Truth. State, position and errors are what the board reports (`board_view.py`), with the instant of the last message:
silence for `SILENCE_TIMEOUT_S` ends the session, and for a lease where other boards' light depends on it.
`link_watch.py` keeps what is needed to name the likely cause afterwards (decision 19).

Only `connect` blocks. The loop that owns the session calls `step` repeatedly; all state is that loop's. Decisions: 2,
5, 19, 26, 42.
"""

import secrets
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from math import inf
from typing import Any

from optodrive.core.clock import Clock
from optodrive.core.errors import InputError, LinkError, NotReadyError
from optodrive.link.protocol import messages as m
from optodrive.link.protocol.connection import HostConnection
from optodrive.link.protocol.quantisation import WirePoints, WireScale
from optodrive.link.protocol.states import ARMED_STATES, IDLE_STATES, LEASED_STATES, BoardState
from optodrive.link.session.arming import Arming
from optodrive.link.session.board_requirements import BoardRequirements
from optodrive.link.session.board_view import BoardView
from optodrive.link.session.clock_sync import CLOCK_INTERVAL_S, ClockSync
from optodrive.link.session.fault_hints import get_fault_hint
from optodrive.link.session.lease_renewal import RENEWAL_FRACTION, LeaseRenewal
from optodrive.link.session.link_watch import BOARD_COUNTER_MODULUS, LinkCause, LinkErrorCounts, LinkWatch
from optodrive.link.session.plan_job import PlanJob, PointTiming
from optodrive.link.session.point_drain import PointDrain
from optodrive.link.session.point_stream import PointStream
from optodrive.link.session.report_check import FalseReportError, ReportCheck
from optodrive.link.transport.base import Transport

HELLO_RETRY_S = 0.25
CONNECT_TIMEOUT_S = 2.5
HANDSHAKE_INTERVAL_S = 0.02
"""Interval between two requests of the handshake; a board that answers only some of them is not polled faster."""
STATUS_INTERVAL_S = 0.2
STAGE_CLOCK_INTERVAL_S = 0.25
CLOCK_SEEK_INTERVAL_S = 0.02
CLOCK_INITIAL_SAMPLES = 8
SILENCE_TIMEOUT_S = 2.0
"""The link counts as lost after this time without a message from the board."""
FUTILE_TRANSMISSIONS_MAX = 40
"""The link counts as lost after this number of retransmissions in succession without an acknowledgement.

On a line that loses a third of all frames in either direction, that happens once in 10^10 times.
"""
WAIT_MIN_S, WAIT_MAX_S = 0.001, 0.01
RETRANSMISSION_WAIT_S = BATCH_WAIT_S = 0.002
"""Shortest wait for a retransmission, and for further points to become due, so that frames hold several."""
SPLICE_LEAD_S = 0.005
"""Minimum time between a splice and the end of the points before it."""


class BoardSession:
    """Session with a board over a transport.

    faults: number of times that the board reported each fault
    lease: schedule and statistics of the lease renewals
    board: latest reported state of the board
    on_executed: called with every report of executed points
    seeks_clock: whether the clocks are compared more often, because that of the board is not known well enough
    is_one_of_several: whether other boards share its display. It is then asked often: for its clock, because all keep
    the host's time, and for its status, because its silence must end the light of the others within a lease.
    """

    def __init__(
        self,
        transport: Transport,
        clock: Clock,
        requirements: BoardRequirements,
        is_one_of_several: bool = False,
    ) -> None:
        self._transport = transport
        self._clock = clock
        self._requirements = requirements
        self._connection = HostConnection()
        self._is_one_of_several = is_one_of_several
        self._clock_interval_s = STAGE_CLOCK_INTERVAL_S if is_one_of_several else CLOCK_INTERVAL_S
        self._status_interval_s = RENEWAL_FRACTION * requirements.lease_s if is_one_of_several else STATUS_INTERVAL_S
        self._clock_sync = self._build_clock_sync()
        self._points = PointStream()
        self._report_check = self._build_report_check()
        self._arming = Arming()
        self._drain: PointDrain | None = None
        self.on_executed: Callable[[m.Executed], None] = lambda message: None
        self._hello_sent_s = 0.0
        self._refusal: str | None = None
        self._status_requested_s = self._clock_requested_s = self._last_received_s = 0.0
        self._queue_points = self._reset_code = 0
        self.faults: Counter[str] = Counter()
        self.lease = LeaseRenewal(requirements.lease_s)
        self._watch = LinkWatch(transport.name, requirements.lease_s)
        self.board = BoardView()
        self.connected = self.seeks_clock = False
        self.last_event_reason = ""
        self.abort_confirmed = False
        """Whether the board has confirmed the last ABORT: gate off, queue dropped, not armed."""

    @property
    def port(self) -> str:
        """Name of the transport."""
        return self._transport.name

    @property
    def lease_s(self) -> float:
        """Time after the last lease until the board closes the gate, s."""
        return self._requirements.lease_s

    @property
    def scale(self) -> WireScale:
        """Scale factors between SI units and this board's integers."""
        return self._requirements.scale

    def _build_clock_sync(self) -> ClockSync:
        return ClockSync(self._clock_interval_s)

    def _build_report_check(self) -> ReportCheck:
        return ReportCheck(self._clock_sync, self._points, self.scale.tick_s)

    @property
    def clock_sync(self) -> ClockSync:
        """Comparison of the board's clock with the host's."""
        return self._clock_sync

    def board_s(self) -> float:
        """Return the present board time, s."""
        return self._clock_sync.board_s(self._clock.now_s())

    @property
    def clock_sample(self) -> tuple[float, float] | None:
        """Host time and board time of the exchange that board_s() uses, s, None before the first."""
        return self._clock_sync.best_sample

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

    @property
    def is_acknowledged(self) -> bool:
        """Whether the board has answered HELLO and acknowledged everything sent."""
        return self._connection.peer is not None and self._connection.outstanding == 0

    # --- connecting ---------------------------------------------------------------------------------------------

    def connect(self) -> None:
        """Open the link and perform the handshake.

        Raise LinkError without an answer, InputError if the board does not meet the requirements. After a failure the
        previous clock synchronisation stays valid, because thermal states refer to it.
        """
        try:
            self._transport.open()
        except (LinkError, InputError):
            self.on_connect_failed()
            raise
        for _ in self.connect_step_by_step(block=True):
            pass

    def connect_step_by_step(self, block: bool = False) -> Iterator[float]:
        """Perform the handshake over the open port, one exchange per step, and yield the longest wait before the next.

        block: whether a step waits for bytes itself. Raise errors as `connect` does.
        """
        previous_sync = self._clock_sync
        try:
            for wait_s in self._handshake():
                self._exchange(wait_s if block else 0.0)
                yield wait_s
        except (LinkError, InputError):
            self._clock_sync = previous_sync
            self.on_connect_failed()
            raise
        self._watch.on_reconnected(self._clock.now_s(), self._reset_code, self.board_s(), self._count_errors())
        self.connected = True

    def on_connect_failed(self) -> None:
        """Close the port, which could not be opened or whose board did not answer, and update the likely cause."""
        self._transport.close()
        self._watch.on_reconnect_failed(self._clock.now_s())

    def _handshake(self) -> Iterator[float]:
        """Send the messages due in each step of the handshake, and yield how long to wait for bytes."""
        self.end_arming()
        self._reset()
        self._send_hello()
        deadline_s = self._clock.now_s() + CONNECT_TIMEOUT_S
        while self._connection.peer is None:
            self._retry_hello()
            yield HANDSHAKE_INTERVAL_S
            if self._clock.now_s() > deadline_s:
                raise LinkError(
                    f"{self.port} is open, but no board answers: check its power, the port and the baud rate"
                )
        while not (self.is_acknowledged and self._clock_sync.is_synchronised and self.board.state != "UNKNOWN"):
            if self._clock.now_s() - self._clock_requested_s >= HANDSHAKE_INTERVAL_S:
                self._request_clock()
                self._request_status()
            yield HANDSHAKE_INTERVAL_S
            if self._clock.now_s() > deadline_s:
                raise LinkError(f"{self.port}: the board answers HELLO but nothing else; {self._describe_errors()}")
        for _ in range(CLOCK_INITIAL_SAMPLES):
            self._request_clock()
            yield 0.005

    def _send_hello(self) -> None:
        """Begin a session. The board ends its previous activity and goes to DISARMED."""
        self._hello_sent_s = self._clock.now_s()
        self._connection.send_hello(secrets.randbits(32))

    def _retry_hello(self) -> None:
        if self._connection.peer is None and self._clock.now_s() - self._hello_sent_s > HELLO_RETRY_S:
            self._send_hello()

    def _on_hello_reply(self, peer: m.HelloReply, now_s: float) -> None:
        self._requirements.check_board(peer)
        self.board.uid, self.board.firmware = peer.uid.hex(), peer.firmware
        self._queue_points, self._reset_code = peer.queue_points, peer.reset_cause
        self._points.reset_indices()
        self._connection.send(
            self._requirements.limits, at_front=True
        )  # before commands already queued for this session
        self._request_status()

    def _reset(self) -> None:
        self._connection = HostConnection(self._requirements.rto_s)
        self._clock_sync = self._build_clock_sync()
        self._report_check = self._build_report_check()
        self._refusal = None
        self.board = BoardView()
        self._last_received_s = self._clock.now_s()
        self._clock_requested_s = -inf
        self._watch.on_opened()

    def disconnect(self) -> None:
        """Close the link. It may be opened again."""
        self.connected = False
        self._transport.close()

    def on_lost(self, error: Exception) -> str:
        """Send ABORT if possible, close the link after an error, and return its message, with the likely cause.

        A report that cannot be is itself the cause.
        """
        message, now_s = str(error), self._clock.now_s()
        if isinstance(error, FalseReportError):
            self._watch.on_false_report(message, now_s)
        elif isinstance(error, LinkError):
            cause = self._watch.on_lost(
                now_s, self._last_received_s, silent=now_s - self._last_received_s > self._silence_max_s
            )
            message = f"{message}; likely cause: {cause.message}"
        if self.connected:
            self._send_abort()
        self.disconnect()
        return message

    def close(self) -> None:
        """Send ABORT if possible and close the link permanently."""
        if self.connected:
            self._send_abort()
        self.connected = False
        self._transport.release()

    def _send_abort(self) -> None:
        with suppress(LinkError):  # without ABORT the board turns the gate off when its lease expires
            self._connection.abort()
            self._transport.write(
                self._connection.bytes_to_send(self._clock.now_s(), self._requirements.max_in_flight_bytes)
            )

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
        self._watch.on_loop(now_s, "" if renew_lease else stalled, self._count_errors())
        if not self._may_have_lease:
            self.lease.pause()
        elif renew_lease:
            self._send_lease(now_s)
        if now_s - self._status_requested_s >= self._status_interval_s:
            self._request_status()
        clock_interval_s = CLOCK_SEEK_INTERVAL_S if self.seeks_clock else self._clock_interval_s
        if now_s - self._clock_requested_s >= clock_interval_s:
            self._request_clock()
        self._retry_hello()
        self._stream_points()
        self._exchange(wait_s)
        if self._arming.is_lost or self._is_armed_by_itself:
            self.abort()
        if self._connection.futile_transmissions > FUTILE_TRANSMISSIONS_MAX:
            raise LinkError(f"{self.port}: the board acknowledges nothing; {self._describe_errors()}")
        silence_max_s = self._silence_max_s
        if now_s - self._last_received_s > silence_max_s:
            raise LinkError(f"{self.port}: the board sent nothing for {silence_max_s:g} s; {self._describe_errors()}")

    @property
    def _may_have_lease(self) -> bool:
        return self.has_arming and self.board.state in LEASED_STATES

    @property
    def _is_armed_by_itself(self) -> bool:
        """Whether the board needs a lease although nobody has armed it, or its arming has ended."""
        return not self.has_arming and self.is_acknowledged and self.board.state in LEASED_STATES

    @property
    def _silence_max_s(self) -> float:
        is_short = self._is_one_of_several and self.board.state in LEASED_STATES
        return self._requirements.lease_s if is_short else SILENCE_TIMEOUT_S

    def _send_lease(self, now_s: float) -> None:
        renewal = self.lease.renew(now_s)
        if renewal is not None:
            self._connection.send(renewal)

    def _exchange(self, wait_s: float) -> None:
        out = self._connection.bytes_to_send(self._clock.now_s(), self._requirements.max_in_flight_bytes)
        if out:
            self._transport.write(out)
        data = self._transport.read(wait_s)
        if data:
            now_s = self._clock.now_s()
            for message in self._connection.receive_bytes(data, now_s):
                self._last_received_s = now_s
                if self._report_check.accept(message, now_s):
                    self._on_message(message, now_s)

    def _request_status(self) -> None:
        self._status_requested_s = self._clock.now_s()
        self._connection.send(m.Get())

    def _request_clock(self) -> int:
        self._clock_requested_s = self._clock.now_s()
        stamp = self._clock_sync.start_exchange(self._clock_requested_s)
        self._connection.send(m.ClockRequest(host_t=stamp))
        return stamp

    def _on_message(self, message: m.Message, now_s: float) -> None:
        handlers: dict[type[m.Message], Callable[[Any, float], None]] = {
            m.HelloReply: self._on_hello_reply,
            m.Ack: self._on_ack,
            m.Nak: self._on_nak,
            m.Status: self._on_status,
            m.Event: self._on_event,
            m.ClockReply: self._on_clock_reply,
            m.ArmChallenge: self._on_arm_challenge,
            m.Executed: self._on_executed,
        }
        handler = handlers.get(type(message))
        if handler is not None:
            handler(message, now_s)

    def _on_ack(self, message: m.Ack, now_s: float) -> None:
        self.board.free_points, self.board.done_index = message.free_points, message.done_index
        self.board.set_state(m.STATES[message.state])
        self._follow_state()

    def _on_nak(self, message: m.Nak, now_s: float) -> None:
        reason = m.NAK_REASONS[message.reason]
        if reason not in m.NOT_CONSUMED and self._refusal is None:  # the first refusal causes the following ones
            self._refusal = reason

    def _on_status(self, message: m.Status, now_s: float) -> None:
        fault = m.FAULTS[message.fault]
        self._count_fault(fault)
        self.board.apply_status(message)
        self._follow_state()
        self._watch.on_status(fault, now_s, self._count_errors())

    def _on_event(self, message: m.Event, now_s: float) -> None:
        self.last_event_reason = m.EVENT_REASONS[message.reason]
        self.abort_confirmed |= self._connection.peer is None and self.last_event_reason == "abort"
        fault = m.FAULTS[message.fault]
        self._count_fault(fault)
        self.board.set_state(m.STATES[message.state], fault)
        self._follow_state()
        self._watch.on_status(fault, now_s, self._count_errors())

    def _follow_state(self) -> None:
        self._arming.follow(self.board.state)
        # A session begins after the ABORT: what its messages report is the state after it.
        self.abort_confirmed |= self._connection.peer is not None and self.board.state in IDLE_STATES

    def _count_fault(self, fault: str) -> None:
        if fault and fault != self.board.fault:
            self.faults[fault] += 1

    def _on_clock_reply(self, message: m.ClockReply, now_s: float) -> None:
        self._clock_sync.finish_exchange(message.host_t, now_s, message.tick * self.scale.tick_s)
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
        self._connection.send(m.ClearFault() if self.board.state == BoardState.FAULT else m.Disarm())

    def abort(self) -> None:
        """Turn the gate off, drop the queue and disarm, before all other queued messages."""
        self._refusal = None
        self.end_arming()
        self.abort_confirmed = False
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
        self._points.drop_unsent()
        self._connection.send(m.Flush())
        self._drain = PointDrain()

    @property
    def is_draining(self) -> bool:
        """Whether reports of points that were sent before drain() may still arrive."""
        return self._drain is not None

    def _step_drain(self, drain: PointDrain) -> None:
        if not self.is_acknowledged:
            return
        missing, now_s = self._points.first_unreported, self._clock.now_s()
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
        self, points: WirePoints, kept_points: int, send_ahead_s: float, timing: PointTiming | None = None
    ) -> PlanJob | None:
        """Truncate the last job to `kept_points` points and continue with `points` without a pause.

        Return None if it is too late for that. timing: as for `PlanJob`
        """
        if not self.can_splice(kept_points):
            return None
        return self._points.splice(points, kept_points, send_ahead_s / self.scale.tick_s, timing)

    @property
    def last_job(self) -> PlanJob | None:
        """The last job of those that are not finished."""
        return self._points.last

    def find_lateness_s(self) -> float:
        """Return by how much the next unsent point is late, s, at most 0 while there is time to send it."""
        start_tick = self._points.find_start_tick()
        return -inf if start_tick is None else self.board_s() - start_tick * self.scale.tick_s

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
        if self._connection.has_unsequenced:
            return 0.0
        wait_s = WAIT_MAX_S
        if self.board.state in LEASED_STATES:
            wait_s = min(wait_s, 0.5 * RENEWAL_FRACTION * self._requirements.lease_s)
        if self._connection.outstanding or self.is_draining:
            wait_s = min(wait_s, RETRANSMISSION_WAIT_S)
        if self.has_arming and self.board.state in ARMED_STATES:
            due_tick = self._points.find_due_tick()
            if due_tick is not None:
                wait_s = min(wait_s, max(due_tick * self.scale.tick_s - self.board_s(), BATCH_WAIT_S))
        return max(wait_s, WAIT_MIN_S)

    # --- statistics ---------------------------------------------------------------------------------------------

    @property
    def likely_cause(self) -> LinkCause | None:
        """Likely cause of the last lost link or expired lease, None before the first."""
        return self._watch.cause

    def collect_link_stats(self) -> dict[str, Any]:
        """Return the statistics of the link. Any thread may call it."""
        counts, round_trip_s, cause = self._count_errors(), self._clock_sync.round_trip_s, self._watch.cause
        return {
            "round_trip_ms": None if round_trip_s is None else round_trip_s * 1e3,
            "host_bad_frames": counts.host_bad_frames,
            "retransmitted": counts.retransmitted,
            "naks": counts.naks,
            "board_bad_frames": counts.board_bad_frames,
            "underruns": self.board.underruns,
            "longest_stall_ms": self._watch.longest_stall_s * 1e3,
            "likely_cause": None if cause is None else cause.message,
            "likely_cause_age_s": None if cause is None else self._clock.now_s() - cause.noticed_s,
        }

    def _count_errors(self) -> LinkErrorCounts:
        host, board = self._connection.counters, self.board
        board_bad_frames = (board.crc_errors + board.format_errors) % BOARD_COUNTER_MODULUS
        bad_frames = host.crc_errors + host.format_errors, board_bad_frames
        return LinkErrorCounts(*bad_frames, host.retransmitted, host.naks)

    def _describe_errors(self) -> str:
        counts = self._count_errors()
        bad = f"{counts.host_bad_frames} bad frames at the host, {counts.board_bad_frames} at the board"
        return f"{bad}, {counts.retransmitted} retransmitted"
