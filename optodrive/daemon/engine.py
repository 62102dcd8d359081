"""The engine: joins the stages, owns the board's session, and alone keeps the board's permit to emit alive.

Two threads. The engine's own loop talks to the board and renews its lease; it does so only while the planner, which
works in the second thread, is idle or making progress. Callers on any thread get futures.
"""

import gc
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import count
from queue import Empty, SimpleQueue
from typing import NamedTuple, TypeVar

import numpy as np

from optodrive.admission import Admission, Fit, admit
from optodrive.board.faults import hint
from optodrive.board.requirements import Requirements
from optodrive.board.session import Session
from optodrive.clock import Clock
from optodrive.daemon.plans import PlanBook, PlanRecord
from optodrive.daemon.programme import Basis, Programme
from optodrive.daemon.waits import Answer, Waits, promise
from optodrive.errors import InputError, LinkError, NotReadyError, OptodriveError
from optodrive.flow import BudgetState, FrameSequence, TactileFrame
from optodrive.frames.live import may_be_split, unseen_first
from optodrive.limit.limiter import Policy, verify
from optodrive.pipeline import Display, Prepared, prepare, warm_up
from optodrive.transport.base import Transport
from optodrive.wire.quantise import decode, quantise

TURN_S = 0.002
IDLE_TURN_S = 0.01
PLANNER_STALL_S = 2.0
"""A planner that shows no progress for this long counts as dead: the lease is no longer renewed."""
SWITCH_INTERVAL_S = 2e-4
RECONNECT_S = 1.0
QUEUE_MAX = 50
PLANNING_GUESS_S = 0.01
ALLOWANCE = 1.5
"""A streamed plan is given so many times as long to be made as the last one took."""
LOOP_TIMEOUT_S = 5.0
T = TypeVar("T")


class _Order(NamedTuple):
    """What a caller asks for; arrived_s: board time."""

    build: Callable[[], FrameSequence]
    name: str
    dry_run: bool
    policy: Policy
    fit: Fit
    streamed: bool
    arrived_s: float


class Engine:
    """Runs plans on a board. Methods that return futures may be called from any thread.

    failure: what ended the loop, None while it runs; on_failure is then called, after the board was told to abort.
    """

    def __init__(self, display: Display, transport: Transport, clock: Clock) -> None:
        self.display = display
        self.failure: BaseException | None = None
        self.on_failure: Callable[[], None] = lambda: None
        self._clock = clock
        self._session = Session(transport, clock, Requirements.of(display.config))
        self._book = PlanBook()
        self._bookkeeper = ThreadPoolExecutor(1, thread_name_prefix="bookkeeper")
        self._programme = Programme(display, self._session, self._book, self._bookkeeper)
        self._commands: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._waits = Waits()
        self._ids = count(1)
        self._lock = threading.RLock()
        self._closing = threading.Event()
        self._planner = ThreadPoolExecutor(1, thread_name_prefix="planner")
        self._plans_pending = 0
        self._progress_at_s = clock.now_s()
        self._link_error: str | None = None
        self._retry_at_s = 0.0
        self._planning_s = PLANNING_GUESS_S
        self._thread = threading.Thread(target=self._run, name="engine", daemon=True)

    # --- life ---------------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Connect to the board and start; raises InputError or LinkError where the board cannot be reached."""
        # The loop gives the interpreter up at every read and write; while the planner computes it would wait for it
        # 5 ms each time, and a few of those are a lease.
        sys.setswitchinterval(SWITCH_INTERVAL_S)
        # A planner that compiles shows no progress, and would cost the lease.
        warm_up(self.display)
        # A collection that walks through everything imported would stop the loop for more than half a lease.
        gc.collect()
        gc.freeze()
        self._session.connect()
        self._thread.start()

    def close(self) -> None:
        """Stop: the board is told to abort, the threads end."""
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join(timeout=5.0)
        self._session.close()
        self._planner.shutdown(wait=False, cancel_futures=True)
        self._bookkeeper.shutdown(wait=False, cancel_futures=True)

    def _run(self) -> None:
        try:
            while not self._closing.is_set():
                try:
                    self._turn()
                except (LinkError, InputError) as error:
                    self._link_lost(error)
        except BaseException as error:
            self.failure = error
            raise
        finally:
            self._session.close()
            if self.failure is not None:
                self.on_failure()

    def _turn(self) -> None:
        self._obey()
        if not self._session.connected:
            self._reconnect()
            return
        busy = self._programme.busy or self._waits
        self._session.step(TURN_S if busy else IDLE_TURN_S, lease=self._planner_alive())
        refusal = self._session.take_refusal()
        self._settle_waits(refusal)
        self._programme.follow_jobs(refusal)
        self._programme.start_next()

    def _obey(self) -> None:
        while True:
            try:
                command = self._commands.get_nowait()
            except Empty:
                return
            command()

    def _planner_alive(self) -> bool:
        with self._lock:
            return self._plans_pending == 0 or self._clock.now_s() - self._progress_at_s < PLANNER_STALL_S

    # --- the link -----------------------------------------------------------------------------------------------

    def _link_lost(self, error: OptodriveError) -> None:
        self._link_error = str(error)
        self._session.drop()
        self._programme.fail_all(str(error))
        self._retry_at_s = self._clock.now_s() + RECONNECT_S

    def _reconnect(self) -> None:
        self._settle_waits(None)
        if self._clock.now_s() < self._retry_at_s:
            self._clock.sleep(IDLE_TURN_S)
            return
        before_s = self._session.board_s()
        try:
            self._session.connect()
        except (LinkError, InputError) as error:
            self._link_error = str(error)
            self._retry_at_s = self._clock.now_s() + RECONNECT_S
            return
        # The board may have restarted its clock: what is known of heat moves onto the new one.
        self._programme.board_restarted(self._session.board_s() - before_s)
        self._link_error = None

    # --- commands from any thread -------------------------------------------------------------------------------

    def arm(self) -> "Future[Answer]":
        """Arm the board; done when it is ARMED."""
        return self._command(self._session.arm, ("ARMED",), "arm")

    def disarm(self) -> "Future[Answer]":
        """Disarm, or acknowledge a fault; done when the board is DISARMED."""
        return self._command(self._session.disarm, ("DISARMED",), "disarm")

    def stop(self) -> "Future[Answer]":
        """Abort: gate off, queue dropped; done when the board is dark for good."""
        return self._command(self._session.abort, ("DISARMED", "FAULT"), "stop")

    def _command(self, action: Callable[[], None], states: tuple[str, ...], what: str) -> "Future[Answer]":
        future: Future[Answer] = promise()

        def obey() -> None:
            try:
                self._require_link()
                action()
            except OptodriveError as error:
                future.set_exception(error)
                return
            if what != "arm":
                self._programme.fail_all(f"ended by {what}")
            self._waits.add(states, what, self._clock.now_s(), future)

        self._commands.put(obey)
        return future

    def _require_link(self) -> None:
        if not self._session.connected:
            raise LinkError(self._link_error or "no link to the board")

    def _settle_waits(self, refusal: str | None) -> None:
        self._waits.settle(self._session, refusal, self._link_error, self._clock.now_s(), self.snapshot)

    # --- plans --------------------------------------------------------------------------------------------------

    def submit(
        self,
        build: Callable[[], FrameSequence],
        name: str,
        dry_run: bool = False,
        policy: Policy = "trim",
        fit: Fit = "as_is",
        streamed: bool = False,
        arrived_s: float | None = None,
    ) -> "Future[Answer]":
        """Plan the sequence that `build` makes, and queue it unless dry_run; answers what will be shown when.

        streamed: it takes the place of everything that has not left yet, and gives way to the next such in turn.
        arrived_s: board time at which it was asked for, if not now
        """
        if streamed and fit != "as_is":
            raise InputError("fit", fit, "as_is where the newest wins: a stream has no time to ask what else would fit")
        arrived_s = self.board_s() if arrived_s is None else arrived_s
        order = _Order(build, name, dry_run, policy, fit, streamed and not dry_run, arrived_s)
        with self._lock:
            if self._plans_pending == 0:
                self._progress_at_s = self._clock.now_s()
            self._plans_pending += 1
        return self._planner.submit(self._plan, order)

    def _plan(self, order: "_Order") -> Answer:
        try:
            self._note_progress(0.0)
            sequence = order.build()
            allowance_s = ALLOWANCE * self._planning_s
            while True:
                if not order.dry_run:
                    self._require_armed()
                if order.streamed and self._programme.in_the_way:
                    self._by_loop(self._programme.make_way)
                record = self._planned(sequence, order, allowance_s)
                if record is not None:
                    return record.answer(self._session.board_s())
                allowance_s *= 2.0
        finally:
            with self._lock:
                self._plans_pending -= 1
            self._note_progress(1.0)

    def _note_progress(self, _share: float) -> None:
        self._progress_at_s = self._clock.now_s()

    def _require_armed(self) -> None:
        self._require_link()
        board = self._session.board
        if board.state not in ("ARMED", "RUNNING", "HOLD"):
            fault = f" {board.fault}: {hint(board.fault)}" if board.fault else ""
            raise NotReadyError(f"the board is {board.state}{fault}; arm it first (POST /v1/arm, or `optodrive arm`)")
        if len(self._programme.waiting) >= QUEUE_MAX:
            raise NotReadyError(f"{QUEUE_MAX} plans wait already; wait for one to end, or cancel one")

    def _planned(self, sequence: FrameSequence, order: "_Order", allowance_s: float) -> PlanRecord | None:
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

    def _prepared(self, sequence: FrameSequence, order: "_Order", basis: Basis) -> tuple[Prepared, Admission | None]:
        """The plan; a stream has no time to ask what else would fit."""
        if not order.streamed:
            told, from_where = self._note_progress, (basis.heat, basis.budget)
            return admit(self.display, sequence, *from_where, order.policy, told, order.fit)
        if basis.seen is not None and may_be_split(sequence):
            sequence = unseen_first(sequence, basis.seen)
        return prepare(
            self.display,
            sequence,
            basis.heat,
            basis.budget,
            order.policy,
            self._note_progress,
            standing_on=basis.standing_on,
        ), None

    def _in_loop(self, action: Callable[[], T]) -> "Future[T]":
        """Do something in the loop's thread, which owns the session."""
        future: Future[T] = promise()

        def obey() -> None:
            try:
                future.set_result(action())
            except OptodriveError as error:
                future.set_exception(error)

        self._commands.put(obey)
        return future

    def _by_loop(self, action: Callable[[], T]) -> T:
        """What comes of an action in the loop's thread; LinkError where the loop has ended."""
        try:
            return self._in_loop(action).result(LOOP_TIMEOUT_S)
        except TimeoutError:
            raise LinkError(f"the engine did not answer within {LOOP_TIMEOUT_S:g} s: {self.failure!r}") from None

    def _prove(self, record: PlanRecord, budget: BudgetState) -> None:
        """Decode the very bytes that will leave, and hold them against the budget."""
        points, plan = record.points, record.prepared.plan
        decoded = decode(points.payload(), self._session.scale)
        verify(plan.pixel[points.row[decoded.index]], decoded, budget, self.display.budget)

    def board_s(self) -> float:
        """The board's time now, s."""
        return self._session.board_s()

    def ending(self, plan_id: str) -> "Future[None]":
        """Done when nothing more will happen to a plan; InputError (no_plan) where there is none."""
        return self._book.find(plan_id).ending

    def end_stream(self) -> "Future[Answer]":
        """Let go what has not left of a stream's last plan: whoever sent it is gone."""
        nothing = TactileFrame("", 0.0, 1.0, np.zeros(len(self.display.layout)))
        return self.submit(lambda: FrameSequence((nothing,)), "end of stream", streamed=True)

    def plan(self, plan_id: str, pulses: bool = True) -> Answer:
        """A plan by its id; InputError (no_plan) where there is none."""
        return self._book.find(plan_id).answer(self._session.board_s(), pulses)

    def cancel(self, plan_id: str) -> "Future[Answer]":
        """Take a plan out of the queue, or end it dark; the board stays armed."""

        def end() -> Answer:
            record = self._book.find(plan_id)
            self._programme.cancel(record)
            return record.answer(self._session.board_s())

        return self._in_loop(end)

    # --- what can be seen from outside --------------------------------------------------------------------------

    @property
    def link_name(self) -> str:
        """The board's port."""
        return self._session.port

    @property
    def board_state(self) -> str:
        """The board's state, or the link's."""
        return self._session.board.state if self._session.connected else "no link"

    def snapshot(self) -> Answer:
        """Everything GET /v1/state answers."""
        programme = self._programme
        running = next(iter(programme.running.copy()), None)
        return {
            "display": self.display.config.name,
            "pixels": len(self.display.layout),
            "link": {
                "port": self._session.port,
                "state": "up" if self._session.connected else "down",
                "error": self._link_error,
                **self._session.link_figures(),
            },
            "board": self._session.board.figures(),
            "queue": {
                "waiting": len(programme.waiting),
                "running": None if running is None else running.record.plan_id,
                "plans": [
                    {"plan": item.plan_id, "name": item.name, "status": item.status} for item in self._book.recent()
                ],
            },
            "totals": dict(programme.totals),
            "planner": {"busy": self._plans_pending > 0, "alive": self._planner_alive()},
        }
