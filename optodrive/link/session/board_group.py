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

Time. One board keeps its own: `board_s` is its clock, and its points follow each other by durations. Several keep the
host's (`staged_job.py`): `board_s` is the host's clock.

Late light is not emitted. If a board would execute its next point late (`describe_lateness`), the owner drains all: its
width is for heat that has decayed, and light out of order is not covered by any proof.

Streams are cut at one time on all boards, behind every point that may have left; a splice is made on all or, if it is
too late on one, on none.

Why one process. STOP, epochs and leases would otherwise have to agree across processes. Decisions: 41, 42.
"""

from collections.abc import Callable, Sequence
from functools import partial
from math import inf

from optodrive.core.clock import Clock
from optodrive.core.errors import InputError, LinkError, NotReadyError
from optodrive.link.protocol import messages as m
from optodrive.link.protocol.stage_points import StagePoints
from optodrive.link.protocol.states import ARMED_STATES, IDLE_STATES
from optodrive.link.session.group_state import LEASE_TRANSIT_MAX_S, GroupState, LostStage, OnStageLoss, describe_end
from optodrive.link.session.plan_job import PlanJob
from optodrive.link.session.session import BoardSession
from optodrive.link.session.staged_job import SEND_AHEAD_MAX_S, StagedJob


class BoardGroup(GroupState):
    """Sessions with the boards of all stages, under the names of `BoardSession`. Parameters as of `GroupState`.

    on_stage_loss: whether the others go on when one is lost
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
        super().__init__(sessions, clock, open_ports, names, skew_max_s)
        self._on_stage_loss = on_stage_loss
        self._were_armed, self._new_loss = False, ""
        self.on_executed: Callable[[int, m.Executed], None] = lambda stage, message: None
        for stage, session in enumerate(self.sessions):
            session.on_executed = partial(self._forward_executed, stage)

    def _forward_executed(self, stage: int, message: m.Executed) -> None:
        # Reports of a lost board come too late for a plan: what it may have emitted was counted in full when it was
        # lost.
        if self.sessions[stage] not in self._present:
            return
        if self._host_time is not None:
            message = self._host_time.convert_report(self.sessions[stage], message)
        self.on_executed(stage, message)

    # --- connecting ---------------------------------------------------------------------------------------------

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
        # First: a board that has come back takes part from this turn on, or the next arming would miss it.
        self._readmit_lost()
        if self._host_time is not None:
            self._host_time.seek(self._present, self._are_boards_ready)
        # One wait per turn, or the leases of several boards would be renewed a wait apart.
        waiting = self._present[0]
        for session, connector in zip(self.sessions, self._connectors, strict=True):
            # Also of a lost board: its link is kept, so that it can be disarmed and armed again with the others.
            if session not in self._present or not session.connected:
                connector.step()
                continue
            try:
                session.step(wait_s if session is waiting else 0.0, renew_lease, stalled)
            except (LinkError, InputError) as error:
                # It sends this board's ABORT; the lines below decide about the others.
                connector.lose(error)
                if not self._lose_alone(session, str(connector.error)):
                    self.abort()
                    raise
            else:
                if self._were_armed and not session.has_arming:
                    self._lose_alone(session, f"the board {describe_end(session)}{session.describe_port_fault('; ')}")
        # Only once all were armed may one be lost alone: a loss while boards arm ends all.
        self._were_armed |= self.has_arming and all(one.board.state in ARMED_STATES for one in self._present)

    # --- loss of one --------------------------------------------------------------------------------------------

    def _lose_alone(self, session: BoardSession, reason: str) -> bool:
        """Go on without a board. Return False if all must go dark: so configured, not all armed, or a second one."""
        can_go_on = self._on_stage_loss == "that_stage" and self._were_armed and self.lost is None
        if not can_go_on:
            return False
        # Before its ABORT: neither lease nor points even if the ABORT fails and it answers again.
        session.end_arming()
        if session.connected:
            session.abort()
        # By its lease alone: what a board that has failed says about itself proves nothing.
        dark_s = self._clock.now_s() + session.lease_s + LEASE_TRANSIT_MAX_S
        self.lost = LostStage(self.sessions.index(session), reason, dark_s)
        self._present = tuple(one for one in self.sessions if one is not session)
        self._new_loss = reason
        return True

    def pop_loss(self) -> str:
        """Return why a board was lost since the last call, '' if none: the others are dark until it is for certain."""
        reason, self._new_loss = self._new_loss, ""
        return reason

    def _readmit_lost(self) -> None:
        """Count the lost board again once all others are disarmed, and it too, as far as its link is up."""
        # Acknowledged: an idle state may be from before a command that is on its way.
        are_idle = all(session.board.state in IDLE_STATES and session.is_acknowledged for session in self._present)
        if self.lost is not None and not self.has_arming and are_idle and self.has_lost_ended:
            self.lost, self._present = None, self.sessions

    def describe_lateness(self) -> str:
        """Return which board would execute its next point late, and why, '' if none would."""
        return next((f"{self._name(one)}{late}" for one in self._present if (late := one.describe_lateness())), "")

    def compute_wait_s(self) -> float:
        """Return the longest time for which the next step may wait if no bytes arrive, s."""
        return min(connector.compute_wait_s() for connector in self._connectors)

    def pop_refusal(self) -> str | None:
        """Return and clear the reason for which a board refused the last command."""
        refusal = None
        for session in self._present:
            refused = session.pop_refusal()
            if refused is not None:
                refusal = refusal or f"{self._name(session)}{refused}"
                if self.has_several and session.board.state in ARMED_STATES:
                    # One board refused its points: the others must not draw their part of the plan alone.
                    self.flush()
        return refusal

    # --- commands -----------------------------------------------------------------------------------------------

    def arm(self) -> None:
        """Request arming of all boards. Raise NotReadyError, without an effect, if one cannot be armed."""
        if self.lost is not None:
            raise NotReadyError(f"stage {self.names[self.lost.stage]!r} was lost; disarm all boards first")
        self._were_armed = False
        # All are asked first: armed one by one, a refusal by the second would leave the first armed.
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
        # A loss that nobody has read yet is of the arming that ends here.
        self._were_armed, self._new_loss = False, ""
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
                # An empty job keeps the lost stage's place: rows and reports are found by stage number.
                parts.append(PlanJob(0, one, 0, 0))
                continue
            timing = self._host_time.build_timing(session, zero_tick)
            parts.append(session.begin(one, timing.to_board_tick(zero_tick) * self.tick_s, ahead_s, timing))
        return StagedJob(parts, zero_tick)

    def _require_nothing_lost(self, points: StagePoints) -> None:
        """Raise NotReadyError if a lost board would get points."""
        if self.lost is not None and len(points.stages[self.lost.stage]):
            raise NotReadyError(f"stage {self.names[self.lost.stage]!r} was lost: {self.lost.reason}")

    def splice(
        self, points: StagePoints, kept_points: Sequence[int], send_ahead_s: float, holds_first: bool = False
    ) -> StagedJob | None:
        """Truncate the last job to `kept_points` points of each stage and continue with `points` without a pause.

        holds_first: as for `PlanJob`

        Return None, with nothing changed, if it is too late for that on one board.
        """
        self._require_nothing_lost(points)
        triples = list(zip(self.sessions, points.stages, kept_points, strict=True))
        # All or none, decided before anything changes.
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
            ahead_s = min(send_ahead_s, SEND_AHEAD_MAX_S) if timing else send_ahead_s
            part = session.splice(one, kept, ahead_s, timing, holds_first)
            if part is None:
                # It said that it could, in the same turn. Should it happen, the link's end makes all dark.
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
        # The job first: follow_extended reads its new end.
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
