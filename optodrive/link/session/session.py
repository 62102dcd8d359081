"""The host's session with one board: handshake, limits, clock, arming, lease, streaming, faults.

Nothing here blocks but `connect`; `step` is called again and again by the loop that owns the session. Arming is never
repeated by itself: a reconnect ends in DISARMED.
"""

import secrets
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from math import inf
from typing import Any

from optodrive.core.clock import Clock
from optodrive.core.errors import InputError, LinkError, NotReadyError
from optodrive.core.histogram import Histogram
from optodrive.link.protocol import messages as m
from optodrive.link.protocol.connection import HostConnection
from optodrive.link.protocol.quantisation import WirePoints, WireScale
from optodrive.link.session.board_requirements import Requirements
from optodrive.link.session.board_view import BoardView
from optodrive.link.session.clock_sync import ClockSync
from optodrive.link.session.job import Job
from optodrive.link.session.link_watch import Cause, Counts, LinkWatch
from optodrive.link.session.point_stream import PointStream
from optodrive.link.transport.base import Transport

LEASE_SHARE = 0.2
"""The lease is renewed five times in its length."""
HELLO_RETRY_S = 0.25
CONNECT_TIMEOUT_S = 6.0
STATUS_EVERY_S = 0.2
CLOCK_EVERY_S = 1.0
CLOCK_FIRST = 8
SILENCE_S = 2.0
"""A board that answers nothing for this long counts as lost."""
FOLLOW_S = 0.01
"""Points that follow others must be on their way so long before those end."""
LEASE_AGES_S = (0.01, 0.02, 0.025, 0.03, 0.04, 0.05, 0.06, 0.08, 0.1, 0.2, 0.5, 1.0)
LEASED = ("ARMING", "ARMED", "RUNNING", "HOLD")


class Session:
    """A session over a transport, with the requirements of a configuration.

    faults: how often the board was seen to go into each; lease_ages: seconds since the last renewal, at each;
    lease_slack_s: the least of the lease that was left then, None before the second renewal
    """

    def __init__(self, transport: Transport, clock: Clock, requirements: Requirements) -> None:
        self._transport = transport
        self._clock = clock
        self._requirements = requirements
        self._connection = HostConnection()
        self._sync = ClockSync()
        self._clock_asked_s: dict[int, float] = {}
        self._points = PointStream()
        self._hello_sent_s = 0.0
        self._refusal: str | None = None
        self._arm_nonce: int | None = None
        self._lease_sent_s = self._status_asked_s = self._clock_sent_s = self._heard_s = 0.0
        self._queue_points = self._reset_code = 0
        self._leasing = False
        self.faults: Counter[str] = Counter()
        self.lease_ages = Histogram(LEASE_AGES_S)
        self.lease_slack_s: float | None = None
        self._watch = LinkWatch(transport.name, requirements.lease_s)
        self.board = BoardView()
        self.connected = False
        self.last_reason = ""
        self.aborted = False
        """Whether the board has said that it took the last ABORT: dark, queue dropped, DISARMED."""

    @property
    def port(self) -> str:
        """The transport's name."""
        return self._transport.name

    @property
    def scale(self) -> WireScale:
        """How SI becomes codes on this board."""
        return self._requirements.scale

    def board_s(self) -> float:
        """The board's time now, s."""
        return self._sync.board_s(self._clock.now_s())

    @property
    def ready(self) -> bool:
        """Whether a job may begin now."""
        return self.board.state == "ARMED" and not self._points and self.quiet

    @property
    def quiet(self) -> bool:
        """Whether the board has greeted and acknowledged everything that was sent."""
        return self._connection.peer is not None and self._connection.outstanding == 0

    # --- connecting ---------------------------------------------------------------------------------------------

    def connect(self) -> None:
        """Open the link and shake hands; LinkError without an answer, InputError for a board that does not fit.

        Until it has succeeded the clock known before goes on: heat is kept in its time.
        """
        known = self._sync
        try:
            self._transport.open()
            self._shake_hands()
        except (LinkError, InputError):
            self._sync = known
            self._transport.close()
            self._watch.not_back(self._clock.now_s())
            raise
        self._watch.back(self._clock.now_s(), self._reset_code, self.board_s(), self._counts())
        self.connected = True

    def _shake_hands(self) -> None:
        self._forget()
        self._greet()
        give_up_s = self._clock.now_s() + CONNECT_TIMEOUT_S
        while self._connection.peer is None:
            self._greet_again()
            self._exchange(0.02)
            if self._clock.now_s() > give_up_s:
                raise LinkError(
                    f"{self.port} is open, but no board answers: is it powered, the right port, the right baud rate?"
                )
        while not (self.quiet and self._sync.known and self.board.state != "UNKNOWN"):
            self._ask_clock()
            self._ask_status()
            self._exchange(0.02)
            if self._clock.now_s() > give_up_s:
                raise LinkError(f"{self.port}: the board greets, but does not answer further; {self._damage()}")
        for _ in range(CLOCK_FIRST):
            self._ask_clock()
            self._exchange(0.005)

    def _greet(self) -> None:
        """Begin a session: whatever the board did, it ends, and leads to DISARMED."""
        self._points.clear()
        self._hello_sent_s = self._clock.now_s()
        self._connection.hello(secrets.randbits(32))

    def _greet_again(self) -> None:
        if self._connection.peer is None and self._clock.now_s() - self._hello_sent_s > HELLO_RETRY_S:
            self._greet()

    def _take_hello(self, peer: m.HelloReply, now_s: float) -> None:
        self._requirements.check(peer)
        self.board.uid, self.board.firmware = peer.uid.hex(), peer.firmware
        self._queue_points, self._reset_code = peer.queue_points, peer.reset_cause
        self._points.restart()
        self._connection.send(self._requirements.limits(), first=True)  # an order may wait for this session already
        self._ask_status()

    def _forget(self) -> None:
        self._connection = HostConnection(self._requirements.rto_s)
        self._sync = ClockSync()
        self._clock_asked_s.clear()
        self._arm_nonce = None
        self._refusal = None
        self.board = BoardView()
        self._heard_s = self._clock.now_s()
        self._watch.opened()

    def drop(self) -> None:
        """Give the link up."""
        self.connected = False
        self._transport.close()

    def lost(self, error: Exception) -> str:
        """Give the link up after an error; the error, and why it likely came where the link itself failed."""
        told = str(error)
        if isinstance(error, LinkError):
            now_s = self._clock.now_s()
            cause = self._watch.lost(now_s, self._heard_s, silent=now_s - self._heard_s > SILENCE_S)
            told = f"{told}; likely cause: {cause.sentence}"
        self.drop()
        return told

    def close(self) -> None:
        """Tell the board to abort, if it can still be told, and close the link for good."""
        if self.connected:
            self._say_goodbye()
        self.connected = False
        self._transport.release()

    def _say_goodbye(self) -> None:
        with suppress(LinkError):  # the board's own lease ends it dark where it cannot be told
            self._connection.abort()
            self._transport.write(self._connection.bytes_to_send(self._clock.now_s(), self._requirements.flight_bytes))

    # --- the loop's turn ----------------------------------------------------------------------------------------

    def step(self, wait_s: float, lease: bool) -> None:
        """Send what is due, wait at most wait_s for bytes, take them in. lease: whether the planner is alive."""
        now_s = self._clock.now_s()
        self._watch.turn(now_s, lease, self._counts())
        if self.board.state not in LEASED:
            self._leasing = False
        elif lease and now_s - self._lease_sent_s >= LEASE_SHARE * self._requirements.lease_s:
            self._renew_lease(now_s)
        if now_s - self._status_asked_s >= STATUS_EVERY_S:
            self._ask_status()
        if now_s - self._clock_sent_s >= CLOCK_EVERY_S:
            self._ask_clock()
        self._greet_again()
        self._stream()
        self._exchange(wait_s)
        if now_s - self._heard_s > SILENCE_S:
            raise LinkError(f"{self.port}: the board fell silent for {SILENCE_S:g} s; {self._damage()}")

    def _renew_lease(self, now_s: float) -> None:
        lease_s, age_s = self._requirements.lease_s, now_s - self._lease_sent_s
        self._connection.send(m.Lease(ms=round(lease_s * 1e3)))
        self._lease_sent_s = now_s
        if self._leasing:
            self.lease_ages.add(age_s)
            self.lease_slack_s = min(lease_s if self.lease_slack_s is None else self.lease_slack_s, lease_s - age_s)
        self._leasing = True

    def _exchange(self, wait_s: float) -> None:
        out = self._connection.bytes_to_send(self._clock.now_s(), self._requirements.flight_bytes)
        if out:
            self._transport.write(out)
        data = self._transport.read(wait_s)
        if data:
            now_s = self._clock.now_s()
            for message in self._connection.receive_bytes(data, now_s):
                self._heard_s = now_s
                self._take(message, now_s)

    def _ask_status(self) -> None:
        self._status_asked_s = self._clock.now_s()
        self._connection.send(m.Get())

    def _ask_clock(self) -> None:
        self._clock_sent_s = self._clock.now_s()
        stamp = secrets.randbits(32)
        if len(self._clock_asked_s) > 64:
            self._clock_asked_s.clear()
        self._clock_asked_s[stamp] = self._clock_sent_s
        self._connection.send(m.Clock(host_t=stamp))

    def _take(self, message: m.Message, now_s: float) -> None:
        takers: dict[type[m.Message], Callable[[Any, float], None]] = {
            m.HelloReply: self._take_hello,
            m.Ack: self._take_ack,
            m.Nak: self._take_nak,
            m.Status: self._take_status,
            m.Event: self._take_event,
            m.ClockReply: self._take_clock,
            m.ArmChallenge: self._take_challenge,
            m.Executed: self._take_executed,
        }
        taker = takers.get(type(message))
        if taker is not None:
            taker(message, now_s)

    def _take_ack(self, message: m.Ack, now_s: float) -> None:
        self.board.free_points, self.board.done_index = message.free_points, message.done_index
        self._set_state(m.STATES[message.state])

    def _take_nak(self, message: m.Nak, now_s: float) -> None:
        reason = m.NAK_REASONS[message.reason]
        if reason not in m.NOT_CONSUMED and self._refusal is None:  # the first is the cause, others follow from it
            self._refusal = reason

    def _take_status(self, message: m.Status, now_s: float) -> None:
        board = self.board
        board.inputs, board.done_index, board.queued = message.inputs, message.done_index, message.queued
        board.underruns, board.crc_errors = message.underruns, message.crc_errors
        board.format_errors, board.seq_errors = message.format_errors, message.seq_errors
        board.laser_on_s = message.laser_on_us * 1e-6
        board.temperature_c = message.temperature_dc / 10.0
        self._note_fault(m.FAULTS[message.fault])
        self._watch.heard(board.fault, now_s, self._counts())
        self._set_state(m.STATES[message.state])

    def _take_event(self, message: m.Event, now_s: float) -> None:
        self.aborted |= self._connection.peer is None and m.REASONS[message.reason] == "abort"
        self._note_fault(m.FAULTS[message.fault])
        self._watch.heard(self.board.fault, now_s, self._counts())
        self.last_reason = m.REASONS[message.reason]
        self._set_state(m.STATES[message.state])

    def _note_fault(self, fault: str) -> None:
        if fault and fault != self.board.fault:
            self.faults[fault] += 1
        self.board.fault = fault

    def _set_state(self, state: str) -> None:
        self.board.state = state
        if state != "FAULT":
            self.board.fault = ""

    def _take_clock(self, message: m.ClockReply, now_s: float) -> None:
        sent_s = self._clock_asked_s.pop(message.host_t, None)
        if sent_s is not None:
            self._sync.add(sent_s, now_s, message.tick * self.scale.tick_s)

    def _take_challenge(self, message: m.ArmChallenge, now_s: float) -> None:
        if message.host_nonce == self._arm_nonce:
            self._arm_nonce = None
            self._connection.send(m.ArmConfirm(board_nonce=message.board_nonce, host_nonce=message.host_nonce))

    def _take_executed(self, message: m.Executed, now_s: float) -> None:
        # What is done makes room: a small queue would run dry before an ACK or a STATUS tells.
        self.board.done_index = max(self.board.done_index, message.first_index + len(message.records))
        self._points.note(message)

    # --- orders -------------------------------------------------------------------------------------------------

    def arm(self) -> None:
        """Ask the board to arm; it lights its indicator and is ARMED two seconds after the confirmation."""
        if self.board.state != "DISARMED":
            fault = f" {self.board.fault}" if self.board.fault else ""
            raise NotReadyError(f"the board is {self.board.state}{fault}; only a DISARMED board can be armed")
        self._refusal = None
        self._points.clear()
        self._arm_nonce = secrets.randbits(32)
        self._connection.send(m.ArmReq(host_nonce=self._arm_nonce))

    def disarm(self) -> None:
        """Disarm; from FAULT, acknowledge the fault."""
        self._refusal = None
        self._points.clear()
        self._connection.send(m.ClearFault() if self.board.state == "FAULT" else m.Disarm())

    def abort(self) -> None:
        """Gate off now, queue dropped, DISARMED; goes ahead of everything else that waits to be sent."""
        self._refusal = None
        self.aborted = False
        self._connection.abort()
        self._greet()

    def flush(self) -> None:
        """Drop what is queued; the board stays armed."""
        self._points.clear()
        self._connection.send(m.Flush())

    def take_refusal(self) -> str | None:
        """Why the board refused the last order, once."""
        refusal, self._refusal = self._refusal, None
        return refusal

    # --- streaming ----------------------------------------------------------------------------------------------

    def begin(self, points: WirePoints, start_s: float, ahead_s: float = inf) -> Job:
        """Begin to stream a plan whose zero is at the board's time start_s, as Job says."""
        return self._points.begin(points, max(1, round(start_s / self.scale.tick_s)), ahead_s / self.scale.tick_s)

    def follow(self, points: WirePoints, keep: int, ahead_s: float) -> Job | None:
        """Cut the last job after `keep` points and go on without a pause; None where that is too late."""
        tick_s = self.scale.tick_s
        return self._points.follow(points, keep, ahead_s / tick_s, (self.board_s() + FOLLOW_S) / tick_s)

    def end_after(self, keep: int) -> bool:
        """Cut the last job after `keep` points; False, and unchanged, where more has left already."""
        return self._points.end_after(keep)

    def _stream(self) -> None:
        if not self._points:
            return
        if self.board.state not in ("DISARMED", "FAULT"):  # else it ended by itself: send no more, but hear the rest
            now_tick = self.board_s() / self.scale.tick_s
            self._points.send(self._connection, self.board.done_index, self._queue_points, now_tick)
        self._points.fill_gaps(self._connection, self.board.done_index, self._clock.now_s())
        self._points.forget_finished(self.board.state == "ARMED")

    # --- figures ------------------------------------------------------------------------------------------------

    @property
    def likely_cause(self) -> Cause | None:
        """Why the link was lost last, or the lease lapsed, as far as can be told; None before that."""
        return self._watch.cause

    def link_figures(self) -> dict[str, Any]:
        """Counters of the link, for people who wonder why it is slow or lost; any thread may ask."""
        counts, round_trip_s, cause = self._counts(), self._sync.round_trip_s, self._watch.cause
        return {
            "round_trip_ms": None if round_trip_s is None else round_trip_s * 1e3,
            "received_bad": counts.bad_here,
            "retransmitted": counts.sent_again,
            "naks": counts.naks,
            "board_bad": counts.bad_at_board,
            "underruns": self.board.underruns,
            "longest_stall_ms": self._watch.longest_gap_s * 1e3,
            "likely_cause": None if cause is None else cause.sentence,
            "likely_cause_ago_s": None if cause is None else self._clock.now_s() - cause.at_s,
        }

    def _counts(self) -> Counts:
        here, board = self._connection.counters, self.board
        bad = here.crc_errors + here.format_errors, board.crc_errors + board.format_errors
        return Counts(*bad, here.retransmitted, here.naks)

    def _damage(self) -> str:
        counts = self._counts()
        return f"{counts.bad_here} bad frames here, {counts.bad_at_board} at the board, {counts.sent_again} sent again"
