"""Planner thread that plans sequences and verifies the wire bytes before the engine's loop accepts them."""

import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Executor, Future
from contextlib import suppress
from itertools import count, pairwise
from math import inf
from statistics import fmean
from time import thread_time
from typing import Any, Protocol, TypeVar

from optodrive.core.clock import Clock
from optodrive.core.errors import BusyError, InputError, LinkError, NotReadyError, StoppedError
from optodrive.core.processes import PLANNING, set_realtime_priority, use_usual_priority
from optodrive.daemon.engine.active_plan import ActivePlan
from optodrive.daemon.engine.plan_making import NEVER, Dimmer, PlanningRequest, build_rest_frame, grow_plan, make_plan
from optodrive.daemon.engine.plan_queue import GROWTH_MARGIN_S, PlanQueue
from optodrive.daemon.engine.plan_record import PlanRecord
from optodrive.daemon.push import BuiltRequest, Push
from optodrive.daemon.responses.plan import PlanReport, PlanStatus
from optodrive.link.service.remote_session import RemoteSession

INITIAL_S = 0.01
RECENT_MAX = 8
FACTOR = 1.25
"""Time reserved per time expected, for a plan that takes longer than the recent ones."""

HORIZON_MIN_S, HORIZON_MAX_S = 0.05, 0.1
"""Light of a frame that is planned at once, at least and at most."""
HORIZON_INTERVALS = 1.5
"""The same, in intervals between two frames: a frame that comes somewhat later than expected finds it unspent."""


ARRIVALS_KEPT = 17
PAUSE_SHARE = 1.5
"""An interval longer than this share of the median is a pause of the stream, and does not count in the mean."""


class StreamHorizon:
    """Time of a streamed frame's light that is planned at once, from the interval between the last two frames."""

    def __init__(self) -> None:
        self._arrivals_s = deque([-inf], ARRIVALS_KEPT)

    def follow(self, arrived_s: float) -> float:
        """Return the time for the frame that arrived now, s."""
        interval_s = arrived_s - self._arrivals_s[-1]
        if interval_s > 0.0:  # else the rest of a frame
            self._arrivals_s.append(arrived_s)
        return min(HORIZON_MAX_S, max(HORIZON_MIN_S, HORIZON_INTERVALS * interval_s))

    @property
    def mean_interval_s(self) -> float:
        """Mean interval between the latest of the frames followed, s, infinity before the second one."""
        intervals_s = sorted(after - before for before, after in pairwise(self._arrivals_s)) or [inf]
        median_s = intervals_s[(len(intervals_s) - 1) // 2]
        return fmean(each for each in intervals_s if each <= PAUSE_SHARE * median_s)


class PlanningTime:
    """Expected duration of the next planning, from the recent ones.

    A plan that is late is made again, which takes longer than to wait for it: the expectation is the second longest of
    the recent durations, so that one of them in eight may be exceptional.
    """

    def __init__(self) -> None:
        self._recent_s = deque([INITIAL_S], RECENT_MAX)

    def record(self, duration_s: float) -> None:
        """Record the duration of a planning, s."""
        self._recent_s.append(duration_s)

    def compute_reserved_s(self, late_count: int) -> float:
        """Return the time to reserve for a plan that was late `late_count` times, s."""
        expected_s = sorted(self._recent_s)[-2] if len(self._recent_s) > 1 else self._recent_s[0]
        return FACTOR * (1 + late_count) * expected_s


STALL_TIMEOUT_S = 2.0
"""A planner without progress for this time counts as stalled, and the lease is no longer renewed."""
SPLICE_TRIES = 2
"""Number of late attempts to splice a streamed plan, after which the running stream is truncated."""
PLANNING_MAX_S = 60.0
"""Processor time for the planning of one request at most, s; meanwhile all others wait."""
REALTIME_MAX_S = 0.1
"""Processor time for the planning of a streamed frame in real time at most, s; one of 1,511 pixels takes 13 ms."""
REQUESTS_MAX = 16
"""Requests that wait for the planner at most."""
T = TypeVar("T")


class LoopRunner(Protocol):
    """Function that runs an action in the loop's thread, which owns the session."""

    def __call__(self, action: Callable[[], T]) -> T:
        """Return the result of the action. Raise LinkError if the loop has ended."""


class Planner:
    """Planner of one sequence at a time.

    dimmer: states the display by which plans are made
    executor: runs one request at a time, in order
    run_in_loop: runs an action in the loop's thread
    require_armed: raises NotReadyError if the board accepts no plans
    """

    def __init__(
        self,
        dimmer: Dimmer,
        session: RemoteSession,
        plan_queue: PlanQueue,
        clock: Clock,
        executor: Executor,
        run_in_loop: LoopRunner,
        require_armed: Callable[[], None],
    ) -> None:
        self._dimmer = dimmer
        self._session = session
        self._plan_queue = plan_queue
        self._clock = clock
        self._run_in_loop = run_in_loop
        self._require_armed = require_armed
        self._executor = executor
        self._lock = threading.Lock()
        self._ids = count(1)
        self._pending_count = 0
        self._progress_at_s = clock.now_s()
        self._planning_time, self._growth_time = PlanningTime(), PlanningTime()
        self._horizon = StreamHorizon()
        self._own_work: Future[None] | None = None

    @property
    def is_busy(self) -> bool:
        """Whether requests are in progress or waiting."""
        return self._pending_count > 0

    @property
    def is_alive(self) -> bool:
        """Whether the planner is idle or makes progress."""
        with self._lock:
            return self._pending_count == 0 or self._clock.now_s() - self._progress_at_s < STALL_TIMEOUT_S

    def submit(self, request: PlanningRequest) -> "Future[PlanReport]":
        """Queue a request and return the future of its plan's report. Any thread may call it.

        Cancelling the future removes a request that is not yet begun. Raise BusyError if too many wait.
        """
        with self._lock:
            # Counted here and not by the executor, whose queue has no bound.
            if self._pending_count > REQUESTS_MAX:
                raise BusyError(f"too many requests wait: {REQUESTS_MAX} before this one; try again later")
            if self._pending_count == 0:
                self._progress_at_s = self._clock.now_s()
            self._pending_count += 1
        future = self._executor.submit(self._process, request)
        future.add_done_callback(self._on_done)
        return future

    def _on_done(self, _future: "Future[Any]") -> None:
        with self._lock:
            self._pending_count -= 1

    def follow_queue(self) -> None:
        """Let the queue go on when a pause has ended, without a lost stage, and plan the rest of a streamed frame.

        The loop calls it in every iteration.
        """
        lost = self._session.lost
        self._dimmer.set_lost_stage(None if lost is None else lost.stage)
        if self._is_at_own_work:
            return
        work = None
        if self._plan_queue.can_restart:
            work = self._restart
        elif self.growth_due_in_s <= 0.0:
            work = self._grow
        # It counts as a request, or a hanging one would not stop the beats.
        if work is not None:
            with self._lock:
                if self._pending_count == 0:
                    self._progress_at_s = self._clock.now_s()
                self._pending_count += 1
            # On the one planning thread, so that it and a request never plan at once.
            self._own_work = self._executor.submit(work)
            self._own_work.add_done_callback(self._on_done)

    @property
    def _is_at_own_work(self) -> bool:
        return self._own_work is not None and not self._own_work.done()

    @property
    def growth_due_in_s(self) -> float:
        """Time until the rest of the running plan must be planned, infinity if it has none, or is being planned."""
        if self._is_at_own_work:
            return inf
        return self._plan_queue.compute_due_in_s(self._growth_time.compute_reserved_s(0))

    def _grow(self) -> None:
        """Plan the rest of the streamed frame that was accepted last, unless nobody waits for it any more."""
        plan = self._plan_queue.state.growing
        if plan is None:
            return
        set_realtime_priority(PLANNING)
        check = self._build_check(plan.epoch, NEVER, streamed=True)
        try:
            if not self._extend(plan, check):
                self._plan_rest(plan, check)
        except (NotReadyError, LinkError):  # it was stopped or paused, and a stream shows the present
            with suppress(LinkError):
                self._run_in_loop(self._plan_queue.give_up_rest)
        except Exception as error:  # of any kind: what cannot be proven is not played
            self._fail_all(f"the rest of a streamed frame could not be planned: {error}")
        finally:
            use_usual_priority()
            self._progress_at_s = self._clock.now_s()

    def _extend(self, plan: ActivePlan, check: Callable[[float], None]) -> bool:
        """Append the rest of a plan to it. Return False if it is too late, or the display was dimmed."""
        growth, display, began_s = plan.growth, self._dimmer.display, self._clock.now_s()
        # A plan is continued only under the caps that it began with.
        if growth is None or growth.display is not display:
            return False
        grown = grow_plan(plan, growth, self._session.scales, check)
        self._growth_time.record(self._clock.now_s() - began_s)

        def commit() -> bool:
            # Asked in the loop's thread, which dims: in any other a change could come in between.
            return self._dimmer.display is display and self._plan_queue.extend(plan, grown)

        return self._run_in_loop(commit)

    def _plan_rest(self, plan: ActivePlan, check: Callable[[float], None]) -> None:
        """Plan the pixels that a plan has not drawn as a frame of its own, behind it."""
        withdrawn = self._run_in_loop(lambda: self._plan_queue.withdraw_rest(plan))
        if withdrawn is None:
            return
        record, built = withdrawn.record, BuiltRequest(build_rest_frame(withdrawn))
        push = Push(record.name, {}, self._clock.now_s(), plan.epoch, record.caller, streamed=True, lists_pulses=False)
        self._plan_until_committed(built, PlanningRequest(lambda: built, push, record.arrived_s), check)

    def _restart(self) -> None:
        """Plan the waiting plans anew, until they are in time or the light is paused or stopped again."""

        def on_progress() -> None:
            self._progress_at_s = self._clock.now_s()

        try:
            began_s, reserved_s = self._clock.now_s(), 0.0
            while not self._restart_once(on_progress, reserved_s):
                # All attempts together: each reserves more.
                reserved_s = FACTOR * (self._clock.now_s() - began_s)
        except Exception as error:  # of any kind: what cannot be proven is not played
            self._fail_all(f"what was left after an interruption could not be planned again: {error}")
        finally:
            on_progress()

    def _restart_once(self, on_progress: Callable[[], None], reserved_s: float) -> bool:
        """Restart once. Return False if it is late, the queue was changed, or the display was dimmed, meanwhile."""
        display = self._dimmer.display
        on_progress()
        restart = self._plan_queue.build_restart(display, reserved_s, on_progress)
        if restart is None:
            return True

        def commit() -> bool:
            return self._dimmer.display is display and self._plan_queue.commit_restart(restart)

        return self._run_in_loop(commit)

    def _fail_all(self, reason: str) -> None:
        """End all plans, unless the loop has ended with them."""
        with suppress(LinkError):
            self._run_in_loop(lambda: self._plan_queue.end_all(PlanStatus.FAILED, reason))

    def _process(self, request: PlanningRequest) -> PlanReport:
        """Plan one request, a streamed one before all programs of usual priority."""
        if not request.push.streamed:
            return self._plan(request)
        set_realtime_priority(PLANNING)
        try:
            return self._plan(request)
        finally:
            use_usual_priority()

    def _plan(self, request: PlanningRequest) -> PlanReport:
        check = self._build_check(request.push.epoch, request.caller_left, request.push.streamed)
        try:
            check(0.0)
            record = self._plan_until_committed(request.build(), request, check)
            clocks = self._session.read_clocks()
            return record.build_report(self._session.board_s(), request.push.lists_pulses, clocks)
        finally:
            self._progress_at_s = self._clock.now_s()

    def _build_check(self, epoch: int, caller_left: threading.Event, streamed: bool) -> Callable[[float], None]:
        """Return a function that records progress, and ends work that nobody waits for or that takes too long."""
        began_s = thread_time()

        def check(_fraction: float) -> None:
            self._progress_at_s = self._clock.now_s()
            # Processor time: a request must not fail because the computer was busy with others.
            used_s = thread_time() - began_s
            # A long computation goes on at usual priority, so that it starves no other process.
            if streamed and used_s > REALTIME_MAX_S:
                use_usual_priority()
            if used_s > PLANNING_MAX_S:
                expected = f"a sequence that is planned within {PLANNING_MAX_S:g} s of processor time; send it in parts"
                raise InputError("body", "a longer computation", expected, "too_slow")
            # At every step, so that a STOP also ends a plan that is being computed.
            self._plan_queue.require_epoch(epoch)
            if caller_left.is_set():
                raise StoppedError("the caller has left")

        return check

    def _plan_until_committed(
        self, built: BuiltRequest, request: PlanningRequest, check: Callable[[float], None]
    ) -> PlanRecord:
        late_count, took_s, plan_id, horizon_s = 0, 0.0, f"p{next(self._ids)}", inf
        if request.push.streamed:
            reserved_s = self._growth_time.compute_reserved_s(0) + GROWTH_MARGIN_S
            horizon_s = max(self._horizon.follow(request.arrived_s), self._plan_queue.lead_s) + reserved_s
            request = request._replace(interval_s=self._horizon.mean_interval_s)
        else:
            self._grow()  # what is pushed goes behind the whole of a frame
        while True:
            check(0.0)
            self._require_armed()
            if request.push.streamed and self._plan_queue.is_held:  # unless it was resumed a moment ago
                self._run_in_loop(self._plan_queue.require_no_pause)
            if request.push.streamed and self._plan_queue.state.must_preempt:
                self._run_in_loop(lambda: self._preempt(request))
            began_s = self._clock.now_s()
            reserved_s = self._compute_reserved_s(request, late_count, took_s)
            record = self._plan_once(built, request, plan_id, reserved_s, horizon_s, check)
            if record is not None:
                return record
            took_s = self._clock.now_s() - began_s
            # The snapshot is stale: a predecessor was late, has sent points beyond the splice, or its heat is gone.
            late_count += 1
            if request.push.streamed and late_count == SPLICE_TRIES:
                self._run_in_loop(self._plan_queue.truncate)

    def _compute_reserved_s(self, request: PlanningRequest, late_count: int, took_s: float) -> float:
        """Return the time to reserve for an attempt after late ones, of which the last took took_s."""
        streamed = request.push.streamed
        return self._planning_time.compute_reserved_s(late_count) if streamed else FACTOR * late_count * took_s

    def _preempt(self, request: PlanningRequest) -> None:
        """Make room for a streamed plan, unless its epoch has passed."""
        self._plan_queue.require_epoch(request.push.epoch)
        self._plan_queue.require_no_pause()
        self._plan_queue.preempt()

    def _plan_once(
        self,
        built: BuiltRequest,
        request: PlanningRequest,
        plan_id: str,
        reserved_s: float,
        horizon_s: float,
        check: Callable[[float], None],
    ) -> PlanRecord | None:
        """Plan once. Return None if the plan is late, the snapshot stale, or the display was dimmed meanwhile."""
        began_s, display = self._clock.now_s(), self._dimmer.display
        snapshot = self._plan_queue.make_snapshot(request.push.streamed, reserved_s)
        plan = make_plan(display, self._session.scales, request, built, snapshot, plan_id, check, horizon_s)
        if request.push.streamed:
            self._planning_time.record(self._clock.now_s() - began_s)

        def commit() -> PlanRecord | None:
            is_as_dim = self._dimmer.display is display
            return self._plan_queue.commit(plan, snapshot) if is_as_dim else None

        return self._run_in_loop(commit)
