"""Both ends of the link, sans-I/O: go-back-N with an 8-bit sequence number."""

from collections import deque
from dataclasses import dataclass

from optodrive.core.errors import RemoteProtocolError
from optodrive.link.protocol.framing import Frame, FrameDecoder, encode_frame
from optodrive.link.protocol.messages import (
    BOARD_MESSAGES,
    MAJOR,
    MINOR,
    NAK_REASONS,
    Abort,
    Ack,
    Event,
    Hello,
    HelloReply,
    Message,
    Nak,
    parse_message,
)

WINDOW = 8
"""Maximum number of unacknowledged sequenced frames."""
SEQ_MODULUS = 256
RTO_S = 0.025
"""Default retransmission timeout."""


@dataclass
class LinkCounters:
    """Error counters of a link, as the host sees them.

    naks: refusals; gaps: those of frames before which one was missing
    """

    crc_errors: int = 0
    format_errors: int = 0
    retransmitted: int = 0
    naks: int = 0
    gaps: int = 0


class HostConnection:
    """Host end of the link.

    Sequenced messages pass through the window and are retransmitted until acknowledged. Other messages are sent at once
    and may be lost.
    peer: the board's HELLO_REPLY, None before it arrives
    futile_transmissions: retransmissions in succession after which nothing was acknowledged
    """

    window = WINDOW

    def __init__(self, rto_s: float = RTO_S) -> None:
        self._rto_s = rto_s
        self._decoder = FrameDecoder()
        self._control: list[bytes] = []
        self._queued: deque[Message] = deque()
        self._unacked: deque[bytes] = deque()
        self._next_seq = 0
        self._base_seq = 0
        self._retransmit_pending = False
        self._retransmit_done = False
        self._timer_start_s = 0.0
        self._nonce: int | None = None
        self._nak_count = self._gap_count = 0
        self._retransmit_count = 0
        self._aborted_session = 0
        self.futile_transmissions = 0
        self.peer: HelloReply | None = None

    @property
    def session(self) -> int:
        """Session number that the board assigned, 0 before its HELLO_REPLY."""
        return 0 if self.peer is None else self.peer.session

    @property
    def outstanding(self) -> int:
        """Number of sequenced messages not yet acknowledged."""
        return len(self._unacked) + len(self._queued)

    @property
    def has_unsequenced(self) -> bool:
        """Whether messages wait that go out at once, ABORT among them."""
        return bool(self._control)

    @property
    def counters(self) -> LinkCounters:
        """Error counters since the connection was created."""
        frame_counters = self._decoder.counters
        return LinkCounters(
            frame_counters.crc_errors,
            frame_counters.format_errors,
            self._retransmit_count,
            self._nak_count,
            self._gap_count,
        )

    def send_hello(self, nonce: int) -> None:
        """Begin a new session.

        Messages of the previous session are dropped. Messages queued after its end wait for the new session.
        """
        if self.peer is not None:
            self._reset()
        self.peer = None
        self._nonce = nonce
        self._control.append(encode_frame(Frame(Hello.TYPE, 0, 0, Hello(MAJOR, MINOR, nonce).encode_body())))

    def abort(self) -> None:
        """Send ABORT before everything else and drop all other messages. A new session requires send_hello().

        Until HELLO_REPLY arrives, receive_bytes() still returns EVENTs of the aborted session, because they report the
        effect of ABORT.
        """
        self._aborted_session = self.session or self._aborted_session
        # Nothing that waited may follow it.
        self._control = [encode_frame(Frame(Abort.TYPE, 0, self.session, b""))]
        self.peer = self._nonce = None
        self._reset()

    def _reset(self) -> None:
        self._queued.clear()
        self._unacked.clear()
        self._next_seq = self._base_seq = self.futile_transmissions = 0
        self._retransmit_pending = self._retransmit_done = False

    def send(self, message: Message, at_front: bool = False) -> None:
        """Queue a message. at_front: put a sequenced message before all other queued ones."""
        if message.SEQUENCED and at_front:
            self._queued.appendleft(message)
        elif message.SEQUENCED:
            self._queued.append(message)
        else:
            self._control.append(encode_frame(Frame(message.TYPE, 0, self.session, message.encode_body())))

    def bytes_to_send(self, now_s: float, max_in_flight_bytes: int) -> bytes:
        """Return the bytes to transmit now.

        At most max_in_flight_bytes of sequenced frames stay unacknowledged, but at least one frame.
        """
        out, self._control = b"".join(self._control), []
        if self.peer is not None:
            out += self._collect_sequenced(now_s, max_in_flight_bytes)
        # A leading delimiter ends a truncated frame, which would otherwise swallow the next one, perhaps an ABORT.
        return b"\0" + out if out else b""

    def _collect_sequenced(self, now_s: float, max_in_flight_bytes: int) -> bytes:
        out = b""
        if self._unacked and (self._retransmit_pending or now_s - self._timer_start_s > self._rto_s):
            # All of them: go-back-N, since a board keeps no frame behind a gap.
            out += b"".join(self._unacked)
            self._retransmit_count += len(self._unacked)
            self.futile_transmissions += 1
            self._retransmit_pending, self._retransmit_done = False, True
            self._timer_start_s = now_s
        in_flight = sum(len(frame) for frame in self._unacked)
        while self._queued and len(self._unacked) < WINDOW:
            message = self._queued[0]
            frame = encode_frame(Frame(message.TYPE, self._next_seq, self.session, message.encode_body()))
            # One frame always goes, else a small limit would stop the link.
            if self._unacked and in_flight + len(frame) > max_in_flight_bytes:
                break
            if not self._unacked:
                self._timer_start_s = now_s
            self._queued.popleft()
            self._unacked.append(frame)
            self._next_seq = (self._next_seq + 1) % SEQ_MODULUS
            in_flight += len(frame)
            out += frame
        return out

    def receive_bytes(self, data: bytes, now_s: float) -> list[Message]:
        """Return the board's messages of this session in received bytes. Invalid frames only increase the counters.

        Acknowledgements older than one that was received before are left out: the board sends them in order.
        """
        messages = []
        for frame in self._decoder.feed(data):
            try:
                message = parse_message(frame.type, frame.body)
            except RemoteProtocolError:
                self._decoder.counters.format_errors += 1
                continue
            if not isinstance(message, BOARD_MESSAGES):
                self._decoder.counters.format_errors += 1  # an echo of the host's own message
                continue
            if isinstance(message, HelloReply):
                # A late answer to an earlier HELLO would name a session that the board has left.
                if message.host_nonce != self._nonce or self.peer is not None:
                    continue
                self.peer, self._aborted_session = message, 0
            elif self.peer is None:
                if (
                    not self._aborted_session
                    or frame.session != self._aborted_session
                    or not isinstance(message, Event)
                ):
                    continue
            # Reports of an earlier session have other indices of points.
            elif frame.session != self.session:
                continue
            if isinstance(message, Ack):
                if not self._advance_window(message.next_seq, now_s):
                    continue
            elif isinstance(message, Nak):
                self._nak_count += 1
                if not self._advance_window(message.next_seq, now_s):
                    continue
                # Every frame behind a gap is refused. Only the first NAK triggers a retransmission.
                if message.reason == NAK_REASONS.index("SEQUENCE"):
                    self._gap_count += 1
                    self._retransmit_pending |= not self._retransmit_done
            messages.append(message)
        return messages

    def _advance_window(self, next_seq: int, now_s: float) -> bool:
        """Forget the acknowledged frames. Return False for an acknowledgement that is older than one before."""
        count = (next_seq - self._base_seq) % SEQ_MODULUS
        # More than is under way: sequence numbers wrap, so an old acknowledgement looks like one far ahead.
        if count > len(self._unacked):
            return False
        for _ in range(count):
            self._unacked.popleft()
        if count:
            self._base_seq = next_seq
            self._timer_start_s = now_s
            self._retransmit_pending = self._retransmit_done = False
            self.futile_transmissions = 0
        return True


class BoardLink:
    """Board end of the link: accepts frames in order, refuses gaps and repeats the answer to duplicates."""

    def __init__(self) -> None:
        self.decoder = FrameDecoder()
        self.session = 0
        self.seq_errors = 0
        self._expected_seq = 0
        self._last_refusal: int | None = None

    @property
    def expected_seq(self) -> int:
        """Sequence number of the next frame to accept."""
        return self._expected_seq

    def begin_session(self, session: int) -> None:
        """Begin a session at sequence number 0."""
        self.session = session
        self._expected_seq = 0
        self._last_refusal = None

    def accept(self, seq: int) -> tuple[bool, int | None]:
        """Return whether a sequenced frame is the expected one, and the answer if it is not.

        The answer is a NAK reason, or None for an ACK.
        """
        ahead = (seq - self._expected_seq) % SEQ_MODULUS
        if ahead == 0:
            return True, None
        # Behind what is expected: a duplicate, whose first answer was lost.
        if ahead >= SEQ_MODULUS // 2:
            return False, self._last_refusal
        self.seq_errors += 1
        return False, NAK_REASONS.index("SEQUENCE")

    def mark_consumed(self, refusal: int | None) -> None:
        """Advance past the expected frame. refusal: NAK reason, or None if the board carried out the message."""
        self._expected_seq = (self._expected_seq + 1) % SEQ_MODULUS
        self._last_refusal = refusal
