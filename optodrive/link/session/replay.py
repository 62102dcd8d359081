"""Replay of a captured session to a board, and comparison of the board's behaviour.

A replay cannot arm a real board: it answers a challenge with the captured nonces, which no new challenge accepts. Only
a simulated board with the captured board's seed repeats its nonces and can be armed.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from math import inf
from typing import Any

from optodrive.core.clock import Clock
from optodrive.core.errors import LinkError
from optodrive.link.protocol import messages as m
from optodrive.link.protocol.framing import FrameDecoder, encode_frame
from optodrive.link.protocol.transcript import Transcript
from optodrive.link.transport.base import Transport
from optodrive.link.transport.link_capture import CLOSED, FROM_BOARD, OPENED, TO_BOARD, CaptureEntry

READ_MAX_S = 0.05
SLEEP_BELOW_S = 0.999_999e-4
"""Remaining waits below this time are slept, because a read would take longer."""
HELLO_RETRY_S, HELLO_TIMEOUT_S = 0.25, 2.5
SILENCE_TIMEOUT_S = 2.5
"""A board that sends nothing for this time, in which the captured one sent, is lost."""
DRAIN_S = 0.5


@dataclass
class BoardTrace:
    """Reports of a board over a capture.

    states: (state, fault, reason) in order
    executed: (tick of gate on, gate-on ticks, duty) by (number of the session from 1, point index)
    """

    states: list[tuple[str, str, str]] = field(default_factory=list)
    executed: dict[tuple[int, int], tuple[int, int, int]] = field(default_factory=dict)
    sessions: int = 0
    session: int = 0
    transcript: Transcript = field(default_factory=Transcript)

    def feed(self, entry: CaptureEntry) -> None:
        """Add an entry of a capture."""
        if entry.kind in (OPENED, CLOSED):
            self.transcript.reset_link()
            return
        for line in self.transcript.feed(entry.host_s, entry.kind == TO_BOARD, entry.data):
            if isinstance(line.message, m.HelloReply):
                self.sessions += 1
                self.session = line.message.session
            elif isinstance(line.message, m.Event):
                event = line.message
                names = m.STATES[event.state], m.FAULTS[event.fault], m.EVENT_REASONS[event.reason]
                self.states.append(names)
            elif isinstance(line.message, m.Executed):
                for offset, record in enumerate(line.message.records):
                    self.executed[self.sessions, line.message.first_index + offset] = record


def clock_shift_s(entries: Iterable[CaptureEntry]) -> float:
    """Return the captured board time minus host time, s, from CLOCK and its replies, 0 if consistent with them."""
    low_s, high_s = -inf, inf
    transcript, request_s = Transcript(), dict[int, float]()
    for entry in entries:
        if entry.kind in (OPENED, CLOSED):
            transcript.reset_link()
            continue
        for line in transcript.feed(entry.host_s, entry.kind == TO_BOARD, entry.data):
            if isinstance(line.message, m.ClockRequest):
                request_s[line.message.host_t] = line.host_s
            elif isinstance(line.message, m.ClockReply) and line.message.host_t in request_s:
                board_s = line.message.tick * 1e-6
                sent_s = request_s.pop(line.message.host_t)
                if board_s - sent_s < low_s or board_s - line.host_s > high_s:
                    return _choose_shift_s(low_s, high_s)  # the board restarted: use the first run
                low_s, high_s = max(low_s, board_s - line.host_s), min(high_s, board_s - sent_s)
    return _choose_shift_s(low_s, high_s)


def _choose_shift_s(low_s: float, high_s: float) -> float:
    return 0.0 if low_s <= 0.0 <= high_s else (low_s + high_s) / 2.0


class Replay:
    """Replay of a capture to a board.

    shift_s: present time minus captured time
    may_arm: whether to send ARM_CONFIRM; only for a simulated board
    """

    def __init__(self, transport: Transport, clock: Clock, shift_s: float, may_arm: bool) -> None:
        self.recorded, self.replayed = BoardTrace(), BoardTrace()
        self._transport = transport
        self._clock = clock
        self._shift_s = shift_s
        self._may_arm = may_arm
        self._open = False
        self._owed_s: float | None = None
        self._hello = b""

    def run(self, entries: Iterable[CaptureEntry]) -> None:
        """Replay all entries. Raise LinkError if the link fails or the board falls silent."""
        try:
            for entry in entries:
                self.recorded.feed(entry)
                if entry.kind != FROM_BOARD:
                    self._wait_until(entry.host_s + self._shift_s)
                    self._apply(entry)
                elif self._owed_s is None:
                    self._owed_s = entry.host_s + self._shift_s
            if self._open:
                self._wait_until(self._clock.now_s() + DRAIN_S)
        finally:
            self._transport.release()

    def _apply(self, entry: CaptureEntry) -> None:
        if entry.kind in (OPENED, CLOSED):
            self._owed_s = None
        if entry.kind == OPENED:
            self._transport.open()
            self._open = True
        elif entry.kind == CLOSED:
            self._transport.close()
            self._open = False
        elif self._open:
            data = self._translate_frames(entry.data)
            if data:
                self.replayed.feed(CaptureEntry(TO_BOARD, self._clock.now_s(), data))
                self._transport.write(data)
        if entry.kind != TO_BOARD:
            self.replayed.feed(entry)

    def _wait_until(self, deadline_s: float) -> None:
        while (remaining_s := deadline_s - self._clock.now_s()) > 0.0:
            if self._open and remaining_s >= SLEEP_BELOW_S:
                self._receive(min(remaining_s, READ_MAX_S))
            else:
                self._clock.sleep(remaining_s)

    def _receive(self, wait_s: float) -> None:
        self._transport.write(b"")  # what there was no room for
        data = self._transport.read(wait_s)
        if data:
            self._owed_s = None
            self.replayed.feed(CaptureEntry(FROM_BOARD, self._clock.now_s(), data))
        elif self._owed_s is not None and self._clock.now_s() - self._owed_s > SILENCE_TIMEOUT_S:
            raise LinkError(f"{self._transport.name}: the board sent nothing for {SILENCE_TIMEOUT_S:g} s")

    def _translate_frames(self, data: bytes) -> bytes:
        """Return the host's frames with the session number of this board. Drop everything else."""
        out = []
        for frame in FrameDecoder().feed(data):
            kind = m.MESSAGES_BY_TYPE.get(frame.type)
            if kind not in m.HOST_MESSAGES or (kind is m.ArmConfirm and not self._may_arm):
                continue
            if frame.session:
                self._await_hello_reply()
                frame = frame._replace(session=self.replayed.session)
            out.append(encode_frame(frame))
            if kind is m.Hello:
                self._hello = b"\0" + out[-1]
        return b"\0" + b"".join(out) if out else b""

    def _await_hello_reply(self) -> None:
        """Repeat HELLO until it is answered, as every host does: some ports report late that they are open."""
        began_s = repeated_s = self._clock.now_s()
        while self.replayed.sessions < self.recorded.sessions:
            now_s = self._clock.now_s()
            if now_s - began_s > HELLO_TIMEOUT_S:
                raise LinkError(f"{self._transport.name}: the board does not answer the captured HELLO")
            if now_s - repeated_s > HELLO_RETRY_S:
                repeated_s = now_s
                self._transport.write(self._hello)
            self._receive(SLEEP_BELOW_S)


def compare_traces(recorded: BoardTrace, replayed: BoardTrace) -> dict[str, Any]:
    """Compare a replay with its capture. Reports beyond the end of the capture are ignored."""
    states = len(recorded.states)
    first = next(
        (at for at, pair in enumerate(zip(recorded.states, replayed.states, strict=False)) if pair[0] != pair[1]), None
    )
    if first is None and len(replayed.states) < states:
        first = len(replayed.states)
    pairs = [(recorded.executed[key], replayed.executed[key]) for key in recorded.executed if key in replayed.executed]
    changed = sum(was[1:] != now[1:] for was, now in pairs)
    shifts = [now[0] - was[0] for was, now in pairs]
    missing = len(recorded.executed) - len(pairs)
    return {
        "identical": first is None and not missing and not changed and not any(shifts),
        "states": {"recorded": states, "replayed": len(replayed.states), "first_difference": first},
        "executed": {
            "recorded": len(recorded.executed),
            "replayed": len(replayed.executed),
            "missing": missing,
            "changed": changed,
            "shifted": sum(map(bool, shifts)),
            "largest_shift_ticks": max(shifts, key=abs, default=0),
        },
    }
