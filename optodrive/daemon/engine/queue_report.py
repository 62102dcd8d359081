"""Report of the plan queue, a part of the daemon's state."""

from typing import Any

from optodrive.daemon.engine.plan_queue import PlanQueue
from optodrive.daemon.engine.plan_record import PlanRecord
from optodrive.daemon.responses.plan import PlanStatus
from optodrive.daemon.responses.state import QueuedPlan, QueueReport, RecentPlan


def build_queue_report(
    plan_queue: PlanQueue, recent: list[PlanRecord], board_now_s: float, host_now_s: float
) -> QueueReport:
    """Report the running and waiting plans with their progress at a board and host time, s, and the recent ones."""
    running = [run.plan.record for run in plan_queue.running.copy()]
    waiting = [plan.record for plan in plan_queue.waiting.copy()]
    if waiting and waiting[0].status == PlanStatus.PAUSED:
        running.append(waiting.pop(0))
    pause = plan_queue.pause
    times_at_s = board_now_s if pause.off_s is None else pause.off_s  # as if the queue went on now
    return QueueReport(
        waiting=len(waiting),
        running=running[0].plan_id if running else None,
        paused=pause.ends_in_s is not None,
        pause_ends_in_s=pause.ends_in_s,
        active=[_build_queued(record, times_at_s, host_now_s) for record in (*running, *waiting)],
        plans=[RecentPlan.from_object(record, **_name_counts(record, host_now_s)) for record in recent],
    )


def _name_counts(record: PlanRecord, host_now_s: float) -> dict[str, Any]:
    age_s = max(0.0, host_now_s - record.arrived_host_s)
    return {"plan": record.plan_id, "age_s": age_s, "planned": record.pulse_count, "executed": record.executed_count}


def _build_queued(record: PlanRecord, board_now_s: float, host_now_s: float) -> QueuedPlan:
    starts_in_s = record.start_s + record.delay_s - board_now_s
    ends_in_s = None if record.status == PlanStatus.PAUSED else max(0.0, starts_in_s + record.duration_s)
    counts = _name_counts(record, host_now_s)
    return QueuedPlan.from_object(record, **counts, starts_in_s=starts_in_s, ends_in_s=ends_in_s)
