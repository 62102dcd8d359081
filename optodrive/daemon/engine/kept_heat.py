"""The record of the display's heat, which the planner keeps for the next daemon.

Theory of operation

The planner opens the record (`planning/heat_record.py`) once it knows which boards it has, and holds it to its end, so
that no other process uses the display meanwhile. From the begin of each arming until the queue is empty and no board is
armed, the record says that the display is in use: no plan starts before it does. What ends without a word in between
leaves a hot display to the next daemon.

A planner process that is replaced leaves its estimate in the memory of the daemon (`plan_rest.py`), which is
newer than the record. It counts unless another process has written the record since.

Threads. `follow` and `close` belong to the loop that owns the session; any thread may call `require_known`. The disk
may take seconds, in which the loop must beat: the executor's only thread uses it, and the loop looks at the outcome.
"""

import threading
from collections.abc import Callable
from concurrent.futures import Executor, Future
from typing import Any, NamedTuple

from optodrive.core.clock import Clock
from optodrive.core.errors import InputError, NotReadyError
from optodrive.core.types.plans import BudgetState
from optodrive.daemon.engine.active_plan import ThermalEstimate
from optodrive.daemon.engine.plan_queue import PlanQueue
from optodrive.daemon.responses.plan import PlanStatus
from optodrive.link.protocol.states import LEASED_STATES
from optodrive.link.service.remote_session import RemoteSession
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.heat_record import HeatRecord, identify_display, join_uids, read_boot
from optodrive.planning.limiter.limiter import shift_state

RETRY_S = 1.0
KNOWN_TIMEOUT_S = 1.0
"""Longest wait of the planner for the record, shorter than the time after which it counts as stalled."""


class Recalled(NamedTuple):
    """A record that was opened, its state, and the uptime of that state's zero, s.

    budget: None if what this daemon knows is as new
    """

    record: HeatRecord
    budget: BudgetState | None
    zero_s: float


class KeptHeat:
    """Record of the heat of the display that the session's boards draw.

    owner: mark of this daemon; on_warm: called with one sentence when the display counts as hot, or as not yet cooled
    wake: lets the loop call follow() soon; any thread may call it
    """

    def __init__(
        self,
        display: DisplayModel,
        session: RemoteSession,
        plan_queue: PlanQueue,
        clock: Clock,
        executor: Executor,
        owner: str,
        wake: Callable[[], None] = lambda: None,
    ) -> None:
        self.on_warm: Callable[[str], None] = lambda text: None
        self._display, self._session, self._plan_queue, self._clock = display, session, plan_queue, clock
        self._executor, self._owner, self._wake = executor, owner, wake
        self._identity: str | None = None
        self._record: HeatRecord | None = None
        self._opening: Future[Recalled] | None = None
        self._writing: Future[None] | None = None
        self._known = threading.Event()
        self._is_in_use = False
        self._written: object = None
        self._error = ""
        self._retry_s = 0.0

    @property
    def may_emit(self) -> bool:
        """Whether a plan may start: the record says that the display is in use, or nothing heats it."""
        return self._identity == "" or (self._is_in_use and self._writing is None)

    def read_cooling(self) -> tuple[str, float]:
        """Return why the display counted as hot, and for how long it still cools from that, s."""
        return ("", 0.0) if self._record is None else self._record.read_cooling()

    def require_known(self) -> None:
        """Wait until it is known how warm the display is. Raise NotReadyError if that, or its use, is not recorded."""
        if not self._known.wait(KNOWN_TIMEOUT_S):
            raise NotReadyError(self._error or "the record of the display's heat is not open yet")
        if self._error:
            raise NotReadyError(self._error)

    def follow(self, continues: bool) -> None:
        """Open the record of new boards, and write it when the use of the display begins or ends.

        continues: whether the estimate continues that of an earlier planner of this daemon
        """
        self._collect()
        if self._opening is not None or self._writing is not None or self._clock.now_s() < self._retry_s:
            return
        is_up, uids = self._session.connected, self._session.list_uids()
        if is_up and all(uids) and join_uids(uids) != self._identity:
            self._open(join_uids(uids), continues)
        if self._record is None or self._opening is not None:
            return
        if is_up and self._session.board.state in LEASED_STATES:
            if not self._is_in_use:
                self._is_in_use = True
                self._write(self._record.begin_use)
        elif not self._plan_queue.is_busy and (self._is_in_use or self._written is not self._estimate):
            self._save(self._record, self._estimate)

    @property
    def _estimate(self) -> ThermalEstimate:
        return self._plan_queue.state.thermal

    # --- opening ------------------------------------------------------------------------------------------------

    def _open(self, identity: str, continues: bool) -> None:
        """Open the record of other boards than before, of which none is in use."""
        self._known.clear()
        before, self._record, self._is_in_use = self._record, None, False
        is_replaced, self._identity = before is not None, identity
        if before is not None:
            self._executor.submit(before.close)
        if not identity:
            self._known.set()
            return
        self._opening = self._executor.submit(self._recall, identity, is_replaced, continues)
        self._opening.add_done_callback(lambda _: self._wake())

    def _recall(self, identity: str, is_replaced: bool, continues: bool) -> Recalled:
        """Open a record, in the executor's thread. is_replaced: whether other boards drew the display before."""
        named = identify_display(self._display.config, identity.split("-"))
        record = HeatRecord(*named, self._display, self._clock, owner=self._owner).open()
        if is_replaced and not record.hot_reason:
            record.hot_reason = "its board was replaced"
        if continues and record.resume():
            return Recalled(record, None, 0.0)
        return Recalled(record, record.load(), read_boot()[1])

    def _collect(self) -> None:
        """Use the results of the executor."""
        if self._opening is not None and self._opening.done():
            opened, self._opening = self._opening, None
            try:
                self._begin(opened.result())
                self._error = ""
            except InputError as error:
                self._identity, self._error = None, str(error)
                self._retry_s = self._clock.now_s() + RETRY_S
        if self._writing is not None and self._writing.done():
            written, self._writing = self._writing, None
            try:
                written.result()
                self._error = ""
            except InputError as error:
                self._is_in_use, self._error = False, str(error)
                self._retry_s = self._clock.now_s() + RETRY_S
                self._plan_queue.end_all(PlanStatus.FAILED, self._error)

    def _begin(self, recalled: Recalled) -> None:
        """Replace the estimate by that of the record, if it is newer."""
        self._record = recalled.record
        self._plan_queue.end_all(PlanStatus.FAILED, "the board was replaced")
        if recalled.budget is not None:
            zero_s = self._session.board_s() - (read_boot()[1] - recalled.zero_s)
            self._plan_queue.know(ThermalEstimate(self._estimate.heat, shift_state(recalled.budget, zero_s)))
            self._written = self._estimate
        if self._record.read_cooling()[1]:
            self.on_warm(f"the display counts as {self._record.describe()}; until then plans get less light")
        self._known.set()

    # --- writing ------------------------------------------------------------------------------------------------

    def _save(self, record: HeatRecord, estimate: ThermalEstimate) -> None:
        """Record an estimate after the last light."""
        board_s, now_s = self._session.board_s(), read_boot()[1]

        def save() -> None:
            record.save(estimate.budget, board_s + read_boot()[1] - now_s)

        self._is_in_use, self._written = False, estimate
        self._write(save)

    def _write(self, action: Callable[[], Any]) -> None:
        self._writing = self._executor.submit(action)
        self._writing.add_done_callback(lambda _: self._wake())

    def close(self) -> None:
        """Record the heat after the last light, once the connection to the link process has ended, and end."""
        if self._record is not None:
            self._save(self._record, self._plan_queue.build_final_estimate())
            self._executor.submit(self._record.close)
        self._executor.shutdown(wait=self._record is not None, cancel_futures=False)
