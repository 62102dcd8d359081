"""Records of the latest plans by id, and callers whose token was revoked, with the time of it."""

import threading
from collections.abc import Callable
from math import inf

from optodrive.core.errors import InputError, StoppedError
from optodrive.daemon.engine.active_plan import ActivePlan
from optodrive.daemon.engine.plan_record import PlanRecord

RECORDS_MAX = 200
BYTES_MAX = 10_000_000
"""Beyond this number of plans, or of bytes of ended ones, the oldest ended plans are dropped."""
RECENT_PLANS = 20


class PlanStore:
    """Records of plans by id, thread-safe. Beyond RECORDS_MAX or BYTES_MAX the oldest ended plans are dropped.

    What counts is the size of a record at its plan's end.

    end_callbacks: called with every plan that ends, by any thread; must not block
    """

    def __init__(self) -> None:
        self.end_callbacks: list[Callable[[ActivePlan], None]] = []
        self._lock = threading.Lock()
        self._records: dict[str, PlanRecord] = {}
        self._ended_bytes: dict[str, int] = {}
        self._kept_bytes = 0

    def add(self, plan: ActivePlan) -> None:
        """Keep the record of a plan."""
        plan.on_end = self._run_end_callbacks
        with self._lock:
            self._records[plan.record.plan_id] = plan.record
            self._make_room()

    def _make_room(self) -> None:
        while len(self._records) > RECORDS_MAX or self._kept_bytes > BYTES_MAX:
            oldest = next(iter(self._records))
            if oldest not in self._ended_bytes:
                break
            del self._records[oldest]
            self._kept_bytes -= self._ended_bytes.pop(oldest)

    def _run_end_callbacks(self, plan: ActivePlan) -> None:
        with self._lock:
            ended_bytes = self._ended_bytes[plan.record.plan_id] = plan.record.nbytes
            self._kept_bytes += ended_bytes
            self._make_room()
        for callback in self.end_callbacks:
            callback(plan)

    def find(self, plan_id: str) -> PlanRecord:
        """Return a plan by its id. Raise InputError (plan_not_found) for an unknown plan."""
        with self._lock:
            record = self._records.get(plan_id)
        if record is None:
            raise InputError(
                "plan", plan_id, "a plan that runs or waits, or one of the latest that ended", "plan_not_found"
            )
        return record

    def list_recent(self) -> list[PlanRecord]:
        """Return the latest plans, oldest first."""
        with self._lock:
            return list(self._records.values())[-RECENT_PLANS:]


class RevokedCallers:
    """Names of callers with the board time of the last revocation, s. A name may belong to a new token since then."""

    def __init__(self) -> None:
        self._revoked_s: dict[str, float] = {}

    def revoke(self, caller: str, board_s: float) -> str:
        """Record a revocation at a board time, s, and return the reason for people."""
        self._revoked_s[caller] = board_s
        return f"the token {caller!r} was revoked"

    def require_valid(self, caller: str, arrived_s: float) -> None:
        """Raise StoppedError for a request that arrived at a board time, s, before the revocation of its token."""
        if arrived_s <= self._revoked_s.get(caller, -inf):
            raise StoppedError(f"the token {caller!r} was revoked")
