"""Watches a link and the loop that serves it, and says what likely went wrong when something did."""

from collections import deque
from typing import NamedTuple

from optodrive.link.session.likely_cause import (
    LinkEvidence,
    describe_receive_errors,
    describe_replug,
    describe_restart,
    diagnose_lease_expiry,
    diagnose_link_loss,
    diagnose_port,
)
from optodrive.link.transport.port_state import PortState, read_port_state

EVIDENCE_WINDOW_S = 5.0
"""What happened longer ago explains nothing."""
SAMPLE_INTERVAL_S = 0.5


class LinkErrorCounts(NamedTuple):
    """Counters of the link since it was opened."""

    host_bad_frames: int = 0
    board_bad_frames: int = 0
    retransmitted: int = 0
    naks: int = 0


class LinkCause(NamedTuple):
    """A sentence, and when what it explains was noticed, host time in s."""

    message: str
    noticed_s: float


class LinkWatch:
    """One link's; the loop that owns the session calls it, any thread may read `cause` and `longest_gap_s`."""

    def __init__(self, port: str, lease_s: float) -> None:
        self.cause: LinkCause | None = None
        self.longest_stall_s = 0.0
        self._port = port
        self._lease_s = lease_s
        self._last_loop_s: float | None = None
        self._lease_withheld_s: float | None = None
        self._stall_s, self._stall_at_s = 0.0, 0.0
        self._samples: deque[tuple[float, LinkErrorCounts]] = deque()
        self._counts = LinkErrorCounts()
        self._fault = ""
        self._last_received_s: float | None = None
        self._board_bad_frames: int | None = None
        self._port_missing = False

    def on_opened(self) -> None:
        """The counters begin anew, and connecting was no turn of the loop."""
        self._samples.clear()
        self._counts, self._last_loop_s, self._fault = LinkErrorCounts(), None, ""

    def on_loop(self, now_s: float, may_renew_lease: bool, counts: LinkErrorCounts) -> None:
        """The loop is about to serve the link. lease: whether it may renew the lease."""
        self._record_stall(now_s)
        self._last_loop_s = now_s
        if not may_renew_lease:
            self._lease_withheld_s = now_s
        self._counts = counts
        if not self._samples or now_s - self._samples[-1][0] >= SAMPLE_INTERVAL_S:
            self._samples.append((now_s, counts))
        while now_s - self._samples[0][0] > EVIDENCE_WINDOW_S:
            self._samples.popleft()

    def _record_stall(self, now_s: float) -> None:
        if self._last_loop_s is None:
            return
        stall_s = now_s - self._last_loop_s
        self.longest_stall_s = max(self.longest_stall_s, stall_s)
        if stall_s >= self._stall_s or now_s - self._stall_at_s > EVIDENCE_WINDOW_S:
            self._stall_s, self._stall_at_s = stall_s, now_s

    def on_status(self, fault: str, now_s: float, counts: LinkErrorCounts) -> None:
        """The board told its fault, '' where it has none."""
        # A board that was found in this fault has it from another time, of which nothing is known here.
        if fault == "LINK" and self._fault != fault and self._last_loop_s is not None:
            self._record_stall(now_s)  # it may have stood still within this very turn, waiting for these bytes
            self._counts = counts
            self.cause = LinkCause(
                diagnose_lease_expiry(self._collect_evidence(now_s, PortState("available"), silent=False)), now_s
            )
        self._fault = fault

    def on_lost(self, now_s: float, last_received_s: float, silent: bool) -> LinkCause:
        """The link was given up; why, likely. heard_s: when the board was last heard; silent: that was why."""
        self._last_received_s = last_received_s
        self._board_bad_frames = self._counts.board_bad_frames if silent else None
        state = read_port_state(self._port)
        self._port_missing = state.status == "missing"
        self.cause = LinkCause(diagnose_link_loss(self._collect_evidence(now_s, state, silent)), now_s)
        return self.cause

    def on_reconnect_failed(self, now_s: float) -> None:
        """The link could not be opened again: the port may tell why."""
        state = read_port_state(self._port)
        self._port_missing = self._port_missing or state.status == "missing"
        message = diagnose_port(self._port, state)
        if message is not None and (self.cause is None or self.cause.message != message):
            self.cause = LinkCause(message, now_s)

    def on_reconnected(self, now_s: float, reset_code: int, uptime_s: float, counts: LinkErrorCounts) -> None:
        """The link is open again; a board younger than the last word heard of it has restarted."""
        if self._last_received_s is not None and uptime_s < now_s - self._last_received_s:
            self.cause = LinkCause(describe_restart(reset_code, uptime_s), now_s)
        elif self._board_bad_frames is not None and counts.board_bad_frames > self._board_bad_frames:
            self.cause = LinkCause(describe_receive_errors(counts.board_bad_frames - self._board_bad_frames), now_s)
        elif self._port_missing:
            self.cause = LinkCause(describe_replug(self._port), now_s)
        self._last_received_s = self._board_bad_frames = None
        self._port_missing = False

    def _collect_evidence(self, now_s: float, state: PortState, silent: bool) -> LinkEvidence:
        oldest = self._samples[0][1] if self._samples else LinkErrorCounts()
        recent = LinkErrorCounts(*(now - then for now, then in zip(self._counts, oldest, strict=True)))
        planner_stalled = (
            self._lease_withheld_s is not None and now_s - self._lease_withheld_s < self._lease_s + SAMPLE_INTERVAL_S
        )
        return LinkEvidence(
            port=self._port,
            port_state=state,
            silent=silent,
            lease_s=self._lease_s,
            stall_s=self._stall_s if now_s - self._stall_at_s <= EVIDENCE_WINDOW_S else 0.0,
            planner_stalled=planner_stalled,
            **recent._asdict(),
        )
