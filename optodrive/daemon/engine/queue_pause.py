"""Pause of the queue: keeps plans from starting until they are limited and proven again."""

import threading
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

from optodrive.core.errors import NotReadyError
from optodrive.daemon.engine.active_plan import ActivePlan
from optodrive.daemon.engine.plan_restart import RestartedPlan, restart_plans
from optodrive.daemon.engine.pulse_accounts import PulseAccounts
from optodrive.daemon.engine.queue_thermal import QueueThermal
from optodrive.daemon.engine.thermal_estimate import estimate_before_rest
from optodrive.link.service.remote_session import RemoteSession
from optodrive.planning.display_model import DisplayModel

START_LEAD_S = 0.05
"""Minimum time from now, and from the end of the queue, to a plan's zero. Its first points must arrive in time."""


class Restart(NamedTuple):
    """Plans in their order as they go on after a pause, and the board time of its begin, which tells pauses apart."""

    plans: tuple[ActivePlan, ...]
    restarted: list[RestartedPlan]
    off_s: float | None


class QueuePause:
    """Pause of a queue. The queue's lock guards it, and only the loop's thread changes it.

    off_s: board time at which the light went off, None once the queue goes on
    """

    def __init__(
        self,
        lock: threading.RLock,
        waiting: deque[ActivePlan],
        thermal: QueueThermal,
        session: RemoteSession,
        accounts: PulseAccounts,
    ) -> None:
        self.off_s: float | None = None
        self._accounts = accounts
        self._lock = lock
        self._waiting = waiting
        self._thermal = thermal
        self._session = session

    @property
    def is_held(self) -> bool:
        """Whether the light is paused. Any thread may read it."""
        return self._session.is_held

    @property
    def ends_in_s(self) -> float | None:
        """Time until the pause ends disarmed, s, or None if the light is not paused."""
        return self._session.pause_ends_in_s

    def require_no_pause(self) -> None:
        """Raise NotReadyError while the light is paused. An interruption by a lost stage is over in a moment."""
        self._session.connection.receive()
        if self.is_held and not self._session.is_interrupted:
            raise NotReadyError("the light is paused, and a streamed frame shows the present; resume first")

    def begin(self, off_s: float) -> None:
        """Let nothing start until the waiting plans are limited and proven again."""
        self.off_s = off_s

    def end_if_idle(self) -> None:
        """Let the queue go on after a pause if nothing waits."""
        if self.off_s is not None and not self._waiting and not self.is_held:
            self.off_s = None

    @property
    def can_restart(self) -> bool:
        """Whether waiting plans are to be limited and proven again now. Any thread may read it."""
        return self.off_s is not None and bool(self._waiting) and not self.is_held

    def build_restart(
        self, display: DisplayModel, planning_time_s: float, on_progress: Callable[[], None]
    ) -> Restart | None:
        """Limit and prove the waiting plans again. Return None if none is to be restarted.

        planning_time_s: time that is reserved for this. Raise LocalProtocolError if one exceeds a cap.
        """
        with self._lock:
            plans, off_s = tuple(self._waiting), self.off_s
            if not self.can_restart:
                return None
        start_s = self._session.board_s() + START_LEAD_S + planning_time_s
        before = estimate_before_rest(plans[0], display.budget, on_progress)
        scales = self._session.scales
        restarted = restart_plans(display, scales, plans, before, start_s, START_LEAD_S, on_progress)
        return Restart(plans, restarted, off_s)

    def commit_restart(self, restart: Restart) -> bool:
        """Let the queue go on. Return False if the queue has changed meanwhile, or the light is paused again."""
        self._session.connection.receive()  # a STOP or a pause that has been answered is known from here on
        with self._lock:
            if not self.can_restart or tuple(self._waiting) != restart.plans or self.off_s != restart.off_s:
                return False
            delay_s = max(0.0, self._session.board_s() + START_LEAD_S - restart.restarted[0].start_s)
            for plan in restart.restarted:
                self._accounts.totals["planned"] += plan.added_count
                plan.apply(delay_s)
            last = restart.restarted[-1]
            self._thermal.set(last.after.with_delay(delay_s), last.end_s + delay_s)
            self.off_s = None
            return True
