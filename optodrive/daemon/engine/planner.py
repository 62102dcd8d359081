"""The planner: a thread of its own that makes plans and proves their bytes; the engine's loop takes them on."""

import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import count
from typing import NamedTuple, Protocol, TypeVar

from optodrive.core.clock import Clock
from optodrive.core.types.plans import BudgetState
from optodrive.core.types.stimuli import FrameSequence
from optodrive.daemon.engine.plan_queue import Basis, Programme
from optodrive.daemon.engine.plan_record import PlanRecord
from optodrive.daemon.engine.state_waiters import Answer
from optodrive.link.protocol.quantisation import decode, quantise
from optodrive.link.session.session import Session
from optodrive.planning.feasibility import Admission, Fit, admit
from optodrive.planning.limiter.limiter import Policy, verify
from optodrive.planning.pipeline import Display, Prepared, prepare
from optodrive.planning.stimuli.streamed_frame import may_be_split, unseen_first

STALL_S = 2.0
"""A planner that shows no progress for this long counts as dead: the lease is no longer renewed."""
GUESS_S = 0.01
ALLOWANCE = 1.5
"""A streamed plan is given so many times as long to be made as the last one took."""
SEAMLESS_TRIES = 2
"""A streamed plan that came too late so often waits for what runs to end, which then does so soon."""
T = TypeVar("T")


class ByLoop(Protocol):
    """Does something in the loop's thread, which owns the session, and hands back what comes of it."""

    def __call__(self, action: Callable[[], T]) -> T:
        """Do it; LinkError where the loop has ended."""


class Order(NamedTuple):
    """What a caller asks for; arrived_s: board time."""

    build: Callable[[], FrameSequence]
    name: str
    dry_run: bool
    policy: Policy
    fit: Fit
    streamed: bool
    arrived_s: float


class Planner:
    """Makes one plan after the other. may_show: raises where nothing can be shown now; by_loop: see `ByLoop`."""

    def __init__(
        self,
        display: Display,
        session: Session,
        programme: Programme,
        clock: Clock,
        by_loop: ByLoop,
        may_show: Callable[[], None],
    ) -> None:
        self._display = display
        self._session = session
        self._programme = programme
        self._clock = clock
        self._by_loop = by_loop
        self._may_show = may_show
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="planner")
        self._lock = threading.Lock()
        self._ids = count(1)
        self._pending = 0
        self._progress_at_s = clock.now_s()
        self._planning_s = GUESS_S

    @property
    def busy(self) -> bool:
        """Whether plans are made or wait to be."""
        return self._pending > 0

    @property
    def alive(self) -> bool:
        """Whether it is idle or making progress."""
        with self._lock:
            return self._pending == 0 or self._clock.now_s() - self._progress_at_s < STALL_S

    def close(self) -> None:
        """Make no more plans."""
        self._thread.shutdown(wait=False, cancel_futures=True)

    def submit(self, order: Order) -> "Future[Answer]":
        """Make a plan and have it shown; answers what will be shown when. Any thread."""
        with self._lock:
            if self._pending == 0:
                self._progress_at_s = self._clock.now_s()
            self._pending += 1
        return self._thread.submit(self._plan, order)

    def _plan(self, order: Order) -> Answer:
        try:
            self._note_progress(0.0)
            sequence = order.build()
            allowance_s, late = ALLOWANCE * self._planning_s, 0
            while True:
                if not order.dry_run:
                    self._may_show()
                if order.streamed and self._programme.in_the_way:
                    self._by_loop(self._programme.make_way)
                record = self._planned(sequence, order, allowance_s)
                if record is not None:
                    return record.answer(self._session.board_s())
                # What runs went on beyond where this would have followed.
                late += 1
                allowance_s = ALLOWANCE * (1 + late) * self._planning_s
                if order.streamed and late == SEAMLESS_TRIES:
                    self._by_loop(self._programme.end_soon)
        finally:
            with self._lock:
                self._pending -= 1
            self._note_progress(1.0)

    def _note_progress(self, _share: float) -> None:
        self._progress_at_s = self._clock.now_s()

    def _planned(self, sequence: FrameSequence, order: Order, allowance_s: float) -> PlanRecord | None:
        """Plan once; None where the heat it was planned from turned out otherwise meanwhile."""
        began_s = self._clock.now_s()
        basis = self._programme.basis(order.streamed, allowance_s)
        heat, budget = basis.heat, basis.budget
        prepared, admission = self._prepared(sequence, order, basis)
        points = quantise(prepared.plan, self._session.scale)
        record = PlanRecord(
            plan_id=f"p{next(self._ids)}",
            name=order.name,
            prepared=prepared,
            admission=admission,
            points=points,
            heat_before=heat,
            budget_before=budget,
            start_s=basis.start_s,
            arrived_s=order.arrived_s,
            streamed=order.streamed,
            seen=basis.seen,
        )
        self._prove(record, budget)
        self._planning_s = self._clock.now_s() - began_s
        if order.dry_run:
            return record
        return record if self._by_loop(lambda: self._programme.take(record, basis)) else None

    def _prepared(self, sequence: FrameSequence, order: Order, basis: Basis) -> tuple[Prepared, Admission | None]:
        """The plan; a stream has no time to ask what else would fit."""
        if not order.streamed:
            told, from_where = self._note_progress, (basis.heat, basis.budget)
            return admit(self._display, sequence, *from_where, order.policy, told, order.fit)
        if basis.seen is not None and may_be_split(sequence):
            sequence = unseen_first(sequence, basis.seen)
        return prepare(
            self._display,
            sequence,
            basis.heat,
            basis.budget,
            order.policy,
            self._note_progress,
            standing_on=basis.standing_on,
        ), None

    def _prove(self, record: PlanRecord, budget: BudgetState) -> None:
        """Decode the very bytes that will leave, and hold them against the budget."""
        points, plan = record.points, record.prepared.plan
        decoded = decode(points.payload(), self._session.scale)
        verify(plan, points.row[decoded.index], decoded, budget, self._display.budget)
