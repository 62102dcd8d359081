"""The engine: joins the stages, owns the board's session, and alone keeps the board's permit to emit alive.

Two threads. The engine's own loop talks to the board and renews its lease; it does so only while the planner, which
works in the second thread, is idle or making progress. Callers on any thread get futures.
"""

import gc
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from queue import Empty, SimpleQueue
from typing import TypeVar

import numpy as np

from optodrive.core.clock import Clock, request_realtime_scheduling
from optodrive.core.errors import InputError, LinkError, NotReadyError, OptodriveError
from optodrive.core.types.policy import Policy
from optodrive.core.types.stimuli import FrameSequence, TactileFrame
from optodrive.daemon.engine.metrics import PlanCounters, render_metrics
from optodrive.daemon.engine.plan_queue import PlanQueue
from optodrive.daemon.engine.plan_record import PlanRecord, PlanStore
from optodrive.daemon.engine.planner import Planner, PlanningRequest
from optodrive.daemon.engine.progress import ClockShift, PlanProgress
from optodrive.daemon.engine.state_waiters import StateWaiters, uncancellable_future
from optodrive.daemon.responses.plan import PlanReport
from optodrive.daemon.responses.state import (
    BoardReport,
    LinkReport,
    PlannerReport,
    PulseTotals,
    QueueReport,
    RecentPlan,
    StateReport,
)
from optodrive.link.protocol.quantisation import WireScale
from optodrive.link.protocol.states import ARMED_STATES, IDLE_STATES, BoardState
from optodrive.link.session.board_requirements import BoardRequirements
from optodrive.link.session.fault_hints import get_fault_hint
from optodrive.link.session.link_watch import LinkCause
from optodrive.link.session.session import BoardSession
from optodrive.link.transport.base import Transport
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.feasibility.report import FitMode
from optodrive.planning.pipeline import warm_up

LOOP_WAIT_S = 0.002
IDLE_LOOP_WAIT_S = 0.01
SWITCH_INTERVAL_S = 2e-4
RECONNECT_INTERVAL_S = 1.0
QUEUE_MAX = 50
LOOP_TIMEOUT_S = 5.0
T = TypeVar("T")


class Engine:
    """Runs plans on a board. Methods that return futures may be called from any thread.

    failure: what ended the loop, None while it runs; on_failure is then called, after the board was told to abort.
    say: gets a line whenever the link goes wrong, for the log. on_turn: called at every turn of the loop; must be quick
    """

    def __init__(self, display: DisplayModel, transport: Transport, clock: Clock) -> None:
        self.display = display
        self.failure: BaseException | None = None
        self.on_failure: Callable[[], None] = lambda: None
        self.on_warning: Callable[[str], None] = lambda line: None
        self.on_loop: Callable[[], None] = lambda: None
        self._clock = clock
        self._session = BoardSession(transport, clock, BoardRequirements.from_config(display.config))
        self._plan_store = PlanStore()
        self._plan_counters = PlanCounters()
        self._plan_store.end_callbacks.append(self._plan_counters.record_end)
        self._simulation_executor = ThreadPoolExecutor(1, thread_name_prefix="bookkeeper")
        self._plan_queue = PlanQueue(display, self._session, self._plan_store, self._simulation_executor)
        self._commands: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._state_waiters = StateWaiters()
        self._closing = threading.Event()
        self._planner = Planner(display, self._session, self._plan_queue, clock, self._run_in_loop, self._require_armed)
        self._link_error: str | None = None
        self._published_cause: LinkCause | None = None
        self._retry_at_s = 0.0
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
        self._planner.close()
        self._simulation_executor.shutdown(wait=False, cancel_futures=True)

    def _run(self) -> None:
        request_realtime_scheduling()
        try:
            while not self._closing.is_set():
                try:
                    self._run_once()
                except (LinkError, InputError) as error:
                    self._on_link_lost(error)
                self._publish_cause()
                self.on_loop()
        except BaseException as error:
            self.failure = error
            raise
        finally:
            self._session.close()
            if self.failure is not None:
                self.on_failure()

    def _run_once(self) -> None:
        self._run_commands()
        if not self._session.connected:
            self._reconnect()
            return
        busy = self._plan_queue.is_busy or self._state_waiters
        self._session.step(LOOP_WAIT_S if busy else IDLE_LOOP_WAIT_S, renew_lease=self._planner.is_alive)
        refusal = self._session.pop_refusal()
        self._resolve_waiters(refusal)
        self._plan_queue.update_jobs(refusal)
        self._plan_queue.start_next()

    def _run_commands(self) -> None:
        while True:
            try:
                command = self._commands.get_nowait()
            except Empty:
                return
            command()

    # --- the link -----------------------------------------------------------------------------------------------

    def _on_link_lost(self, error: OptodriveError) -> None:
        self._link_error = self._session.on_lost(error)
        self._plan_queue.fail_all(self._link_error)
        self._retry_at_s = self._clock.now_s() + RECONNECT_INTERVAL_S

    def _reconnect(self) -> None:
        self._resolve_waiters(None)
        if self._clock.now_s() < self._retry_at_s:
            self._clock.sleep(IDLE_LOOP_WAIT_S)
            return
        previous_board_s = self._session.board_s()
        try:
            self._session.connect()
        except (LinkError, InputError) as error:
            self._link_error = str(error)
            self._retry_at_s = self._clock.now_s() + RECONNECT_INTERVAL_S
            return
        # The board may have restarted its clock: what is known of heat moves onto the new one.
        self._plan_queue.on_board_restarted(self._session.board_s() - previous_board_s)
        self._link_error = None

    def _publish_cause(self) -> None:
        cause = self._session.likely_cause
        if cause is not self._published_cause:
            self._published_cause = cause
            if cause is not None:
                self.on_warning(f"board at {self._session.port}: {cause.message}")

    # --- commands from any thread -------------------------------------------------------------------------------

    def arm(self) -> "Future[StateReport]":
        """Arm the board; done when it is ARMED."""
        return self._submit_command(self._session.arm, (BoardState.ARMED,), "arm")

    def disarm(self) -> "Future[StateReport]":
        """Disarm, or acknowledge a fault; done when the board is DISARMED."""
        return self._submit_command(self._session.disarm, (BoardState.DISARMED,), "disarm")

    def stop(self) -> "Future[StateReport]":
        """Abort: gate off, queue dropped; done when the board is dark for good."""
        return self._submit_command(self._session.abort, IDLE_STATES, "stop")

    def _submit_command(
        self, action: Callable[[], None], states: tuple[str, ...], command: str
    ) -> "Future[StateReport]":
        future: Future[StateReport] = uncancellable_future()

        def run_command() -> None:
            try:
                self._require_link()
                action()
            except OptodriveError as error:
                future.set_exception(error)
                return
            if command != "arm":
                self._plan_queue.fail_all(f"ended by {command}")
            self._state_waiters.add(states, command, self._clock.now_s(), future)

        self._commands.put(run_command)
        return future

    def _require_link(self) -> None:
        if not self._session.connected:
            raise LinkError(self._link_error or "no link to the board")

    def _resolve_waiters(self, refusal: str | None) -> None:
        self._state_waiters.resolve(self._session, refusal, self._link_error, self._clock.now_s(), self.snapshot)

    # --- plans --------------------------------------------------------------------------------------------------

    def submit(
        self,
        build: Callable[[], FrameSequence],
        name: str,
        dry_run: bool = False,
        policy: Policy = "trim",
        fit: FitMode = "as_is",
        streamed: bool = False,
        arrived_s: float | None = None,
    ) -> "Future[PlanReport]":
        """Plan the sequence that `build` makes, and queue it unless dry_run; answers what will be shown when.

        streamed: it takes the place of everything that has not left yet, and gives way to the next such in turn.
        arrived_s: board time at which it was asked for, if not now
        """
        if streamed and fit != "as_is":
            raise InputError("fit", fit, "as_is where the newest wins: a stream has no time to ask what else would fit")
        arrived_s = self.board_s() if arrived_s is None else arrived_s
        return self._planner.submit(
            PlanningRequest(build, name, dry_run, policy, fit, streamed and not dry_run, arrived_s)
        )

    def _require_armed(self) -> None:
        self._require_link()
        board = self._session.board
        if board.state not in ARMED_STATES:
            fault = f" {board.fault}: {get_fault_hint(board.fault)}" if board.fault else ""
            raise NotReadyError(f"the board is {board.state}{fault}; arm it first (POST /v1/arm, or `optodrive arm`)")
        if len(self._plan_queue.waiting) >= QUEUE_MAX:
            raise NotReadyError(f"{QUEUE_MAX} plans wait already; wait for one to end, or cancel one")

    def _submit_to_loop(self, action: Callable[[], T]) -> "Future[T]":
        """Do something in the loop's thread, which owns the session."""
        future: Future[T] = uncancellable_future()

        def run_command() -> None:
            try:
                future.set_result(action())
            except OptodriveError as error:
                future.set_exception(error)

        self._commands.put(run_command)
        return future

    def _run_in_loop(self, action: Callable[[], T]) -> T:
        """What comes of an action in the loop's thread; LinkError where the loop has ended."""
        try:
            return self._submit_to_loop(action).result(LOOP_TIMEOUT_S)
        except TimeoutError:
            raise LinkError(f"the engine did not answer within {LOOP_TIMEOUT_S:g} s: {self.failure!r}") from None

    def board_s(self) -> float:
        """The board's time now, s."""
        return self._session.board_s()

    def get_end_future(self, plan_id: str) -> "Future[None]":
        """Done when nothing more will happen to a plan; InputError (plan_not_found) where there is none."""
        return self._plan_store.find(plan_id).end_future

    def end_stream(self) -> "Future[PlanReport]":
        """Let go what has not left of a stream's last plan: whoever sent it is gone."""
        blank_frame = TactileFrame("", 0.0, 1.0, np.zeros(len(self.display.layout)))
        return self.submit(lambda: FrameSequence((blank_frame,)), "end of stream", streamed=True)

    def get_plan(self, plan_id: str, pulses: bool = True) -> PlanReport:
        """A plan by its id; InputError (plan_not_found) where there is none."""
        return self._plan_store.find(plan_id).build_report(self._session.board_s(), pulses)

    def cancel(self, plan_id: str) -> "Future[PlanReport]":
        """Take a plan out of the queue, or end it dark; the board stays armed."""

        def end() -> PlanReport:
            record = self._plan_store.find(plan_id)
            self._plan_queue.cancel(record)
            return record.build_report(self._session.board_s())

        return self._submit_to_loop(end)

    def add_plan_end_callback(self, callback: Callable[[PlanRecord], None]) -> None:
        """Have each plan told when it has ended, by whichever thread ended it; `tell` must not wait."""
        self._plan_store.end_callbacks.append(callback)

    @property
    def tick_s(self) -> float:
        """The board's tick, s."""
        return self._session.scale.tick_s

    # --- what can be seen from outside --------------------------------------------------------------------------

    @property
    def link_name(self) -> str:
        """The board's port."""
        return self._session.port

    @property
    def is_linked(self) -> bool:
        """Whether there is a link to the board, and its clock is known."""
        return self._session.connected

    @property
    def scale(self) -> WireScale:
        """How SI becomes codes on this board."""
        return self._session.scale

    def drain_events(self) -> list[PlanProgress | ClockShift]:
        """What was done since the last call, in order; for one reader."""
        events, drained = self._plan_queue.events, []
        while events:
            drained.append(events.popleft())
        return drained

    def list_upcoming(self) -> list[PlanRecord]:
        """The plans that run, and the first that waits."""
        plan_queue = self._plan_queue
        waiting = plan_queue.waiting.copy()
        return [run.record for run in plan_queue.running.copy()] + ([waiting[0]] if waiting else [])

    @property
    def board_state(self) -> str:
        """The board's state, or the link's."""
        return self._session.board.state if self._session.connected else "no link"

    def snapshot(self) -> StateReport:
        """Report everything that GET /v1/state sends."""
        plan_queue, session = self._plan_queue, self._session
        running = next(iter(plan_queue.running.copy()), None)
        recent = self._plan_store.list_recent()
        return StateReport(
            display=self.display.config.name,
            pixels=len(self.display.layout),
            link=LinkReport(
                port=session.port,
                state="up" if session.connected else "down",
                error=self._link_error,
                **session.collect_link_stats(),
            ),
            board=BoardReport(**session.board.to_dict()),
            queue=QueueReport(
                waiting=len(plan_queue.waiting),
                running=None if running is None else running.record.plan_id,
                plans=[RecentPlan(plan=item.plan_id, name=item.name, status=item.status) for item in recent],
            ),
            totals=PulseTotals(**plan_queue.totals, timing_error=plan_queue.timing.worst),
            planner=PlannerReport(busy=self._planner.is_busy, alive=self._planner.is_alive),
        )

    def render_metrics(self) -> str:
        """Everything GET /metrics answers."""
        return render_metrics(self.snapshot(), self._plan_counters, self._session, self.display.config.board.lease_s)
