"""Planner thread that plans sequences and verifies the wire bytes before the engine's loop accepts them."""

import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import count
from typing import NamedTuple, Protocol, TypeVar

from optodrive.core.clock import Clock
from optodrive.core.types.plans import BudgetState
from optodrive.core.types.policy import Policy
from optodrive.core.types.stimuli import FrameSequence
from optodrive.daemon.one_process.plan_queue import PlanQueue
from optodrive.daemon.one_process.plan_record import PlanRecord
from optodrive.daemon.one_process.planning_snapshot import PlanningSnapshot
from optodrive.daemon.responses.plan import PlanReport
from optodrive.link.protocol.quantisation import decode, quantise
from optodrive.link.session.session import BoardSession
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.feasibility.check import check_feasibility
from optodrive.planning.feasibility.report import FeasibilityReport, FitMode
from optodrive.planning.limiter.limiter import verify
from optodrive.planning.pipeline import plan_sequence
from optodrive.planning.planned_sequence import PlannedSequence
from optodrive.planning.stimuli.streamed_frame import can_split, stale_pixels_first

STALL_TIMEOUT_S = 2.0
"""A planner without progress for this time counts as stalled, and the lease is no longer renewed."""
INITIAL_PLANNING_S = 0.01
PLANNING_TIME_FACTOR = 1.5
"""Planning time reserved for a streamed plan, as a multiple of the last one."""
SPLICE_TRIES = 2
"""Number of late attempts to splice a streamed plan, after which the running stream is truncated."""
DRY_RUN_ID = "dry-run"
"""Identifier in the report of a dry run, which is not stored."""
T = TypeVar("T")


class LoopRunner(Protocol):
    """Function that runs an action in the loop's thread, which owns the session."""

    def __call__(self, action: Callable[[], T]) -> T:
        """Return the result of the action. Raise LinkError if the loop has ended."""


class PlanningRequest(NamedTuple):
    """Request for a plan. build: returns the sequence; arrived_s: board time; caller: name of its token."""

    build: Callable[[], FrameSequence]
    name: str
    dry_run: bool
    policy: Policy
    fit: FitMode
    streamed: bool
    arrived_s: float
    caller: str


class Planner:
    """Planner of one sequence at a time.

    run_in_loop: runs an action in the loop's thread
    require_armed: raises NotReadyError if the board accepts no plans
    """

    def __init__(
        self,
        display: DisplayModel,
        session: BoardSession,
        plan_queue: PlanQueue,
        clock: Clock,
        run_in_loop: LoopRunner,
        require_armed: Callable[[], None],
    ) -> None:
        self._display = display
        self._session = session
        self._plan_queue = plan_queue
        self._clock = clock
        self._run_in_loop = run_in_loop
        self._require_armed = require_armed
        self._executor = ThreadPoolExecutor(1, thread_name_prefix="planner")
        self._lock = threading.Lock()
        self._ids = count(1)
        self._pending_count = 0
        self._progress_at_s = clock.now_s()
        self._last_planning_s = INITIAL_PLANNING_S

    @property
    def is_busy(self) -> bool:
        """Whether requests are in progress or waiting."""
        return self._pending_count > 0

    @property
    def is_alive(self) -> bool:
        """Whether the planner is idle or makes progress."""
        with self._lock:
            return self._pending_count == 0 or self._clock.now_s() - self._progress_at_s < STALL_TIMEOUT_S

    def close(self) -> None:
        """Cancel the waiting requests."""
        self._executor.shutdown(wait=False, cancel_futures=True)

    def submit(self, request: PlanningRequest) -> "Future[PlanReport]":
        """Queue a request and return the future of its plan's report. Any thread may call it."""
        with self._lock:
            if self._pending_count == 0:
                self._progress_at_s = self._clock.now_s()
            self._pending_count += 1
        return self._executor.submit(self._process, request)

    def _process(self, request: PlanningRequest) -> PlanReport:
        try:
            self._record_progress(0.0)
            sequence = request.build()
            planning_time_s, late_count = PLANNING_TIME_FACTOR * self._last_planning_s, 0
            while True:
                if not request.dry_run:
                    self._require_armed()
                if request.streamed and self._plan_queue.must_preempt:
                    self._run_in_loop(self._plan_queue.preempt)
                record = self._plan_once(sequence, request, planning_time_s)
                if record is not None:
                    return record.build_report(self._session.board_s())
                # The snapshot is stale: a predecessor was late, or has sent points beyond the splice.
                late_count += 1
                planning_time_s = PLANNING_TIME_FACTOR * (1 + late_count) * self._last_planning_s
                if request.streamed and late_count == SPLICE_TRIES:
                    self._run_in_loop(self._plan_queue.truncate_stream)
        finally:
            with self._lock:
                self._pending_count -= 1
            self._record_progress(1.0)

    def _record_progress(self, _fraction: float) -> None:
        self._progress_at_s = self._clock.now_s()

    def _plan_once(
        self, sequence: FrameSequence, request: PlanningRequest, planning_time_s: float
    ) -> PlanRecord | None:
        """Plan once. Return None if the snapshot became stale meanwhile."""
        began_s = self._clock.now_s()
        snapshot = self._plan_queue.make_snapshot(request.streamed, planning_time_s)
        heat, budget = snapshot.heat, snapshot.budget
        planned, feasibility = self._make_plan(sequence, request, snapshot)
        points = quantise(planned.plan, self._session.scale)
        record = PlanRecord(
            plan_id=DRY_RUN_ID if request.dry_run else f"p{next(self._ids)}",
            name=request.name,
            planned=planned,
            feasibility=feasibility,
            points=points,
            heat_before=heat,
            budget_before=budget,
            start_s=snapshot.start_s,
            arrived_s=request.arrived_s,
            caller=request.caller,
            streamed=request.streamed,
            refreshed=snapshot.refreshed,
        )
        self._verify_points(record, budget)
        self._last_planning_s = self._clock.now_s() - began_s
        if request.dry_run:
            return record
        return record if self._run_in_loop(lambda: self._plan_queue.commit(record, snapshot)) else None

    def _make_plan(
        self, sequence: FrameSequence, request: PlanningRequest, snapshot: PlanningSnapshot
    ) -> tuple[PlannedSequence, FeasibilityReport | None]:
        """Plan the sequence, with a feasibility check unless it is streamed."""
        if not request.streamed:
            on_progress, initial_state = self._record_progress, (snapshot.heat, snapshot.budget)
            return check_feasibility(self._display, sequence, *initial_state, request.policy, on_progress, request.fit)
        if snapshot.refreshed is not None and can_split(sequence):
            sequence = stale_pixels_first(sequence, snapshot.refreshed)
        return plan_sequence(
            self._display,
            sequence,
            snapshot.heat,
            snapshot.budget,
            request.policy,
            self._record_progress,
            initial_pixel=snapshot.initial_pixel,
        ), None

    def _verify_points(self, record: PlanRecord, budget: BudgetState) -> None:
        """Decode the bytes to be sent and verify them against the budget."""
        points, plan = record.points, record.planned.plan
        decoded = decode(points.encode_payload(), self._session.scale)
        verify(plan, points.row[decoded.index], decoded, budget, self._display.budget)
