"""The simulated board's execution records of points, and the reports made of them."""

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

from optodrive.link.protocol import messages as m

RING_RECORDS = 4096


class ExecutionRecord(NamedTuple):
    """One executed point: its number, the tick of gate on, the gate-on time in ticks, the duty."""

    number: int
    on_tick: int
    on_ticks: int
    duty: int


class ExecutionRecords:
    """The last RING_RECORDS records of a session, and those not yet reported."""

    def __init__(self) -> None:
        self._kept: deque[ExecutionRecord] = deque(maxlen=RING_RECORDS)
        self._unreported: list[ExecutionRecord] = []

    def add(self, record: ExecutionRecord) -> None:
        """Add the record of a point that ended."""
        self._kept.append(record)
        self._unreported.append(record)

    def clear(self) -> None:
        """Forget all records."""
        self._kept.clear()
        self._unreported.clear()

    def pop_reports(self) -> list[m.Executed]:
        """Return the reports of all records not yet reported."""
        reports = []
        while self._unreported:
            count = count_reportable(self._unreported)
            reports.append(_build_report(self._unreported[:count]))
            del self._unreported[:count]
        return reports

    def build_report(self, first_index: int) -> m.Executed | None:
        """Return the first report of records from first_index on, None if there are none."""
        records = [record for record in self._kept if record.number >= first_index]
        return _build_report(records[: count_reportable(records)]) if records else None


def count_reportable(records: Sequence[ExecutionRecord]) -> int:
    """Return how many leading records fit one EXECUTED: consecutive numbers, offsets of 32 bits."""
    count = 0
    for record in records[: m.RECORDS_MAX]:
        if record.number != records[0].number + count or record.on_tick - records[0].on_tick >= 1 << 32:
            break
        count += 1
    return count


def _build_report(records: Sequence[ExecutionRecord]) -> m.Executed:
    return m.Executed(records[0].number, tuple((record.on_tick, record.on_ticks, record.duty) for record in records))
