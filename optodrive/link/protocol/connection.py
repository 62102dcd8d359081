"""The link, sans-I/O: go-back-N with an 8-bit sequence number, one end for the host and one for a board."""

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
SEQ_MODULUS = 256
RTO_S = 0.025


@dataclass
class LinkCounters:
    """How the link fared."""

    crc_errors: int = 0
    format_errors: int = 0
    retransmitted: int = 0
    naks: int = 0


class HostConnection:
    """The host's end. Sequenced messages go through a window; the others go at once and may be lost."""

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
        self._nak_count = 0
        self._retransmit_count = 0
        self._aborted_session = 0
        self.peer: HelloReply | None = None

    @property
    def session(self) -> int:
        """The session the board gave, 0 before it did."""
        return 0 if self.peer is None else self.peer.session

    @property
    def outstanding(self) -> int:
        """Sequenced messages not yet acknowledged."""
        return len(self._unacked) + len(self._queued)

    @property
    def counters(self) -> LinkCounters:
        """How the link fared so far."""
        frame_counters = self._decoder.counters
        return LinkCounters(
            frame_counters.crc_errors, frame_counters.format_errors, self._retransmit_count, self._nak_count
        )

    def send_hello(self, nonce: int) -> None:
        """Begin a new session; what was for the one before is forgotten, what was queued since waits for this one."""
        if self.peer is not None:
            self._reset()
        self.peer = None
        self._nonce = nonce
        self._control.append(encode_frame(Frame(Hello.TYPE, 0, 0, Hello(MAJOR, MINOR, nonce).encode_body())))

    def abort(self) -> None:
        """Put ABORT ahead of all and forget everything else; only a new hello goes on from here.

        Until its answer the board's events of the session before are still given: they say what became of ABORT.
        """
        self._aborted_session = self.session or self._aborted_session
        self._control = [encode_frame(Frame(Abort.TYPE, 0, self.session, b""))]
        self.peer = self._nonce = None
        self._reset()

    def _reset(self) -> None:
        self._queued.clear()
        self._unacked.clear()
        self._next_seq = self._base_seq = 0
        self._retransmit_pending = self._retransmit_done = False

    def send(self, message: Message, at_front: bool = False) -> None:
        """Queue a message. first: before all sequenced ones that wait."""
        if message.SEQUENCED and at_front:
            self._queued.appendleft(message)
        elif message.SEQUENCED:
            self._queued.append(message)
        else:
            self._control.append(encode_frame(Frame(message.TYPE, 0, self.session, message.encode_body())))

    def bytes_to_send(self, now_s: float, max_in_flight_bytes: int) -> bytes:
        """What may leave now, keeping at most flight_bytes of sequenced frames unacknowledged."""
        out, self._control = b"".join(self._control), []
        if self.peer is not None:
            out += self._collect_sequenced(now_s, max_in_flight_bytes)
        # A frame whose end was lost would swallow the next one, an ABORT perhaps: a delimiter first ends it.
        return b"\0" + out if out else b""

    def _collect_sequenced(self, now_s: float, max_in_flight_bytes: int) -> bytes:
        out = b""
        if self._unacked and (self._retransmit_pending or now_s - self._timer_start_s > self._rto_s):
            out += b"".join(self._unacked)
            self._retransmit_count += len(self._unacked)
            self._retransmit_pending, self._retransmit_done = False, True
            self._timer_start_s = now_s
        in_flight = sum(len(frame) for frame in self._unacked)
        while self._queued and len(self._unacked) < WINDOW:
            message = self._queued[0]
            frame = encode_frame(Frame(message.TYPE, self._next_seq, self.session, message.encode_body()))
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
        """Take bytes; give the board's messages of this session. What is no frame, or no message, only counts."""
        messages = []
        for frame in self._decoder.feed(data):
            try:
                message = parse_message(frame.type, frame.body)
            except RemoteProtocolError:
                self._decoder.counters.format_errors += 1
                continue
            if not isinstance(message, BOARD_MESSAGES):
                self._decoder.counters.format_errors += 1  # our own words: the line echoes
                continue
            if isinstance(message, HelloReply):
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
            elif frame.session != self.session:
                continue
            if isinstance(message, Ack):
                self._advance_window(message.next_seq, now_s)
            elif isinstance(message, Nak):
                self._nak_count += 1
                self._advance_window(message.next_seq, now_s)
                if message.reason == NAK_REASONS.index("SEQUENCE") and not self._retransmit_done:
                    self._retransmit_pending = (
                        True  # once: the other frames behind a gap are refused too, and say no more
                    )
            messages.append(message)
        return messages

    def _advance_window(self, next_seq: int, now_s: float) -> None:
        count = (next_seq - self._base_seq) % SEQ_MODULUS
        if count > len(self._unacked):
            return  # an old acknowledgement, overtaken
        for _ in range(count):
            self._unacked.popleft()
        if count:
            self._base_seq = next_seq
            self._timer_start_s = now_s
            self._retransmit_pending = self._retransmit_done = False


class BoardLink:
    """The board's end: frames in order go up once, gaps are refused, duplicates answered again."""

    def __init__(self) -> None:
        self.decoder = FrameDecoder()
        self.session = 0
        self.seq_errors = 0
        self._expected_seq = 0
        self._last_refusal: int | None = None

    @property
    def expected_seq(self) -> int:
        """The sequence number awaited next."""
        return self._expected_seq

    def begin_session(self, session: int) -> None:
        """A new session."""
        self.session = session
        self._expected_seq = 0
        self._last_refusal = None

    def accept(self, seq: int) -> tuple[bool, int | None]:
        """Whether a sequenced frame is the awaited one; if not, the NAK reason to answer with, None for an ACK."""
        ahead = (seq - self._expected_seq) % SEQ_MODULUS
        if ahead == 0:
            return True, None
        if ahead >= SEQ_MODULUS // 2:
            return False, self._last_refusal
        self.seq_errors += 1
        return False, NAK_REASONS.index("SEQUENCE")

    def mark_consumed(self, refusal: int | None) -> None:
        """The awaited frame was taken; refusal: the NAK reason, None where it was carried out."""
        self._expected_seq = (self._expected_seq + 1) % SEQ_MODULUS
        self._last_refusal = refusal
