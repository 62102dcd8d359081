"""Link to one board: handshake, exchange of messages, comparison of clocks, and the truth about the board.

Handshake. HELLO with a nonce begins a session number; bytes of an earlier one are discarded. The board states its
limits, the session refuses a board that does not meet the configuration, tightens the limits to it, and exchanges
clocks a few times. Only then do commands go out, and the tightened limits before all others. After a reconnect or ABORT
all of this is done again: the board is DISARMED, and the session never arms on its own.

Truth. State, position and errors are what the board reports (`board_view.py`), with the instant of the last message:
silence for `SILENCE_TIMEOUT_S` ends the session, and for a lease where other boards' light depends on it.
`link_watch.py` keeps what is needed to name the likely cause afterwards (docs/explanation/link.md).
"""

import secrets
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from math import inf
from typing import Any

from optodrive.core.clock import Clock
from optodrive.core.errors import InputError, LinkError
from optodrive.link.protocol import messages as m
from optodrive.link.protocol.connection import HostConnection
from optodrive.link.protocol.quantisation import WireScale
from optodrive.link.protocol.states import LEASED_STATES
from optodrive.link.session.arming import RENEWAL_FRACTION, BoardRequirements
from optodrive.link.session.board_view import BoardView
from optodrive.link.session.clock_sync import CLOCK_INTERVAL_S, ClockSync
from optodrive.link.session.link_watch import BOARD_COUNTER_MODULUS, LinkCause, LinkErrorCounts, LinkWatch
from optodrive.link.session.point_stream import PointStream
from optodrive.link.session.report_check import FalseReportError, ReportCheck
from optodrive.link.transport.base import Transport

HELLO_RETRY_S = 0.25
CONNECT_TIMEOUT_S = 2.5
"""Time after which a missing answer is reported."""
HELLO_SLOW_S = 1.0
"""Interval of HELLO from then on: a loader that waits for silence before it starts the firmware gets some."""
BOOT_MAX_S = 10.0
"""Longest start of a board that its port's opening resets: a caller of connect() waits for it."""
REOPEN_S = 60.0
"""Time without an answer after which the port is opened again, for drivers that have lost its settings."""
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


class BoardLink:
    """Link to a board over a transport, which neither arms it nor gives it light.

    faults: number of times that the board reported each fault
    board: latest reported state of the board
    is_silent: whether the port is open and no board has answered for CONNECT_TIMEOUT_S
    seeks_clock: whether the clocks are compared more often, because that of the board is not known well enough
    is_one_of_several: whether other boards share its display. It is then asked often: for its clock, because all keep
    the host's time, and for its status, because its silence must end the light of the others within a lease.
    """

    def __init__(
        self, transport: Transport, clock: Clock, requirements: BoardRequirements, is_one_of_several: bool
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
        self._hello_sent_s = self._status_requested_s = self._clock_requested_s = self._last_received_s = 0.0
        self._queue_points = self._reset_code = 0
        self._watch = LinkWatch(transport.name, requirements.lease_s, requirements.rto_s, transport.describe_fault)
        self._handlers: dict[type[m.Message], Callable[[Any, float], None]] = {
            m.HelloReply: self._on_hello_reply,
            m.Ack: self._on_ack,
            m.Status: self._on_status,
            m.Event: self._on_event,
            m.ClockReply: self._on_clock_reply,
        }
        self.faults: Counter[str] = Counter()
        self.board = BoardView()
        self.connected = self.seeks_clock = self.is_silent = False
        self.last_event_reason = ""

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
        # Restored on failure: heat and budget are dated by this clock, and cool on while the board is away.
        previous_sync = self._clock_sync
        try:
            for wait_s in self._handshake(BOOT_MAX_S if block else REOPEN_S):
                # The link process polls its ports itself: a wait here would delay the lease of the other boards.
                self._exchange(wait_s if block else 0.0)
                yield wait_s
        except (LinkError, InputError):
            self._clock_sync = previous_sync
            self.on_connect_failed()
            raise
        # Only now can a restart be told from a deaf board: by its clock and its counters.
        self._watch.on_reconnected(self._clock.now_s(), self._reset_code, self.board_s(), self._count_errors())
        self.connected = True

    def on_connect_failed(self) -> None:
        """Close the port, which could not be opened or whose board did not answer, and update the likely cause."""
        self._transport.close()
        self._watch.on_reconnect_failed(self._clock.now_s())

    def _handshake(self, patience_s: float) -> Iterator[float]:
        """Send the messages due in each step of the handshake, and yield how long to wait for bytes.

        The port stays open while no board answers: its opening resets some boards, which would never start.
        """
        self._reset()
        self._send_hello()
        began_s = self._clock.now_s()
        # HELLO is repeated with a new nonce: a pty or USB port may lose the first, and only the echo tells which one is
        # answered.
        while self._connection.peer is None:
            self._retry_hello()
            yield HANDSHAKE_INTERVAL_S
            silent_s = self._clock.now_s() - began_s
            if silent_s > CONNECT_TIMEOUT_S and not self.is_silent:
                self.is_silent = True
                self._watch.on_reconnect_failed(self._clock.now_s())
            if silent_s > patience_s:
                raise self.build_silence_error()
        self.is_silent = False
        deadline_s = self._clock.now_s() + CONNECT_TIMEOUT_S
        while not (self.is_acknowledged and self._clock_sync.is_synchronised and self.board.state != "UNKNOWN"):
            if self._clock.now_s() - self._clock_requested_s >= HANDSHAKE_INTERVAL_S:
                self._request_clock()
                self._request_status()
            yield HANDSHAKE_INTERVAL_S
            if self._clock.now_s() > deadline_s:
                raise LinkError(f"{self.port}: the board answers HELLO but nothing else; {self._describe_errors()}")
        # The narrowest of several exchanges bounds the offset: the first one alone includes the port's first delays.
        for _ in range(CLOCK_INITIAL_SAMPLES):
            self._request_clock()
            yield 0.005

    def build_silence_error(self) -> LinkError:
        """Return the error while no board answers at the open port."""
        return LinkError(f"{self.port} is open, but no board answers: check its power, the port and the baud rate")

    def _send_hello(self) -> None:
        """Begin a session. The board ends its previous activity and goes to DISARMED."""
        self._hello_sent_s = self._clock.now_s()
        self._connection.send_hello(secrets.randbits(32))

    def _retry_hello(self) -> None:
        interval_s = HELLO_SLOW_S if self.is_silent else HELLO_RETRY_S
        if self._connection.peer is None and self._clock.now_s() - self._hello_sent_s > interval_s:
            if self.is_silent and (fault := self._transport.describe_fault()):
                # Silence of an open port is patience; one that is evidently gone would be waited for in vain.
                raise LinkError(fault)
            self._send_hello()

    def _on_hello_reply(self, peer: m.HelloReply, now_s: float) -> None:
        # Refused here, before any command: a board of another laser or servo never sees points of this configuration.
        self._requirements.check_board(peer)
        self.board.uid, self.board.firmware = peer.uid.hex(), peer.firmware
        self._queue_points, self._reset_code = peer.queue_points, peer.reset_cause
        # The board counts points from 0 in each session.
        self._points.reset_indices()
        # before commands already queued for this session
        self._connection.send(self._requirements.limits, at_front=True)
        self._request_status()

    def _reset(self) -> None:
        """Forget the board that an earlier connection has reported."""
        # Each handshake builds another: sequence numbers and queued frames of the session before must not leave in the
        # next.
        self._connection = HostConnection(self._requirements.rto_s)
        self._clock_sync = self._build_clock_sync()
        self._report_check = self._build_report_check()
        self.board = BoardView()
        self.is_silent = False
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

    def describe_port_fault(self, before: str = "") -> str:
        """Return the evident fault of the open port with a text before it, or an empty text."""
        fault = self._transport.describe_fault()
        return f"{before}{fault}" if fault else ""

    def close(self) -> None:
        """Send ABORT if possible and close the link permanently."""
        if self.connected:
            self._send_abort()
        self.connected = False
        # Permanently: a transport with a thread or process of its own ends it here.
        self._transport.release()

    def _send_abort(self) -> None:
        with suppress(LinkError):  # without ABORT the board turns the gate off when its lease expires
            self._connection.abort()
            self._transport.write(
                self._connection.bytes_to_send(self._clock.now_s(), self._requirements.max_in_flight_bytes)
            )

    # --- exchange -----------------------------------------------------------------------------------------------

    def _request_due(self, now_s: float) -> None:
        """Request status and clock when they are due, and HELLO's reply again."""
        if now_s - self._status_requested_s >= self._status_interval_s:
            self._request_status()
        clock_interval_s = CLOCK_SEEK_INTERVAL_S if self.seeks_clock else self._clock_interval_s
        if now_s - self._clock_requested_s >= clock_interval_s:
            self._request_clock()
        self._retry_hello()

    def _require_answers(self, now_s: float) -> None:
        """Raise LinkError if the board acknowledges nothing, or has sent nothing for too long."""
        if self._connection.futile_transmissions > FUTILE_TRANSMISSIONS_MAX:
            raise LinkError(f"{self.port}: the board acknowledges nothing; {self._describe_errors()}")
        silence_max_s = self._silence_max_s
        # Against the time before this step's read: a host that was suspended reads what waits before it blames the
        # board.
        if now_s - self._last_received_s > silence_max_s:
            raise LinkError(f"{self.port}: the board sent nothing for {silence_max_s:g} s; {self._describe_errors()}")

    @property
    def _silence_max_s(self) -> float:
        # The others may emit only in an order that this one keeps: its silence for a lease means that it does not.
        is_short = self._is_one_of_several and self.board.state in LEASED_STATES
        return self._requirements.lease_s if is_short else SILENCE_TIMEOUT_S

    def _exchange(self, wait_s: float) -> None:
        # Written even if there is nothing new: a port sends at the next call what it had no room for.
        self._transport.write(
            self._connection.bytes_to_send(self._clock.now_s(), self._requirements.max_in_flight_bytes)
        )
        data = self._transport.read(wait_s)
        if data:
            now_s = self._clock.now_s()
            for message in self._connection.receive_bytes(data, now_s):
                # Any valid frame proves that the board lives, also one whose content is refused as old.
                self._last_received_s = now_s
                # The only door for reports: no handler repeats the check.
                if self._report_check.accept(message, now_s):
                    handler = self._handlers.get(type(message))
                    if handler is not None:
                        handler(message, now_s)

    def _request_status(self) -> None:
        self._status_requested_s = self._clock.now_s()
        self._connection.send(m.Get())

    def _request_clock(self) -> int:
        self._clock_requested_s = self._clock.now_s()
        stamp = self._clock_sync.start_exchange(self._clock_requested_s)
        self._connection.send(m.ClockRequest(host_t=stamp))
        return stamp

    # --- reports ------------------------------------------------------------------------------------------------

    def _on_ack(self, message: m.Ack, now_s: float) -> None:
        self.board.free_points, self.board.done_index = message.free_points, message.done_index
        self.board.set_state(m.STATES[message.state])
        self._follow_state()

    def _on_status(self, message: m.Status, now_s: float) -> None:
        fault = m.FAULTS[message.fault]
        self._count_fault(fault)
        self.board.apply_status(message)
        self._follow_state()
        self._watch.on_status(fault, now_s, self._count_errors())

    def _on_event(self, message: m.Event, now_s: float) -> None:
        self.last_event_reason = m.EVENT_REASONS[message.reason]
        fault = m.FAULTS[message.fault]
        self._count_fault(fault)
        self.board.set_state(m.STATES[message.state], fault)
        self._follow_state()
        self._watch.on_status(fault, now_s, self._count_errors())

    def _follow_state(self) -> None:
        """React to a report of the board's state."""

    def _count_fault(self, fault: str) -> None:
        # STATUS repeats a latched fault several times per second; it counts once.
        if fault and fault != self.board.fault:
            self.faults[fault] += 1

    def _on_clock_reply(self, message: m.ClockReply, now_s: float) -> None:
        duration_s = self._clock_sync.finish_exchange(message.host_t, now_s, message.tick * self.scale.tick_s)
        if duration_s is not None:
            self._watch.on_answer(now_s, duration_s)

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
            "silence_s": self._clock.now_s() - self._last_received_s if self.connected else None,
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
        return LinkErrorCounts(*bad_frames, host.retransmitted, host.naks, host.gaps)

    def _describe_errors(self) -> str:
        counts = self._count_errors()
        bad = f"{counts.host_bad_frames} bad frames at the host, {counts.board_bad_frames} at the board"
        return f"{bad}, {counts.retransmitted} retransmitted"
