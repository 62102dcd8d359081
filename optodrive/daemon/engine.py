"""The engine: joins the stages, owns the board's session, and alone keeps the board's permit to emit alive.

Two threads. The engine's own loop talks to the board and renews its lease; it does so only while the planner, which
works in the second thread, is idle or making progress. Callers on any thread get futures.
"""

import gc
import sys
import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import count
from queue import Empty, SimpleQueue

from optodrive.admission import Fit, admit
from optodrive.board.faults import hint
from optodrive.board.job import Job
from optodrive.board.requirements import Requirements
from optodrive.board.session import Session
from optodrive.clock import Clock
from optodrive.daemon.plans import PlanBook, PlanRecord, Status
from optodrive.daemon.thermal import Thermal, heated
from optodrive.daemon.waits import Answer, Waits
from optodrive.errors import InputError, LinkError, NotReadyError, OptodriveError
from optodrive.flow import BudgetState, ExecutedPulses, FrameSequence
from optodrive.limit.limiter import Policy, fired, verify
from optodrive.pipeline import Display, warm_up
from optodrive.transport.base import Transport
from optodrive.wire.quantise import decode, quantise

TURN_S = 0.002
IDLE_TURN_S = 0.01
START_LEAD_S = 0.05
"""A plan starts so long after it is ready and the one before it has ended: its first points must be there in time."""
PLANNER_STALL_S = 2.0
"""A planner that shows no progress for this long counts as dead: the lease is no longer renewed."""
SWITCH_INTERVAL_S = 2e-4
RECONNECT_S = 1.0
QUEUE_MAX = 50
DELAY_NOTICED_S = 1e-5


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
        self._thermal = Thermal(*display.at_rest())
        self._book = PlanBook()
        self._waiting: deque[PlanRecord] = deque()
        self._running: tuple[PlanRecord, Job] | None = None
        self._commands: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._waits = Waits()
        self._ids = count(1)
        self._lock = threading.RLock()
        self._closing = threading.Event()
        self._planner = ThreadPoolExecutor(1, thread_name_prefix="planner")
        self._bookkeeper = ThreadPoolExecutor(1, thread_name_prefix="bookkeeper")
        self._plans_pending = 0
        self._progress_at_s = clock.now_s()
        self._link_error: str | None = None
        self._retry_at_s = 0.0
        self._queue_end_s = 0.0
        self._totals = {"planned": 0, "sent": 0, "executed": 0}
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
        busy = self._running is not None or self._waits or self._waiting
        self._session.step(TURN_S if busy else IDLE_TURN_S, lease=self._planner_alive())
        refusal = self._session.take_refusal()
        self._settle_waits(refusal)
        self._follow_job(refusal)
        self._start_next()

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
        self._fail_all(str(error))
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
        with self._lock:
            delay_s = self._session.board_s() - before_s
            self._thermal = self._thermal.later(delay_s)
            self._queue_end_s = 0.0
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
        future: Future[Answer] = Future()

        def obey() -> None:
            try:
                self._require_link()
                action()
            except OptodriveError as error:
                future.set_exception(error)
                return
            if what != "arm":
                self._fail_all(f"ended by {what}")
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
    ) -> "Future[Answer]":
        """Plan the sequence that `build` makes, and queue it unless dry_run; answers what will be shown when."""
        with self._lock:
            if self._plans_pending == 0:
                self._progress_at_s = self._clock.now_s()
            self._plans_pending += 1
        return self._planner.submit(self._plan, build, name, dry_run, policy, fit)

    def _plan(self, build: Callable[[], FrameSequence], name: str, dry_run: bool, policy: Policy, fit: Fit) -> Answer:
        try:
            self._note_progress(0.0)
            sequence = build()
            while True:
                if not dry_run:
                    self._require_armed()
                answer = self._planned(sequence, name, dry_run, policy, fit)
                if answer is not None:
                    return answer
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
        if len(self._waiting) >= QUEUE_MAX:
            raise NotReadyError(f"{QUEUE_MAX} plans wait already; wait for one to end, or cancel one")

    def _planned(self, sequence: FrameSequence, name: str, dry_run: bool, policy: Policy, fit: Fit) -> Answer | None:
        """Plan once; None where the heat it was planned from turned out otherwise meanwhile."""
        with self._lock:
            thermal, start_s = self._thermal, self._earliest_start_s()
        heat, budget = thermal.seen_from(start_s)
        prepared, admission = admit(self.display, sequence, heat, budget, policy, self._note_progress, fit)
        points = quantise(prepared.plan, self._session.scale)
        record = PlanRecord(f"p{next(self._ids)}", name, prepared, admission, points, heat, budget, start_s)
        self._prove(record, budget)
        if dry_run:
            return record.answer(self._session.board_s())
        with self._lock:
            if self._thermal is not thermal:  # a plan before this one came late or failed, or the board restarted
                return None
            record.start_s = max(start_s, self._earliest_start_s())
            self._thermal = Thermal.after_plan(prepared.heat, prepared.budget, record.start_s)
            self._queue_end_s = record.start_s + prepared.duration_s
            self._totals["planned"] += len(prepared.plan)
            self._book.add(record)
            record.status = "queued"
            self._waiting.append(record)
        return record.answer(self._session.board_s())

    def _earliest_start_s(self) -> float:
        return max(self._queue_end_s, self._session.board_s()) + START_LEAD_S

    def _prove(self, record: PlanRecord, budget: BudgetState) -> None:
        """Decode the very bytes that will leave, and hold them against the budget."""
        points, plan = record.points, record.prepared.plan
        decoded = decode(b"".join(payload for _, payload, _ in points.frames(0)), self._session.scale)
        verify(plan.pixel[points.row[decoded.index]], decoded, budget, self.display.budget)

    def plan(self, plan_id: str, pulses: bool = True) -> Answer:
        """A plan by its id; InputError (no_plan) where there is none."""
        return self._book.find(plan_id).answer(self._session.board_s(), pulses)

    def cancel(self, plan_id: str) -> "Future[Answer]":
        """Take a plan out of the queue, or end it dark; the board stays armed."""
        future: Future[Answer] = Future()

        def obey() -> None:
            try:
                record = self._book.find(plan_id)
                if record in self._waiting:
                    self._waiting.remove(record)
                    record.end("cancelled", "taken out of the queue")
                elif self._running is not None and self._running[0] is record:
                    self._session.flush()
                    self._finish("cancelled", "ended while it ran")
                future.set_result(record.answer(self._session.board_s()))
            except OptodriveError as error:
                future.set_exception(error)

        self._commands.put(obey)
        return future

    # --- running them -------------------------------------------------------------------------------------------

    def _start_next(self) -> None:
        if self._running is not None or not self._waiting or not self._session.ready:
            return
        record = self._waiting.popleft()
        if not len(record.prepared.plan):
            record.end("done", None)
            return
        record.status = "running"
        self._running = record, self._session.begin(record.points, record.start_s)

    def _follow_job(self, refusal: str | None) -> None:
        board = self._session.board
        if board.state in ("FAULT", "DISARMED", "ARMING", "BOOT") and (self._running or self._waiting):
            why = f"{board.fault}: {hint(board.fault)}" if board.fault else self._session.last_reason
            self._fail_all(f"the board went to {board.state} ({why})")
        if self._running is None:
            return
        record, job = self._running
        self._totals["sent"] += job.sent_rows - record.sent
        self._totals["executed"] += job.executed_rows - record.executed_count
        record.sent, record.executed_count = job.sent_rows, job.executed_rows
        if job.finished:
            self._finish("done", None)
        elif refusal is not None:
            self._session.flush()
            self._finish("failed", f"the board refused a part of it ({refusal})")

    def _finish(self, status: Status, error: str | None) -> None:
        """End the running plan: what was executed is taken over, a delay moves everything after it."""
        assert self._running is not None  # noqa: S101 - callers have just looked
        (record, job), self._running = self._running, None
        scale = self._session.scale
        executed = job.executed(record.prepared.plan, scale.full_power_w, scale.tick_s)
        record.executed = executed
        record.end(status, error)
        if len(executed):
            record.executed_rows = job.rows_executed()
            last = int(record.executed_rows[-1])
            record.delay_s = float(executed.start_s[-1] - record.prepared.plan.start_s[last])
        with self._lock:
            if record.delay_s > DELAY_NOTICED_S:
                self._thermal = self._thermal.later(record.delay_s)
                self._queue_end_s += record.delay_s
                for waiting in self._waiting:
                    waiting.start_s += record.delay_s
            if status != "done" and not self._waiting:
                self._rewind(record, executed)
        self._bookkeeper.submit(self._simulate, record)

    def _simulate(self, record: PlanRecord) -> None:
        executed = record.executed
        if executed is not None:
            columns = (executed.pixel, executed.start_s, executed.width_s, executed.power_w)
            record.simulated_m = record.heat_before.copy().pulses(*columns).displacement_m

    def _rewind(self, record: PlanRecord, executed: ExecutedPulses | None) -> None:
        """Nothing after `record` will run, nor what it has not fired: heat and budget forget both."""
        dark_s = self._session.board_s() + self.display.config.board.lease_s
        until_s = dark_s - record.start_s
        budget = fired(record.prepared.plan, until_s, record.budget_before, self.display.budget)
        heat = record.heat_before if executed is None else heated(record.heat_before, executed)
        self._thermal = Thermal.after_plan(heat, budget, record.start_s)
        self._queue_end_s = max(dark_s, self._thermal.budget.at_s)

    def _fail_all(self, why: str) -> None:
        with self._lock:
            waiting = list(self._waiting)
            self._waiting.clear()
            if self._running is not None:
                self._finish("failed", why)
            elif waiting:
                self._rewind(waiting[0], None)
        for record in waiting:
            record.end("failed", why)

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
        running = self._running
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
                "waiting": len(self._waiting),
                "running": None if running is None else running[0].plan_id,
                "plans": [
                    {"plan": item.plan_id, "name": item.name, "status": item.status} for item in self._book.recent()
                ],
            },
            "totals": dict(self._totals),
            "planner": {"busy": self._plans_pending > 0, "alive": self._planner_alive()},
        }
