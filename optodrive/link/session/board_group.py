"""The boards of all stages as one: they are armed, stopped and lost together, and keep the host's time.

Theory of operation

Problem. Several lasers draw one display, each with its scan head and its board. The thermal bound is proven for the
pulses of all in one order; a board that drifts, waits or is lost breaks the proof for the pixels of the others.
Everything above this module knows one board.

As one. State is that of the board nearest to light (`STATE_ORDER`): armed only when all are, dark only when all are. So
STOP is confirmed by the last one, and a plan begins when the last one is ready. Commands go to all; arming is refused
without effect if one cannot be armed. A fault, a lost link, or the silence of one for a lease ends the light of all;
the links of the others are kept, and the status lists each stage with its state and cause.

Lost alone. With `on_stage_loss = "that_stage"` the first board that leaves its arming, or whose link fails, once all
were armed, is *lost*, and the others go on (`_lose_alone`). It gets ABORT, and neither lease nor points even if it
answers again, because its arming has ended. Everything here then speaks of the others, except that STOP and disarm wait
for it while its link is up. The owner pauses them until it is dark for certain (`LostStage.dark_s`). A second loss ends
the light of all. It counts as lost until all are disarmed.

Time. One board keeps its own: `board_s` is its clock, its points follow each other by durations, and what is late is
executed late and reported. Several keep the host's (`host_time.py`): `board_s` is the host's clock.

Late light is not emitted. If one board would execute its next point late, all drop their points and stay armed
(`_drop_late_points`), and the plan has failed: light out of order is not covered by any proof.

Streams are cut at one time on all boards, behind every point that may have left; a splice is made on all or, if it is
too late on one, on none.

Why one process. STOP, epochs and leases would otherwise have to agree across processes. Decisions: 41, 42, 49.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from math import inf
from typing import Any

from optodrive.core.clock import Clock
from optodrive.core.errors import InputError, LinkError, NotReadyError, OptodriveError
from optodrive.link.protocol import messages as m
from optodrive.link.protocol.stage_points import StagePoints
from optodrive.link.protocol.states import ARMED_STATES, IDLE_STATES, LEASED_STATES, BoardState
from optodrive.link.session.board_connector import BoardConnector
from optodrive.link.session.board_view import BoardView
from optodrive.link.session.host_time import SEND_AHEAD_MAX_S, HostTime
from optodrive.link.session.lease_renewal import LeaseRenewal
from optodrive.link.session.link_watch import LinkCause
from optodrive.link.session.plan_job import PlanJob
from optodrive.link.session.session import BoardSession
from optodrive.link.session.stage_loss import LEASE_TRANSIT_MAX_S, LostStage, OnStageLoss
from optodrive.link.session.staged_job import StagedJob

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


class BoardGroup:
    """Sessions with the boards of all stages, under the names of `BoardSession`.

    sessions: of each stage; open_ports: as for `BoardConnector`; names: of the stages, '' if there is one
    skew_max_s: largest error of a board's clock with which a plan may start
    on_stage_loss: whether the others go on when one is lost; lost: that one, None without
    """

    def __init__(
        self,
        sessions: Sequence[BoardSession],
        clock: Clock,
        open_ports: Sequence[Callable[[], bool]],
        names: Sequence[str] = ("",),
        skew_max_s: float = inf,
        on_stage_loss: OnStageLoss = "all_dark",
    ) -> None:
        self.sessions = tuple(sessions)
        self.lost: LostStage | None = None
        self._present = self.sessions
        self._on_stage_loss = on_stage_loss
        self._were_armed = self._is_loss_new = False
        self.names = tuple(names)
        pairs = zip(self.sessions, open_ports, strict=True)
        self._connectors = tuple(BoardConnector(session, clock, open_port) for session, open_port in pairs)
        self._clock = clock
        self._refusal: str | None = None
        self.has_several = len(self.sessions) > 1
        self._host_time = HostTime(clock, self.tick_s, skew_max_s, self._name) if self.has_several else None
        self.on_executed: Callable[[int, m.Executed], None] = lambda stage, message: None
        for stage, session in enumerate(self.sessions):
            session.on_executed = partial(self._forward_executed, stage)

    def _forward_executed(self, stage: int, message: m.Executed) -> None:
        if self.sessions[stage] not in self._present:
            return
        if self._host_time is not None:
            message = self._host_time.convert_report(self.sessions[stage], message)
        self.on_executed(stage, message)

    # --- state --------------------------------------------------------------------------------------------------

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
    def board(self) -> BoardView:
        """Latest reported state of all boards: the sums of their counts, and the state of the one nearest to light."""
        boards = [session.board for session in self._present]
        if not self.has_several:
            return boards[0]
        faulty = next((board for board in boards if board.fault), boards[0])
        values = vars(faulty) | {name: sum(getattr(board, name) for board in boards) for name in SUMS}
        values["free_points"] = min(board.free_points for board in boards)
        values["temperature_c"] = max((b.temperature_c for b in boards if b.temperature_c is not None), default=None)
        values["state"] = min((board.state for board in boards), key=STATE_ORDER.index)
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
        may_emit = self.lost is not None and self._clock.now_s() < self.lost.dark_s
        return may_emit or any(session.is_draining for session in self._present)

    @property
    def has_lost_ended(self) -> bool:
        """Whether a lost board has confirmed that it is dark, or cannot because its link is down."""
        if self.lost is None:
            return True
        session = self.sessions[self.lost.stage]
        has_confirmed = session.is_acknowledged or session.abort_confirmed
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
        if not self.has_several or self.board.state not in ARMED_STATES:
            return ""
        for name, session in zip(self.names, self.sessions, strict=True):
            if session in self._present and session.board.state not in LEASED_STATES:
                return f"the board of stage {name!r} {_describe_end(session)}"
        return ""

    def _name(self, session: BoardSession) -> str:
        return f"stage {self.names[self.sessions.index(session)]!r}: " if self.has_several else ""

    # --- connecting ---------------------------------------------------------------------------------------------

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

    def step_connecting(self) -> None:
        """Go on with the connections of the boards that are not reached, and keep those of the others."""
        for connector in self._connectors:
            connector.step()

    def close(self) -> None:
        """Send ABORT if possible and close all links permanently."""
        for session in self.sessions:
            session.close()

    # --- loop ---------------------------------------------------------------------------------------------------

    def step(self, wait_s: float, renew_lease: bool, stalled: str = "planner") -> None:
        """Run one iteration of each session, as `BoardSession.step`. Only one waits for bytes.

        A board whose link fails is lost alone, or the others, whose links stay open, get ABORT and the error is raised.
        """
        self._readmit_lost()
        self._drop_late_points()
        if self._host_time is not None:
            self._host_time.seek(self._present, self._are_boards_ready)
        waiting = self._present[0]
        for session, connector in zip(self.sessions, self._connectors, strict=True):
            if session not in self._present or not session.connected:
                connector.step()
                continue
            try:
                session.step(wait_s if session is waiting else 0.0, renew_lease, stalled)
            except (LinkError, InputError) as error:
                connector.lose(error)
                if not self._lose_alone(session, str(connector.error)):
                    self.abort()
                    raise
            else:
                if self._were_armed and not session.has_arming:
                    self._lose_alone(session, f"the board {_describe_end(session)}")
        self._were_armed |= self.has_arming and all(one.board.state in ARMED_STATES for one in self._present)

    # --- loss of one --------------------------------------------------------------------------------------------

    def _lose_alone(self, session: BoardSession, reason: str) -> bool:
        """Go on without a board. Return False if all must go dark: so configured, not all armed, or a second one."""
        can_go_on = self._on_stage_loss == "that_stage" and self._were_armed and self.lost is None
        if not can_go_on:
            return False
        session.end_arming()
        if session.connected:
            session.abort()
        dark_s = self._clock.now_s() + session.lease_s + LEASE_TRANSIT_MAX_S
        self.lost = LostStage(self.sessions.index(session), reason, dark_s)
        self._present = tuple(one for one in self.sessions if one is not session)
        self._is_loss_new = True
        return True

    def pop_loss(self) -> bool:
        """Return whether a board was lost since the last call: the others must be dark until it is so for certain."""
        is_new, self._is_loss_new = self._is_loss_new, False
        return is_new

    def _readmit_lost(self) -> None:
        """Count the lost board again once all others are disarmed, and it too, as far as its link is up."""
        are_idle = all(session.board.state in IDLE_STATES and session.is_acknowledged for session in self._present)
        if self.lost is not None and not self.has_arming and are_idle and self.has_lost_ended:
            self.lost, self._present = None, self.sessions

    def _drop_late_points(self) -> None:
        """Drop the points of all boards if one would execute its next point late."""
        if not self.has_several or self.is_draining:
            return
        lateness_s, session = max(((one.find_lateness_s(), one) for one in self._present), key=lambda item: item[0])
        if lateness_s > 0.0 and session.board.state in ARMED_STATES:
            self.flush()
            self._refusal = f"{self._name(session)}light would have been {1e3 * lateness_s:.3g} ms late"

    def compute_wait_s(self) -> float:
        """Return the longest time for which the next step may wait if no bytes arrive, s."""
        return min(connector.compute_wait_s() for connector in self._connectors)

    def pop_refusal(self) -> str | None:
        """Return and clear the reason for which a board, or this group, refused the last command."""
        refusal, self._refusal = self._refusal, None
        for session in self._present:
            refused = session.pop_refusal()
            if refused is not None:
                refusal = refusal or f"{self._name(session)}{refused}"
                if self.has_several and session.board.state in ARMED_STATES:
                    self.flush()
        return refusal

    # --- commands -----------------------------------------------------------------------------------------------

    def arm(self) -> None:
        """Request arming of all boards. Raise NotReadyError, without an effect, if one cannot be armed."""
        if self.lost is not None:
            raise NotReadyError(f"stage {self.names[self.lost.stage]!r} was lost; disarm all boards first")
        self._were_armed = False
        for session in self.sessions:
            session.require_disarmed(self._name(session))
        for session in self.sessions:
            session.arm()

    def disarm(self) -> None:
        """Disarm all boards, or acknowledge their faults."""
        for session in self.sessions:
            if session.connected:
                session.disarm()

    def abort(self) -> None:
        """Turn all gates off, drop the queues and disarm, before all other queued messages."""
        for session in self.sessions:
            if session.connected:
                session.abort()

    def end_arming(self) -> None:
        """End the arming of all boards: neither lease nor confirmation, nor points handed over so far."""
        self._were_armed = self._is_loss_new = False
        for session in self.sessions:
            session.end_arming()

    def flush(self) -> None:
        """Turn all gates off and drop the queues. The boards stay armed."""
        for session in self._present:
            session.flush()

    def drain(self) -> None:
        """Turn all gates off, drop the queues and collect the last reports. The boards stay armed."""
        for session in self._present:
            session.drain()

    # --- streaming ----------------------------------------------------------------------------------------------

    def begin(self, points: StagePoints, start_s: float, send_ahead_s: float = inf) -> StagedJob:
        """Start to stream a plan whose zero is at start_s of board_s().

        send_ahead_s: maximum time from sending a point to its start
        Raise NotReadyError if the time of a board is not known as exactly as several need it.
        """
        if self._host_time is None:
            part = self.sessions[0].begin(points.stages[0], start_s, send_ahead_s)
            return StagedJob([part], part.start_tick)
        self._require_nothing_lost(points)
        self._host_time.require_known(self._present)
        zero_tick, ahead_s, parts = round(start_s / self.tick_s), min(send_ahead_s, SEND_AHEAD_MAX_S), []
        for session, one in zip(self.sessions, points.stages, strict=True):
            if session not in self._present:
                parts.append(PlanJob(0, one, 0, 0))
                continue
            timing = self._host_time.build_timing(session, zero_tick)
            parts.append(session.begin(one, timing.to_board_tick(zero_tick) * self.tick_s, ahead_s, timing))
        return StagedJob(parts, zero_tick)

    def _require_nothing_lost(self, points: StagePoints) -> None:
        """Raise NotReadyError if a lost board would get points."""
        if self.lost is not None and len(points.stages[self.lost.stage]):
            raise NotReadyError(f"stage {self.names[self.lost.stage]!r} was lost: {self.lost.reason}")

    def splice(self, points: StagePoints, kept_points: Sequence[int], send_ahead_s: float) -> StagedJob | None:
        """Truncate the last job to `kept_points` points of each stage and continue with `points` without a pause.

        Return None, with nothing changed, if it is too late for that on one board.
        """
        self._require_nothing_lost(points)
        triples = list(zip(self.sessions, points.stages, kept_points, strict=True))
        if not all(session.can_splice(kept) for session, _, kept in triples if session in self._present):
            return None
        parts = []
        for session, one, kept in triples:
            if session not in self._present:
                parts.append(PlanJob(0, one, 0, 0))
                continue
            timing, last = None, session.last_job
            if self._host_time is not None and last is not None:
                timing = self._host_time.build_timing(session, last.find_host_end_tick(kept))
            part = session.splice(one, kept, min(send_ahead_s, SEND_AHEAD_MAX_S) if timing else send_ahead_s, timing)
            if part is None:
                raise LinkError("a board could not be spliced although the others were")
            parts.append(part)
        return StagedJob(parts, parts[0].start_tick)

    def extend(self, job: StagedJob, points: StagePoints) -> bool:
        """Append points to the last job without a pause. Return False, with nothing changed, if it is too late.

        Several boards end each job at the same time, with the gate off, so theirs are not extended.
        """
        session = self.sessions[0]
        if self.has_several or not session.can_extend(job.parts[0]):
            return False
        job.extend(points)
        session.follow_extended()
        return True

    def truncate(self, kept_points: Sequence[int]) -> bool:
        """Truncate the last job to `kept_points` points of each stage. Return False, unchanged, if more were sent."""
        pairs = [pair for pair in zip(self.sessions, kept_points, strict=True) if pair[0] in self._present]
        can_truncate = all(session.can_truncate(kept) for session, kept in pairs)
        return can_truncate and all(session.truncate(kept) for session, kept in pairs)

    def find_first_sent_tick(self, job: StagedJob) -> float | None:
        """Return the tick of board_s() at which the first point of a job was sent, None before."""
        if self._host_time is None:
            return job.first_sent_tick
        return self._host_time.find_first_sent_tick(job, self.sessions)

    # --- statistics ---------------------------------------------------------------------------------------------

    def collect_link_stats(self) -> dict[str, Any]:
        """Return the statistics of all links: the sums of their counts, and the largest of their times."""
        stats = [session.collect_link_stats() for session in self.sessions]
        if not self.has_several:
            return stats[0]
        merged = dict(min(stats, key=lambda each: each["likely_cause_age_s"] or inf))
        for name in ("host_bad_frames", "retransmitted", "naks", "board_bad_frames", "underruns"):
            merged[name] = sum(each[name] for each in stats)
        for name in ("round_trip_ms", "longest_stall_ms"):
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


def _describe_end(session: BoardSession) -> str:
    """Return to which state a board has left its arming, and why."""
    board = session.board
    return f"went to {board.state} ({board.fault or session.last_event_reason})"
