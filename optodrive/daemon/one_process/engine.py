"""Engine of the daemon, which owns the board session and alone renews its lease.

The engine's loop runs in its own thread, communicates with the board and renews the lease. It does so only while the
planner, in a second thread, is idle or makes progress. Methods for other threads return futures.
"""

import gc
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

import numpy as np

from optodrive.core.clock import Clock, request_realtime_scheduling
from optodrive.core.errors import InputError, LinkError, NotReadyError, OptodriveError
from optodrive.core.types.policy import Policy
from optodrive.core.types.stimuli import FrameSequence, TactileFrame
from optodrive.daemon.one_process.loop_commands import LoopCommands
from optodrive.daemon.one_process.metrics import PlanCounters, render_metrics
from optodrive.daemon.one_process.plan_queue import PlanQueue
from optodrive.daemon.one_process.plan_record import PlanRecord, PlanStore
from optodrive.daemon.one_process.planner import Planner, PlanningRequest
from optodrive.daemon.one_process.progress import ClockShift, PlanProgress
from optodrive.daemon.one_process.state_report import build_state_report
from optodrive.daemon.one_process.state_waiters import StateWaiters, uncancellable_future
from optodrive.daemon.responses.plan import PlanReport
from optodrive.daemon.responses.state import StateReport
from optodrive.link.board_setup import build_board_requirements
from optodrive.link.protocol.quantisation import WireScale
from optodrive.link.protocol.states import ARMED_STATES, IDLE_STATES, BoardState
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
    """Executor of plans on a board. Methods that return futures may be called from any thread.

    failure: exception that ended the loop, None while it runs
    on_failure: called after such an exception, once the session has sent ABORT
    on_warning: called with one line for the log when the link fails
    on_loop: called in every loop iteration; must return quickly
    """

    def __init__(self, display: DisplayModel, transport: Transport, clock: Clock) -> None:
        self.display = display
        self.failure: BaseException | None = None
        self.on_failure: Callable[[], None] = lambda: None
        self.on_warning: Callable[[str], None] = lambda line: None
        self.on_loop: Callable[[], None] = lambda: None
        self._clock = clock
        self._session = BoardSession(transport, clock, build_board_requirements(display.config))
        self._plan_store = PlanStore()
        self._plan_counters = PlanCounters()
        self._plan_store.end_callbacks.append(self._plan_counters.record_end)
        self._simulation_executor = ThreadPoolExecutor(1, thread_name_prefix="simulation")
        self._plan_queue = PlanQueue(display, self._session, self._plan_store, self._simulation_executor)
        self._commands = LoopCommands()
        self._state_waiters = StateWaiters()
        self._closing = threading.Event()
        self._planner = Planner(display, self._session, self._plan_queue, clock, self._run_in_loop, self._require_armed)
        self._link_error: str | None = None
        self._published_cause: LinkCause | None = None
        self._retry_at_s = 0.0
        self._thread = threading.Thread(target=self._run, name="engine", daemon=True)

    # --- lifecycle ----------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Connect to the board and start the loop. Raise InputError or LinkError if the board cannot be reached."""
        # The loop releases the GIL at every read and write. While the planner computes, it would wait 5 ms each time to
        # reacquire it, and a few such waits exceed the lease.
        sys.setswitchinterval(SWITCH_INTERVAL_S)
        # Compilation in the planner reports no progress and would let the lease expire.
        warm_up(self.display)
        # A garbage collection over all imported modules would stall the loop for more than half a lease.
        gc.collect()
        gc.freeze()
        self._session.connect()
        self._thread.start()

    def close(self) -> None:
        """Send ABORT to the board and end the threads."""
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
        self._commands.run_pending()
        if not self._session.connected:
            self._reconnect()
            return
        busy = self._plan_queue.is_busy or self._state_waiters
        self._session.step(LOOP_WAIT_S if busy else IDLE_LOOP_WAIT_S, renew_lease=self._planner.is_alive)
        refusal = self._session.pop_refusal()
        self._resolve_waiters(refusal)
        self._plan_queue.update_jobs(refusal)
        self._plan_queue.start_next()

    # --- link ---------------------------------------------------------------------------------------------------

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
        # The board may have restarted its clock: shift heat and budget to the new one.
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
        """Arm the board. The future is done when it is ARMED."""
        return self._submit_command(self._session.arm, (BoardState.ARMED,), "arm")

    def disarm(self) -> "Future[StateReport]":
        """Disarm, or acknowledge a fault. The future is done when the board is DISARMED."""
        return self._submit_command(self._session.disarm, (BoardState.DISARMED,), "disarm")

    def stop(self) -> "Future[StateReport]":
        """Abort: turn the gate off and drop the queue. The future is done when the board has confirmed it."""
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

        self._commands.post(run_command)
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
        caller: str = "",
    ) -> "Future[PlanReport]":
        """Plan the sequence that `build` returns, and queue the plan unless dry_run.

        streamed: replace everything not yet sent; the next streamed plan replaces this one in the same way
        arrived_s: board time at which the request arrived, if not now
        caller: name of the token that submitted it
        """
        if streamed and fit != "as_is":
            raise InputError("fit", fit, "as_is for streamed plans: a stream has no time for a feasibility check")
        arrived_s = self.board_s() if arrived_s is None else arrived_s
        return self._planner.submit(
            PlanningRequest(build, name, dry_run, policy, fit, streamed and not dry_run, arrived_s, caller)
        )

    def _require_armed(self) -> None:
        self._require_link()
        board = self._session.board
        if board.state not in ARMED_STATES:
            fault = f" {board.fault}: {get_fault_hint(board.fault)}" if board.fault else ""
            raise NotReadyError(f"the board is {board.state}{fault}; arm it first (POST /v1/arm, or `optodrive arm`)")
        if len(self._plan_queue.waiting) >= QUEUE_MAX:
            raise NotReadyError(f"{QUEUE_MAX} plans are already waiting; wait for one to end, or cancel one")

    def _run_in_loop(self, action: Callable[[], T]) -> T:
        """Run an action in the loop's thread and return its result. Raise LinkError if the loop has ended."""
        try:
            return self._commands.submit(action).result(LOOP_TIMEOUT_S)
        except TimeoutError:
            raise LinkError(f"the engine did not respond within {LOOP_TIMEOUT_S:g} s: {self.failure!r}") from None

    def board_s(self) -> float:
        """Return the present board time, s."""
        return self._session.board_s()

    def get_end_future(self, plan_id: str) -> "Future[None]":
        """Return a future that is done when a plan has ended. Raise InputError (plan_not_found) for an unknown plan."""
        return self._plan_store.find(plan_id).end_future

    def end_stream(self, caller: str = "") -> "Future[PlanReport]":
        """Drop the unsent rest of a stream's last plan after its client has disconnected."""
        blank_frame = TactileFrame("", 0.0, 1.0, np.zeros(len(self.display.layout)))
        return self.submit(lambda: FrameSequence((blank_frame,)), "end of stream", streamed=True, caller=caller)

    def get_plan(self, plan_id: str, pulses: bool = True) -> PlanReport:
        """Report a plan. Raise InputError (plan_not_found) for an unknown plan."""
        return self._plan_store.find(plan_id).build_report(self._session.board_s(), pulses)

    def cancel(self, plan_id: str) -> "Future[PlanReport]":
        """Remove a waiting plan, or turn the gate off and end a running one. The board stays armed."""

        def end() -> PlanReport:
            record = self._plan_store.find(plan_id)
            self._plan_queue.cancel(record)
            return record.build_report(self._session.board_s())

        return self._commands.submit(end)

    def add_plan_end_callback(self, callback: Callable[[PlanRecord], None]) -> None:
        """Register a callback for every plan that ends. Any thread may call it; it must not block."""
        self._plan_store.end_callbacks.append(callback)

    @property
    def tick_s(self) -> float:
        """Tick of the board, s."""
        return self._session.scale.tick_s

    # --- state --------------------------------------------------------------------------------------------------

    @property
    def link_name(self) -> str:
        """Port of the board."""
        return self._session.port

    @property
    def is_linked(self) -> bool:
        """Whether the link to the board is up and its clock synchronised."""
        return self._session.connected

    @property
    def scale(self) -> WireScale:
        """Scale factors between SI units and this board's integers."""
        return self._session.scale

    def drain_events(self) -> list[PlanProgress | ClockShift]:
        """Return and remove the events since the last call, in order. Only one reader may call it."""
        events, drained = self._plan_queue.events, []
        while events:
            drained.append(events.popleft())
        return drained

    def list_upcoming(self) -> list[PlanRecord]:
        """Return the running plans and the first waiting one."""
        plan_queue = self._plan_queue
        waiting = plan_queue.waiting.copy()
        return [run.record for run in plan_queue.running.copy()] + ([waiting[0]] if waiting else [])

    @property
    def board_state(self) -> str:
        """State of the board, `no link` without a link."""
        return self._session.board.state if self._session.connected else "no link"

    def snapshot(self) -> StateReport:
        """Report everything that GET /v1/state sends."""
        return build_state_report(
            self.display,
            self._session,
            self._plan_queue,
            self._plan_store.list_recent(),
            self._planner,
            self._link_error,
        )

    def render_metrics(self) -> str:
        """Render the response of GET /metrics."""
        return render_metrics(self.snapshot(), self._plan_counters, self._session, self.display.config.board.lease_s)
