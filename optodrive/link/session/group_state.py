"""State of the boards of several stages as that of one, and the loss of one after which the others go on.

`board_group.py` says why they act as one.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from math import inf
from typing import Any, Literal, NamedTuple

from optodrive.core.clock import Clock
from optodrive.core.errors import InputError, LinkError, OptodriveError
from optodrive.link.protocol.states import ARMED_STATES, IDLE_STATES, LEASED_STATES, BoardState
from optodrive.link.session.arming import LeaseRenewal
from optodrive.link.session.board_view import BoardView
from optodrive.link.session.link_watch import LinkCause
from optodrive.link.session.session import BoardSession
from optodrive.link.session.staged_job import HostTime

RETRY_INTERVAL_S = 1.0
OPENING_WAIT_S = 0.02
"""Longest wait for a port that is being opened."""
CONNECTING = "connecting"
"""Code of the error until the first connection has succeeded or failed."""


class BoardConnector:
    """Connects one session, step by step.

    error: why the board is not reached, None once it is
    open_port: opens the port; returns False while it needs more time, raises LinkError or InputError on failure
    """

    def __init__(self, session: BoardSession, clock: Clock, open_port: Callable[[], bool]) -> None:
        self.error: OptodriveError | None = LinkError("the board is not reached yet")
        self.error.code = CONNECTING
        self._session = session
        self._clock = clock
        self._open_port = open_port
        self._silence: OptodriveError | None = None
        self._steps: Iterator[float] | None = None
        self._wait_s = 0.0
        self._retry_at_s = -inf

    def step(self) -> None:
        """Keep the connection, or go on with the next step to it. A failure becomes `error`."""
        try:
            if self._session.connected:
                # Connected while another board is not: its link is kept, and its light is not.
                self._session.step(0.0, renew_lease=False)
            elif self._steps is not None or self._clock.now_s() >= self._retry_at_s:
                self._steps = self._steps or self._connect()
                self._wait_s = next(self._steps)
                if self._session.is_silent and self.error is not self._silence:
                    self.error = self._silence = self._session.build_silence_error()
        except StopIteration:
            self._steps = self.error = None
        except (LinkError, InputError) as error:
            self.lose(error)

    def _connect(self) -> Iterator[float]:
        try:
            while not self._open_port():
                yield OPENING_WAIT_S
        except (LinkError, InputError):
            self._session.on_connect_failed()
            raise
        yield from self._session.connect_step_by_step()

    def lose(self, error: OptodriveError) -> None:
        """Record why the board is not reached, with the likely cause if it was, and try again later."""
        if self._session.connected:
            message = self._session.on_lost(error)
            error = LinkError(message) if isinstance(error, LinkError) else error
        self._steps, self.error = None, error
        # A port that was unplugged comes back in seconds; each opening resets some boards.
        self._retry_at_s = self._clock.now_s() + RETRY_INTERVAL_S

    def compute_wait_s(self) -> float:
        """Return the longest time for which the next step may wait if no bytes arrive, s."""
        if self._session.connected:
            return self._session.compute_wait_s()
        return OPENING_WAIT_S if self._steps is None else self._wait_s


OnStageLoss = Literal["all_dark", "that_stage"]
LEASE_TRANSIT_MAX_S = 0.06
"""Longest time from the host's last write to a board until its last lease begins there, and the skew of its clock.

Bytes in flight take 10 ms, twice that with a retransmission; USB adapters and drivers hold bytes for up to 16 ms.
"""


class LostStage(NamedTuple):
    """A stage that was lost while all were armed.

    reason: for people, without the stage's name
    dark_s: host time from which its board is dark for certain, even if nothing has reached it since: its lease has
    ended
    """

    stage: int
    reason: str
    dark_s: float


SUMS = ("done_index", "queued", "underruns", "crc_errors", "format_errors", "seq_errors", "laser_on_s")
STATE_ORDER = (
    BoardState.RUNNING,
    BoardState.HOLD,
    BoardState.ARMED,
    BoardState.ARMING,
    "UNKNOWN",
    BoardState.BOOT,
    BoardState.FAULT,
    BoardState.DISARMED,
)
"""States in the order in which one board's is that of all: while one may emit, they do not count as off."""


class GroupState:
    """Reports of the sessions with the boards of all stages, under the names of `BoardSession`.

    sessions: of each stage; open_ports: as for `BoardConnector`; names: of the stages, '' if there is one
    skew_max_s: largest error of a board's clock with which a plan may start
    lost: the stage without which the others go on, None without
    """

    def __init__(
        self,
        sessions: Sequence[BoardSession],
        clock: Clock,
        open_ports: Sequence[Callable[[], bool]],
        names: Sequence[str],
        skew_max_s: float,
    ) -> None:
        self.sessions = self._present = tuple(sessions)
        self.lost: LostStage | None = None
        self.names = tuple(names)
        pairs = zip(self.sessions, open_ports, strict=True)
        self._connectors = tuple(BoardConnector(session, clock, open_port) for session, open_port in pairs)
        self._clock = clock
        self.has_several = len(self.sessions) > 1
        self._host_time = HostTime(clock, self.tick_s, skew_max_s, self._name) if self.has_several else None

    @property
    def tick_s(self) -> float:
        """Duration of a tick of all boards, s."""
        return self.sessions[0].scale.tick_s

    @property
    def connected(self) -> bool:
        """Whether the links to all boards are up."""
        return all(session.connected for session in self._present)

    @property
    def port(self) -> str:
        """Names of all ports."""
        return ", ".join(session.port for session in self.sessions)

    @property
    def state(self) -> str:
        """State of the board that is nearest to light."""
        return min((session.board.state for session in self._present), key=STATE_ORDER.index)

    @property
    def fault(self) -> str:
        """Fault of the first board that has one, '' if none has."""
        return next((session.board.fault for session in self._present if session.board.fault), "")

    @property
    def board(self) -> BoardView:
        """Latest reports of all boards: the sums of their counts, `state` and `fault`."""
        boards = [session.board for session in self._present]
        if not self.has_several:
            return boards[0]
        faulty = next((board for board in boards if board.fault), boards[0])
        values = vars(faulty) | {name: sum(getattr(board, name) for board in boards) for name in SUMS}
        # The board with the least room holds up the plan.
        values["free_points"] = min(board.free_points for board in boards)
        values["temperature_c"] = max((b.temperature_c for b in boards if b.temperature_c is not None), default=None)
        values["state"] = self.state
        return BoardView(**values)

    @property
    def clock_sample(self) -> tuple[float, float] | None:
        """Host time and board_s() of one moment, s, None before the first exchange with each board."""
        if self._host_time is None:
            return self.sessions[0].clock_sample
        now_s = self._clock.now_s()
        return (now_s, now_s) if all(session.clock_sync.is_synchronised for session in self._present) else None

    def board_s(self) -> float:
        """Return the present time on the clock of the board, or of the host if there are several boards, s."""
        return self._clock.now_s() if self._host_time is not None else self.sessions[0].board_s()

    @property
    def faults(self) -> Counter[str]:
        """Number of times that the boards reported each fault."""
        total: Counter[str] = Counter()
        for session in self.sessions:
            total += session.faults
        return total

    @property
    def lease(self) -> LeaseRenewal:
        """Statistics of the lease renewals of the board that came nearest to its end."""
        renewals = [session.lease for session in self.sessions]
        return min(renewals, key=lambda lease: inf if lease.slack_s is None else lease.slack_s)

    @property
    def has_arming(self) -> bool:
        """Whether the arming of all boards is present: none has left the state that it had reached."""
        return all(session.has_arming for session in self._present)

    @property
    def is_ready(self) -> bool:
        """Whether a job may start now, or is refused because the time of a board has not become known in seconds."""
        time = self._host_time
        # Ready also when patience is over: the start is then refused by name, where the plan would else wait without a
        # word.
        return self._are_boards_ready and (time is None or time.are_known(self._present) or time.is_patience_over)

    @property
    def _are_boards_ready(self) -> bool:
        return all(session.is_ready for session in self._present)

    @property
    def is_acknowledged(self) -> bool:
        """Whether all boards have acknowledged everything sent."""
        return all(session.is_acknowledged for session in self._present)

    @property
    def abort_confirmed(self) -> bool:
        """Whether all boards have confirmed the last ABORT."""
        return all(session.abort_confirmed for session in self._present)

    @property
    def is_draining(self) -> bool:
        """Whether reports of points that were sent before drain() may still arrive, or a lost board may still emit."""
        # Draining covers both waits, for reports and for certain darkness: what is left is planned after the later one.
        may_emit = self.lost is not None and self._clock.now_s() < self.lost.dark_s
        return may_emit or any(session.is_draining for session in self._present)

    @property
    def has_lost_ended(self) -> bool:
        """Whether a lost board has confirmed that it is dark, or cannot because its link is down."""
        if self.lost is None:
            return True
        session = self.sessions[self.lost.stage]
        has_confirmed = session.is_acknowledged or session.abort_confirmed
        # Without its link nothing can be confirmed; its lease has ended by then or will.
        return not session.connected or (session.board.state in IDLE_STATES and has_confirmed)

    @property
    def has_points(self) -> bool:
        """Whether points were handed over whose execution is not yet reported."""
        return any(session.has_points for session in self._present)

    @property
    def _worst(self) -> BoardSession:
        """The session to blame: the one that has a fault, or has left the armed states."""
        suspects = [session for session in self._present if session.board.fault]
        suspects += [session for session in self._present if session.board.state not in ARMED_STATES]
        return suspects[0] if suspects else self._present[0]

    @property
    def last_event_reason(self) -> str:
        """Reason of the last event of the board that is to blame."""
        return self._worst.last_event_reason

    @property
    def likely_cause(self) -> LinkCause | None:
        """Likely cause of the last lost link or expired lease, None before the first."""
        causes = [session.likely_cause for session in self.sessions if session.likely_cause is not None]
        return max(causes, key=lambda cause: cause.noticed_s, default=None)

    def list_faults(self) -> list[str]:
        """Return the fault of each board, '' for none. That of a lost board is known."""
        return [session.board.fault for session in self.sessions]

    def describe_split(self) -> str:
        """Return which board has left the armed states while another is in them, '' if none has."""
        if not self.has_several or self.state not in ARMED_STATES:
            return ""
        for name, session in zip(self.names, self.sessions, strict=True):
            if session in self._present and session.board.state not in LEASED_STATES:
                return f"the board of stage {name!r} {describe_end(session)}"
        return ""

    def _name(self, session: BoardSession) -> str:
        return f"stage {self.names[self.sessions.index(session)]!r}: " if self.has_several else ""

    @property
    def link_error(self) -> OptodriveError | None:
        """Why a board is not reached, with the name of its stage, None once all are."""
        for session, connector in zip(self.sessions, self._connectors, strict=True):
            if connector.error is not None and session in self._present:
                if not self.has_several:
                    return connector.error
                error = LinkError(f"{self._name(session)}{connector.error}")
                error.code = connector.error.code
                return error
        return None

    def collect_link_stats(self) -> dict[str, Any]:
        """Return the statistics of all links: the sums of their counts, and the largest of their times."""
        stats = [session.collect_link_stats() for session in self.sessions]
        if not self.has_several:
            return stats[0]
        merged = dict(min(stats, key=lambda each: each["likely_cause_age_s"] or inf))
        for name in ("host_bad_frames", "retransmitted", "naks", "board_bad_frames", "underruns"):
            merged[name] = sum(each[name] for each in stats)
        for name in ("round_trip_ms", "silence_s", "longest_stall_ms"):
            merged[name] = max((each[name] for each in stats if each[name] is not None), default=None)
        return merged

    def list_stages(self) -> list[dict[str, Any]]:
        """Return name, port, board, link and clock of each of several stages, for the status, or nothing of one.

        A board without a link has no known state.
        """
        if not self.has_several:
            return []
        now_s = self._clock.now_s()
        stages = []
        for number, (session, connector) in enumerate(zip(self.sessions, self._connectors, strict=True)):
            lost = self.lost if self.lost is not None and self.lost.stage == number else None
            fit = session.clock_sync.fit(now_s) if session.connected else None
            stage: dict[str, Any] = {"name": self.names[number], "port": session.port, "connected": session.connected}
            stage["lost"] = None if lost is None else lost.reason
            stage["board"] = (session.board if session.connected else session.board.forget_state()).to_dict()
            stage["error"] = None if connector.error is None else str(connector.error)
            stage["clock_error_us"] = None if fit is None else 1e6 * fit.uncertainty_s
            stage["clock_drift_ppm"] = None if fit is None else 1e6 * (fit.rate - 1.0)
            stages.append(stage)
        return stages


def describe_end(session: BoardSession) -> str:
    """Return to which state a board has left its arming, and why."""
    board = session.board
    return f"went to {board.state} ({board.fault or session.last_event_reason})"
