"""Audit entries of refused requests, bounded per kind, so that a flood of them fills no disk."""

import asyncio
import time
from collections.abc import Callable
from dataclasses import dataclass

from optodrive.daemon.api.audit import AuditFields, AuditLog

PERIOD_S = 60.0
ENTRIES_MAX = 60
"""At most ENTRIES_MAX refusals with the same code are recorded per period; one entry counts the others."""


@dataclass
class _Period:
    end_s: float
    entries: int = 0
    suppressed: int = 0


class RefusalAudit:
    """Recorder of refusals in an audit log, if there is one. now_s: monotonic clock."""

    def __init__(self, audit: AuditLog | None, now_s: Callable[[], float] = time.monotonic) -> None:
        self._audit = audit
        self._now_s = now_s
        self._periods: dict[str, _Period] = {}

    def record(self, code: str, fields: AuditFields) -> None:
        """Record a refusal, or count it once the period has its entries. Call it in an event loop."""
        if self._audit is None:
            return
        now_s = self._now_s()
        self._close_periods(now_s)
        period = self._periods.setdefault(code, _Period(now_s + PERIOD_S))
        if period.entries < ENTRIES_MAX:
            period.entries += 1
            self._audit.record({**fields, "event": "refused", "code": code})
            return
        if not period.suppressed:
            asyncio.get_running_loop().call_later(period.end_s - now_s, self._close_ended)
        period.suppressed += 1

    def flush(self) -> None:
        """Record the counts of all periods, before the audit log closes."""
        self._close_periods(float("inf"))

    def _close_ended(self) -> None:
        self._close_periods(self._now_s())

    def _close_periods(self, now_s: float) -> None:
        for code, period in list(self._periods.items()):
            if now_s >= period.end_s:
                del self._periods[code]
                if period.suppressed and self._audit is not None:
                    self._audit.record({"event": "refused", "code": code, "suppressed": period.suppressed})
