"""Status of the link process: its members, when it is published, and the planner's view of it."""

import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from math import inf
from typing import Any, NamedTuple, Self

from optodrive.core.clock import Clock
from optodrive.core.histogram import Histogram
from optodrive.core.ipc import Message
from optodrive.core.processes import has_realtime_priority
from optodrive.link.service.control import NO_PAUSE, Control, Epoch, Pauses, PauseStatus
from optodrive.link.session.arming import AGE_BUCKETS_S
from optodrive.link.session.board_group import BoardGroup
from optodrive.link.session.board_view import BoardView
from optodrive.link.session.clock_sync import ClockReading
from optodrive.link.session.group_state import LostStage
from optodrive.link.session.link_watch import LinkCause

NO_EPOCH = 0
"""Epoch while the link process is not reached. No request carries it."""
INTERVAL_S = 0.1


class LeaseStatus(NamedTuple):
    """Distribution of the intervals of the lease's renewals, s, and the minimum remaining lease, None before any."""

    counts: list[int]
    sum_s: float
    slack_s: float | None


NO_LEASE = LeaseStatus([0] * (len(AGE_BUCKETS_S) + 1), 0.0, None)


@dataclass(eq=False)
class ServiceStatus:
    """Members of a message of kind `status`. The defaults are those of a link process that is not reached.

    epoch: latest epoch, NO_EPOCH without a link process; epoch_reason: what raised it, as an end of a sentence
    connected: whether the link to all boards is up; link_error, link_error_code: why not, None once it is
    port: name of the board's port; board: latest reported state of the board; stats: link statistics
    faults: number of times that the boards reported each fault; lease: of the board that came nearest to its end
    clock: host time and board_s() of one moment, s, None before the first exchange with each board
    is_startable: whether a job may start; is_acknowledged: whether the boards have acknowledged everything sent
    likely_cause: of the last lost link or expired lease, None before the first
    control: who armed the board, None while it is not armed
    commands: number of the planner's commands carried out since it connected
    stalled: role of the process that withholds the lease, so that the board cannot be armed; '' if none does
    stages: of several, name, port, board and clock of each
    lost: the stage that was lost while the others go on, None without
    is_realtime: whether the link process runs before all programs of usual priority
    """

    epoch: int = NO_EPOCH
    epoch_reason: str = ""
    connected: bool = False
    link_error: str | None = None
    link_error_code: str | None = None
    port: str = ""
    board: BoardView = field(default_factory=BoardView)
    stats: dict[str, Any] = field(default_factory=dict)
    faults: Counter[str] = field(default_factory=Counter)
    lease: LeaseStatus = NO_LEASE
    clock: tuple[float, float] | None = None
    is_startable: bool = False
    is_acknowledged: bool = False
    last_event_reason: str = ""
    likely_cause: LinkCause | None = None
    pause: PauseStatus = NO_PAUSE
    control: dict[str, Any] | None = None
    commands: int = 0
    stalled: str = ""
    stages: list[dict[str, Any]] = field(default_factory=list)
    lost: LostStage | None = None
    is_realtime: bool = False

    def to_message(self) -> Message:
        """Return the status as a message."""
        members = {**vars(self), "board": self.board.to_dict(), "faults": dict(self.faults)}
        for name in ("lease", "pause", "lost"):
            members[name] = None if members[name] is None else members[name]._asdict()
        return Message("status", members)

    @classmethod
    def from_fields(cls, fields: Mapping[str, Any]) -> Self:
        """Return the status whose fields `to_message` wrote."""
        members = dict(fields)
        if "board" in members:
            members["board"] = BoardView.from_dict(members["board"])
        members["faults"] = Counter(members.get("faults"))
        tuples: dict[str, Any] = {"lease": LeaseStatus, "pause": PauseStatus, "lost": LostStage}
        for name, kind in tuples.items():
            if members.get(name) is not None:
                members[name] = kind(**members[name])
        if members.get("likely_cause") is not None:
            members["likely_cause"] = LinkCause(*members["likely_cause"])
        return cls(**members)


class StatusPublisher:
    """Builder of the status for clients: on each change that matters to them, and at least every tenth of a second."""

    def __init__(self, boards: BoardGroup, clock: Clock) -> None:
        self._boards = boards
        self._clock = clock
        self._due_s = -inf
        self._published: tuple[object, ...] = ()

    def mark_due(self) -> None:
        """Publish at the next opportunity, for a new client."""
        self._due_s = -inf

    def build_if_due(
        self,
        epoch: Epoch,
        control: Control | None,
        pauses: Pauses,
        commands: int,
        stalled: str,
    ) -> Message | None:
        """Return the status if something relevant has changed or the interval has passed, else None."""
        boards, link_error = self._boards, self._boards.link_error
        outcome = boards.is_ready, boards.last_event_reason, boards.likely_cause
        causes = None if control is None else control.arming, commands, stalled, *outcome
        pause = pauses.number, pauses.is_paused
        links = boards.connected, None if link_error is None else str(link_error)
        states = tuple(session.board.state for session in boards.sessions)
        key = (epoch.number, pause, links, states, boards.lost, boards.state, boards.fault, *causes)
        now_s = self._clock.now_s()
        # Counters and clocks change all the time: they wait for the interval, so that a busy link is not busier by it.
        if key == self._published and now_s < self._due_s:
            return None
        self._published, self._due_s = key, now_s + INTERVAL_S
        return ServiceStatus(
            epoch=epoch.number,
            epoch_reason=epoch.reason,
            connected=boards.connected,
            link_error=None if link_error is None else str(link_error),
            link_error_code=None if link_error is None else link_error.code,
            port=boards.port,
            board=boards.board,
            stats=boards.collect_link_stats(),
            faults=boards.faults,
            lease=LeaseStatus(boards.lease.ages.counts, boards.lease.ages.sum, boards.lease.slack_s),
            clock=boards.clock_sample,
            is_startable=boards.connected and boards.is_ready and not pauses.is_paused,
            is_acknowledged=boards.is_acknowledged,
            last_event_reason=boards.last_event_reason,
            likely_cause=boards.likely_cause,
            pause=pauses.build_status(),
            control=None if control is None else control.to_dict(now_s),
            commands=commands,
            stalled=stalled,
            stages=boards.list_stages(),
            lost=boards.lost,
            is_realtime=has_realtime_priority(),
        ).to_message()


class LinkStatus(ServiceStatus):
    """The last status, and the board's clock as it states it. One thread calls all but `board_s`, which any may call.

    dark_s: host time from which every board that was lost so far is dark for certain
    lease_ages: distribution of the intervals of the lease's renewals, s
    """

    def __init__(self, clock: Clock) -> None:
        super().__init__(link_error="the link process is not reached yet", link_error_code="link")
        self.dark_s = -inf
        self.lease_ages = Histogram(AGE_BUCKETS_S)
        self._clock = clock
        self._clock_sample: tuple[float, float] | None = None
        self._clock_shift_s: float | None = None

    def _take_status(self, status: ServiceStatus) -> None:
        # The clock first: it tells a new connection by `connected` of the status before.
        self._update_clock(status.clock, status.connected)
        vars(self).update(vars(status))
        if self.lost is not None:
            self.dark_s = max(self.dark_s, self.lost.dark_s)
        self.lease_ages.load(self.lease.counts, self.lease.sum_s)

    def _take_end(self, reason: str) -> None:
        self.connected = self.is_acknowledged = self.is_startable = False
        self.pause = self.pause._replace(ends_in_s=None)
        self.epoch, self.epoch_reason = NO_EPOCH, reason
        self.link_error, self.link_error_code = reason, "link"

    def _update_clock(self, sample: tuple[float, float] | None, connected: bool) -> None:
        if sample is None or not connected:
            return
        midpoint_s, board_s = sample
        if not self.connected and self._clock_sample is not None:
            now_s = self._clock.now_s()
            self._clock_shift_s = board_s + (now_s - midpoint_s) - self.board_s()
        self._clock_sample = midpoint_s, board_s

    def list_uids(self) -> list[str]:
        """Return the uid of the board of each stage, '' for one that was never reached."""
        return [stage["board"]["uid"] for stage in self.stages] or [self.board.uid]

    def read_clocks(self) -> ClockReading | None:
        """Return the present time on all clocks, None before the first status with a synchronised clock."""
        sample, now_s = self._clock_sample, self._clock.now_s()
        if sample is None:
            return None
        return ClockReading(sample[1] + (now_s - sample[0]), now_s, time.time())

    @property
    def pause_ends_in_s(self) -> float | None:
        """Time until the pause ends disarmed, s, None if the light is not paused."""
        return self.pause.ends_in_s

    @property
    def lease_slack_s(self) -> float | None:
        """Minimum remaining lease, s."""
        return self.lease.slack_s

    @property
    def round_trip_s(self) -> float:
        """Shortest recent round trip from the link process to the board, s, 0 before the first."""
        round_trip_ms: float | None = self.stats.get("round_trip_ms")
        return 0.0 if round_trip_ms is None else 1e-3 * round_trip_ms

    def board_s(self) -> float:
        """Return the present board time, s, or 0 before the first status with a synchronised clock."""
        sample = self._clock_sample
        return 0.0 if sample is None else sample[1] + (self._clock.now_s() - sample[0])

    def pop_clock_shift(self) -> float | None:
        """Return and clear the jump of the board's clock at a reconnection, s, None without a reconnection."""
        shift_s, self._clock_shift_s = self._clock_shift_s, None
        return shift_s
