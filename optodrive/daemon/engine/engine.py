"""Engine of the planner process: it plans, queues plans and hands their points over to the link process.

The engine's loop owns the connection to the link process. It proves to that process that the planner, in a second
thread, is idle or makes progress. Methods for other threads return futures.
"""

import sys
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import TypeVar

import numpy as np

from optodrive.core.clock import Clock
from optodrive.core.errors import InputError, LinkError, NotReadyError
from optodrive.core.processes import use_usual_priority
from optodrive.core.types.stimuli import FrameSequence, TactileFrame
from optodrive.daemon.engine.active_plan import ActivePlan, PlanStore
from optodrive.daemon.engine.kept_heat import KeptHeat
from optodrive.daemon.engine.metrics import ClockShift, PlanCounters, PlanProgress, build_queue_report, render_metrics
from optodrive.daemon.engine.page_refresh import PageRefresh
from optodrive.daemon.engine.plan_making import NEVER, Dimmer, PlanningRequest
from optodrive.daemon.engine.plan_queue import PlanQueue
from optodrive.daemon.engine.plan_rest import ThermalMemory
from optodrive.daemon.engine.planner import Planner
from optodrive.daemon.message_loop import LoopCommands, MessageLoop
from optodrive.daemon.push import BuiltRequest, Push
from optodrive.daemon.responses.plan import PlanReport
from optodrive.daemon.responses.state import LimitsReport, PlannerReport, PlannerState, PulseTotals
from optodrive.link.protocol.quantisation import WireScale
from optodrive.link.protocol.states import ARMED_STATES
from optodrive.link.service.remote_session import RemoteSession
from optodrive.link.session.board_view import get_fault_hint
from optodrive.link.session.clock_sync import ClockReading
from optodrive.link.session.group_state import LostStage
from optodrive.link.session.link_watch import LinkCause
from optodrive.planning.display_model import DisplayModel

LOOP_WAIT_S = 0.05
SWITCH_INTERVAL_S = 2e-4
QUEUE_MAX = 50
QUEUED_PULSES_MAX = 2_000_000
"""Pulses of all running and waiting plans: about 400 MB."""
LOOP_TIMEOUT_S = 5.0
T = TypeVar("T")


class Engine:
    """Executor of plans. Methods that return futures may be called from any thread.

    message_loop: loop over the connections of the engine's thread, also for its clients
    commands: actions that the engine's thread carries out
    on_loop: called in every loop iteration; must return quickly
    on_beat: called in every loop iteration, and during long computations in the loop's thread
    on_warning: called with one line for the log when the link fails
    page: selects what is drawn next of a standing page
    memory: shared with earlier and later planner processes, None without any
    """

    def __init__(
        self,
        display: DisplayModel,
        session: RemoteSession,
        clock: Clock,
        memory: ThermalMemory | None = None,
    ) -> None:
        self.display = display
        self.message_loop = MessageLoop()
        self.commands = LoopCommands()
        self.on_loop: Callable[[], None] = lambda: None
        self.on_beat: Callable[[], None] = lambda: None
        self.on_warning: Callable[[str], None] = lambda line: None
        self._clock = clock
        self._session = session
        self._plan_store = PlanStore()
        self._plan_counters = PlanCounters()
        self._plan_store.end_callbacks.append(self._plan_counters.record_end)
        self._simulation_executor = ThreadPoolExecutor(1, "simulation", use_usual_priority)
        self._planning_executor = ThreadPoolExecutor(1, "planner", use_usual_priority)
        self._plan_queue = PlanQueue(display, session, self._plan_store, self._simulation_executor)
        self.page = PageRefresh(display.layout, clock, self.board_s, lambda: self._plan_queue.lead_s)
        self._memory = ThermalMemory() if memory is None else memory
        self._heat = KeptHeat(
            display,
            session,
            self._plan_queue,
            clock,
            ThreadPoolExecutor(1, "heat", use_usual_priority),
            self._memory.owner,
            lambda: self.commands.post(lambda: None),
        )
        self._heat.on_warm = lambda text: self.on_warning(text)
        self._dimmer = Dimmer(display, self._memory)
        self._planner = Planner(
            self._dimmer,
            session,
            self._plan_queue,
            clock,
            self._planning_executor,
            self._run_in_loop,
            self._require_armed,
        )
        self._plan_queue.on_progress = self._beat
        self._epoch = session.epoch
        self._restored = self._continues = False
        self._saved_key: object = None
        self._published_cause: LinkCause | None = None
        self._published_loss: LostStage | None = None
        self.message_loop.watch(self.commands, lambda: None)
        self.message_loop.watch(session.connection, session.connection.receive)

    # --- loop ---------------------------------------------------------------------------------------------------

    def run(self, is_closing: Callable[[], bool]) -> None:
        """Run the loop until is_closing() returns true, then end the connection to the link process.

        The display must be warm, because compilation reports no progress.
        """
        # While the planner computes, the loop would wait 5 ms for the interpreter lock each time it continues.
        sys.setswitchinterval(SWITCH_INTERVAL_S)
        try:
            while not is_closing():
                self.run_once(LOOP_WAIT_S)
                self.on_loop()
        finally:
            self._session.connection.close()

    def run_once(self, wait_s: float) -> None:
        """Run one loop iteration, which waits at most wait_s for messages and commands."""
        self.commands.run_pending()
        self._session.connect_if_due()
        # The rest of a streamed frame is due at a time, not at a message.
        self.message_loop.poll(min(wait_s, self._planner.growth_due_in_s))
        self._follow_link()
        self._plan_queue.update_jobs(self._session.pop_refusal())
        self._planner.follow_queue()
        self._save_thermal_state()  # before a plan starts, so that a successor of this process knows its heat
        # A planner that does not know what an earlier one has heated plays nothing.
        if self._heat.may_emit:
            self._plan_queue.start_next()
        self._beat()
        self._publish_cause()

    def _follow_link(self) -> None:
        """End all plans on a new epoch, and follow a restart of the board's clock."""
        clock_shift_s = self._session.pop_clock_shift()
        if self._session.epoch != self._epoch:
            self._epoch = self._session.epoch
            self._plan_queue.end_epoch(self._session.epoch_reason, clock_shift_s or 0.0)
        if clock_shift_s is not None:
            self._plan_queue.on_board_restarted(clock_shift_s)

    def _save_thermal_state(self) -> None:
        """Continue from the state of an earlier planner once the board's time is known, then save every new state."""
        if self._session.connected and not self._restored:
            self._restored = True
            saved = self._memory.load()
            if saved is not None:
                self._continues = True
                self._plan_queue.restore(saved, self._clock.now_s())
        if self._restored:
            self._heat.follow(self._continues)
        if not self._session.connected:
            return
        # Building the state costs time, comparing its key does not.
        key = self._plan_queue.saved_key
        if key != self._saved_key:
            self._saved_key = key
            self._memory.save(self._plan_queue.build_saved_state(self._clock.now_s()))

    def _beat(self) -> None:
        """Prove to the link process and to the supervisor that the loop runs."""
        # Without these beats the lease of the board is not renewed, and its gate goes off.
        self._session.beat(self._planner.is_alive)
        self.on_beat()

    def _publish_cause(self) -> None:
        self._publish_loss()
        cause = self._session.likely_cause
        if cause != self._published_cause:
            self._published_cause = cause
            if cause is not None:
                self.on_warning(f"board at {self._session.port}: {cause.message}")

    def _publish_loss(self) -> None:
        lost = self._session.lost
        if lost != self._published_loss:
            self._published_loss = lost
            if lost is not None:
                name = self.display.config.stages[lost.stage].name
                self.on_warning(f"stage {name} was lost, the others go on: {lost.reason}")

    def close(self) -> None:
        """End the threads and close the loop, after run()."""
        # Without waiting: a long plan must not delay the end of the process.
        self._planning_executor.shutdown(wait=False, cancel_futures=True)
        self._simulation_executor.shutdown(wait=False, cancel_futures=True)
        self._heat.close()
        self.commands.close()

    def _run_in_loop(self, action: Callable[[], T]) -> T:
        """Run an action in the loop's thread and return its result. Raise LinkError if the loop has ended."""
        try:
            return self.commands.submit(action).result(LOOP_TIMEOUT_S)
        except TimeoutError:
            raise LinkError(f"the planner's loop did not respond within {LOOP_TIMEOUT_S:g} s") from None

    # --- plans --------------------------------------------------------------------------------------------------

    def submit(
        self, build: Callable[[], BuiltRequest], push: Push, caller_left: threading.Event = NEVER
    ) -> "Future[PlanReport]":
        """Plan the sequence that `build` returns, and queue the plan. Raise BusyError if too many requests wait.

        caller_left: set when the caller no longer waits, which ends the planning
        """
        for name, value in push.options.items() if push.streamed else ():
            if name != "policy" and value != "as_is":
                raise InputError(name, value, "no such option: a stream has no time for more than a policy")
        arrived_s = self.board_s() - (self._clock.now_s() - push.arrived_s)
        select = partial(self.page.select, touched_only=push.touched_only) if push.standing else None
        future = self._planner.submit(PlanningRequest(build, push, arrived_s, caller_left, select))
        if push.standing:
            future.add_done_callback(self._note_page_limits)
        return future

    def _note_page_limits(self, future: "Future[PlanReport]") -> None:
        if not future.cancelled() and future.exception() is None:
            self.page.note_limits(future.result().summary.limited_by)

    def _require_armed(self) -> None:
        """Raise LinkError or NotReadyError if the board accepts no plans."""
        if not self._session.connected:
            raise LinkError(self._session.link_error or "no link to the board")
        board = self._session.board
        if board.state not in ARMED_STATES:
            fault = f" {board.fault}: {get_fault_hint(board.fault)}" if board.fault else ""
            raise NotReadyError(f"the board is {board.state}{fault}; arm it first (POST /v1/arm, or `optodrive arm`)")
        if len(self._plan_queue.state.waiting) >= QUEUE_MAX:
            raise NotReadyError(f"{QUEUE_MAX} plans are already waiting; wait for one to end, or cancel one")
        if self._plan_queue.count_pulses() >= QUEUED_PULSES_MAX:
            raise NotReadyError(
                f"{QUEUED_PULSES_MAX} pulses are already waiting; wait for a plan to end, or cancel one"
            )
        self._heat.require_known()

    def end_stream(self, epoch: int, caller: str) -> "Future[PlanReport]":
        """Drop the unsent rest of a stream's last plan after its client has disconnected."""
        blank_frame = TactileFrame("", 0.0, 1.0, np.zeros(len(self.display.layout)))
        push = Push("end of stream", {}, self._clock.now_s(), epoch, caller, streamed=True)
        return self.submit(lambda: BuiltRequest(FrameSequence((blank_frame,))), push)

    def get_plan(self, plan_id: str, pulses: bool = True) -> PlanReport:
        """Report a plan. Raise InputError (plan_not_found) for an unknown plan."""
        return self._plan_store.find(plan_id).build_report(self.board_s(), pulses, self.read_clocks())

    def cancel(self, plan_id: str) -> "Future[PlanReport]":
        """Remove a waiting plan, or turn the gate off and end a running one. The board stays armed."""

        def end() -> PlanReport:
            record = self._plan_store.find(plan_id)
            self._plan_queue.cancel(record)
            return record.build_report(self.board_s(), clocks=self.read_clocks())

        return self.commands.submit(end)

    def revoke(self, caller: str) -> None:
        """End all plans of a caller whose token was revoked. Only the engine's thread may call it."""
        self._plan_queue.revoke(caller)

    def add_plan_end_callback(self, callback: Callable[[ActivePlan], None]) -> None:
        """Register a callback for every plan that ends. Any thread may call it, and it must not block."""
        self._plan_store.end_callbacks.append(callback)

    # --- state --------------------------------------------------------------------------------------------------

    def board_s(self) -> float:
        """Return the present board time, s."""
        return self._session.board_s()

    def read_clocks(self) -> ClockReading | None:
        """Return the present time on the clocks of board and host, None while they are not synchronised."""
        return self._session.read_clocks()

    @property
    def dimmer(self) -> Dimmer:
        """Cap on the power of the plans from now on. Only the engine's thread may set it."""
        return self._dimmer

    @property
    def is_linked(self) -> bool:
        """Whether the link to the board is up and its clock synchronised."""
        return self._session.connected

    @property
    def scales(self) -> tuple[WireScale, ...]:
        """Scale factors between SI units and the integers of each stage's board."""
        return self._session.scales

    @property
    def plan_queue(self) -> PlanQueue:
        """Running and waiting plans."""
        return self._plan_queue

    def drain_events(self) -> list[PlanProgress | ClockShift]:
        """Return and remove the events since the last call, in order. Only one reader may call it."""
        events, drained = self._plan_queue.accounts.events, []
        while events:
            drained.append(events.popleft())
        return drained

    def list_upcoming(self) -> list[ActivePlan]:
        """Return the running plans and the first waiting one, whose time is known unless the light is paused."""
        state = self._plan_queue.state
        return [*(run.plan for run in state.running), *(() if state.off_s is not None else state.waiting[:1])]

    @property
    def board_state(self) -> str:
        """State of the board, `no link` without a link."""
        return self._session.board.state if self._session.connected else "no link"

    def compute_state_key(self) -> object:
        """Return a value that changes with everything in the planner's state but the totals."""
        plans = tuple((record.plan_id, record.status) for record in self._plan_store.list_recent())
        heat = bool(self._heat.read_cooling()[1])
        planner = self._planner.is_busy, self._planner.is_alive, self._dimmer.power_share, heat
        return plans, len(self._plan_queue.state.waiting), self._plan_queue.is_held, planner

    def build_planner_state(self) -> PlannerState:
        """Report queue and planner."""
        queue, accounts = self._plan_queue, self._plan_queue.accounts
        recent, clocks_s = self._plan_store.list_recent(), (self.board_s(), self._clock.now_s())
        return PlannerState(
            queue=build_queue_report(queue.state, queue.pause_ends_in_s, recent, *clocks_s),
            totals=PulseTotals(
                **accounts.totals,
                timing_error=accounts.timing.worst,
                frames_shown=self._plan_counters.frames_shown,
                frames_superseded=self._plan_counters.frames_superseded,
            ),
            planner=PlannerReport(busy=self._planner.is_busy, alive=self._planner.is_alive),
            limits=self._build_limits(),
        )

    def _build_limits(self) -> LimitsReport:
        reason, cooling_s = self._heat.read_cooling()
        return LimitsReport(
            power_share=self._dimmer.power_share, hot_reason=reason, hot_for_s=cooling_s if reason else None
        )

    def render_metrics(self) -> str:
        """Render the response of GET /metrics."""
        return render_metrics(self.display.config, self._session, self.build_planner_state(), self._plan_counters)
