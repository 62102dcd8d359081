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

from optodrive.core.clock import Clock, claim_processor
from optodrive.core.errors import InputError, LinkError, NotReadyError, OptodriveError
from optodrive.core.types.stimuli import FrameSequence, TactileFrame
from optodrive.daemon.engine.metrics import PlanTally, metrics
from optodrive.daemon.engine.plan_queue import Programme
from optodrive.daemon.engine.plan_record import PlanBook, PlanRecord
from optodrive.daemon.engine.planner import Order, Planner
from optodrive.daemon.engine.progress import ClockMoved, Progress
from optodrive.daemon.engine.state_waiters import Answer, Waits, promise
from optodrive.link.protocol.quantisation import WireScale
from optodrive.link.session.board_requirements import Requirements
from optodrive.link.session.fault_hints import hint
from optodrive.link.session.link_watch import Cause
from optodrive.link.session.session import Session
from optodrive.link.transport.base import Transport
from optodrive.planning.feasibility import Fit
from optodrive.planning.limiter.limiter import Policy
from optodrive.planning.pipeline import Display, warm_up

TURN_S = 0.002
IDLE_TURN_S = 0.01
SWITCH_INTERVAL_S = 2e-4
RECONNECT_S = 1.0
QUEUE_MAX = 50
LOOP_TIMEOUT_S = 5.0
T = TypeVar("T")


class Engine:
    """Runs plans on a board. Methods that return futures may be called from any thread.

    failure: what ended the loop, None while it runs; on_failure is then called, after the board was told to abort.
    say: gets a line whenever the link goes wrong, for the log. on_turn: called at every turn of the loop; must be quick
    """

    def __init__(self, display: Display, transport: Transport, clock: Clock) -> None:
        self.display = display
        self.failure: BaseException | None = None
        self.on_failure: Callable[[], None] = lambda: None
        self.say: Callable[[str], None] = lambda line: None
        self.on_turn: Callable[[], None] = lambda: None
        self._clock = clock
        self._session = Session(transport, clock, Requirements.of(display.config))
        self._book = PlanBook()
        self._tally = PlanTally()
        self._book.on_end.append(self._tally.note)
        self._bookkeeper = ThreadPoolExecutor(1, thread_name_prefix="bookkeeper")
        self._programme = Programme(display, self._session, self._book, self._bookkeeper)
        self._commands: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._waits = Waits()
        self._closing = threading.Event()
        self._planner = Planner(display, self._session, self._programme, clock, self._by_loop, self._require_armed)
        self._link_error: str | None = None
        self._told: Cause | None = None
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
        self._bookkeeper.shutdown(wait=False, cancel_futures=True)

    def _run(self) -> None:
        claim_processor()
        try:
            while not self._closing.is_set():
                try:
                    self._turn()
                except (LinkError, InputError) as error:
                    self._link_lost(error)
                self._tell_cause()
                self.on_turn()
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
        self._session.step(TURN_S if busy else IDLE_TURN_S, lease=self._planner.alive)
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

    # --- the link -----------------------------------------------------------------------------------------------

    def _link_lost(self, error: OptodriveError) -> None:
        self._link_error = self._session.lost(error)
        self._programme.fail_all(self._link_error)
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

    def _tell_cause(self) -> None:
        cause = self._session.likely_cause
        if cause is not self._told:
            self._told = cause
            if cause is not None:
                self.say(f"board at {self._session.port}: {cause.sentence}")

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
        return self._planner.submit(Order(build, name, dry_run, policy, fit, streamed and not dry_run, arrived_s))

    def _require_armed(self) -> None:
        self._require_link()
        board = self._session.board
        if board.state not in ("ARMED", "RUNNING", "HOLD"):
            fault = f" {board.fault}: {hint(board.fault)}" if board.fault else ""
            raise NotReadyError(f"the board is {board.state}{fault}; arm it first (POST /v1/arm, or `optodrive arm`)")
        if len(self._programme.waiting) >= QUEUE_MAX:
            raise NotReadyError(f"{QUEUE_MAX} plans wait already; wait for one to end, or cancel one")

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

    def on_plan_end(self, tell: Callable[[PlanRecord], None]) -> None:
        """Have each plan told when it has ended, by whichever thread ended it; `tell` must not wait."""
        self._book.on_end.append(tell)

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
    def linked(self) -> bool:
        """Whether there is a link to the board, and its clock is known."""
        return self._session.connected

    @property
    def scale(self) -> WireScale:
        """How SI becomes codes on this board."""
        return self._session.scale

    def take_told(self) -> list[Progress | ClockMoved]:
        """What was done since the last call, in order; for one reader."""
        told, taken = self._programme.told, []
        while told:
            taken.append(told.popleft())
        return taken

    def coming(self) -> list[PlanRecord]:
        """The plans that run, and the first that waits."""
        programme = self._programme
        waiting = programme.waiting.copy()
        return [run.record for run in programme.running.copy()] + ([waiting[0]] if waiting else [])

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
            "totals": {**programme.totals, "timing_error": programme.timing.figures()},
            "planner": {"busy": self._planner.busy, "alive": self._planner.alive},
        }

    def metrics(self) -> str:
        """Everything GET /metrics answers."""
        return metrics(self.snapshot(), self._tally, self._session, self.display.config.board.lease_s)
