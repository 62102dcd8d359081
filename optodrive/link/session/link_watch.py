"""Watches a link and the loop that serves it, and says what likely went wrong when something did."""

from collections import deque
from typing import NamedTuple

from optodrive.link.session.likely_cause import (
    Evidence,
    port_cause,
    why_deaf,
    why_lease_lapsed,
    why_lost,
    why_restarted,
    why_there_again,
)
from optodrive.link.transport.port_state import PortState, port_state

RECENT_S = 5.0
"""What happened longer ago explains nothing."""
MARK_EVERY_S = 0.5


class Counts(NamedTuple):
    """Counters of the link since it was opened."""

    bad_here: int = 0
    bad_at_board: int = 0
    sent_again: int = 0
    naks: int = 0


class Cause(NamedTuple):
    """A sentence, and when what it explains was noticed, host time in s."""

    sentence: str
    at_s: float


class LinkWatch:
    """One link's; the loop that owns the session calls it, any thread may read `cause` and `longest_gap_s`."""

    def __init__(self, port: str, lease_s: float) -> None:
        self.cause: Cause | None = None
        self.longest_gap_s = 0.0
        self._port = port
        self._lease_s = lease_s
        self._turned_s: float | None = None
        self._withheld_s: float | None = None
        self._gap_s, self._gap_at_s = 0.0, 0.0
        self._marks: deque[tuple[float, Counts]] = deque()
        self._counts = Counts()
        self._fault = ""
        self._heard_s: float | None = None
        self._bad_at_board: int | None = None
        self._gone = False

    def opened(self) -> None:
        """The counters begin anew, and connecting was no turn of the loop."""
        self._marks.clear()
        self._counts, self._turned_s, self._fault = Counts(), None, ""

    def turn(self, now_s: float, lease: bool, counts: Counts) -> None:
        """The loop is about to serve the link. lease: whether it may renew the lease."""
        self._note_gap(now_s)
        self._turned_s = now_s
        if not lease:
            self._withheld_s = now_s
        self._counts = counts
        if not self._marks or now_s - self._marks[-1][0] >= MARK_EVERY_S:
            self._marks.append((now_s, counts))
        while now_s - self._marks[0][0] > RECENT_S:
            self._marks.popleft()

    def _note_gap(self, now_s: float) -> None:
        if self._turned_s is None:
            return
        gap_s = now_s - self._turned_s
        self.longest_gap_s = max(self.longest_gap_s, gap_s)
        if gap_s >= self._gap_s or now_s - self._gap_at_s > RECENT_S:
            self._gap_s, self._gap_at_s = gap_s, now_s

    def heard(self, fault: str, now_s: float, counts: Counts) -> None:
        """The board told its fault, '' where it has none."""
        # A board that was found in this fault has it from another time, of which nothing is known here.
        if fault == "LINK" and self._fault != fault and self._turned_s is not None:
            self._note_gap(now_s)  # it may have stood still within this very turn, waiting for these bytes
            self._counts = counts
            self.cause = Cause(why_lease_lapsed(self._evidence(now_s, PortState("there"), silent=False)), now_s)
        self._fault = fault

    def lost(self, now_s: float, heard_s: float, silent: bool) -> Cause:
        """The link was given up; why, likely. heard_s: when the board was last heard; silent: that was why."""
        self._heard_s = heard_s
        self._bad_at_board = self._counts.bad_at_board if silent else None
        state = port_state(self._port)
        self._gone = state.fate == "gone"
        self.cause = Cause(why_lost(self._evidence(now_s, state, silent)), now_s)
        return self.cause

    def not_back(self, now_s: float) -> None:
        """The link could not be opened again: the port may tell why."""
        state = port_state(self._port)
        self._gone = self._gone or state.fate == "gone"
        sentence = port_cause(self._port, state)
        if sentence is not None and (self.cause is None or self.cause.sentence != sentence):
            self.cause = Cause(sentence, now_s)

    def back(self, now_s: float, reset_code: int, uptime_s: float, counts: Counts) -> None:
        """The link is open again; a board younger than the last word heard of it has restarted."""
        if self._heard_s is not None and uptime_s < now_s - self._heard_s:
            self.cause = Cause(why_restarted(reset_code, uptime_s), now_s)
        elif self._bad_at_board is not None and counts.bad_at_board > self._bad_at_board:
            self.cause = Cause(why_deaf(counts.bad_at_board - self._bad_at_board), now_s)
        elif self._gone:
            self.cause = Cause(why_there_again(self._port), now_s)
        self._heard_s = self._bad_at_board = None
        self._gone = False

    def _evidence(self, now_s: float, state: PortState, silent: bool) -> Evidence:
        before = self._marks[0][1] if self._marks else Counts()
        recent = Counts(*(now - then for now, then in zip(self._counts, before, strict=True)))
        stuck = self._withheld_s is not None and now_s - self._withheld_s < self._lease_s + MARK_EVERY_S
        return Evidence(
            port=self._port,
            port_state=state,
            silent=silent,
            lease_s=self._lease_s,
            stall_s=self._gap_s if now_s - self._gap_at_s <= RECENT_S else 0.0,
            planner_stuck=stuck,
            **recent._asdict(),
        )
