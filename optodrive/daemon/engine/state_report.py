"""Report of the daemon's state, the response of GET /v1/state."""

from optodrive.daemon.engine.plan_queue import PlanQueue
from optodrive.daemon.engine.plan_record import PlanRecord
from optodrive.daemon.engine.planner import Planner
from optodrive.daemon.responses.state import (
    BoardReport,
    LinkReport,
    PlannerReport,
    PulseTotals,
    QueueReport,
    RecentPlan,
    StateReport,
)
from optodrive.link.session.session import BoardSession
from optodrive.planning.display_model import DisplayModel


def build_state_report(
    display: DisplayModel,
    session: BoardSession,
    plan_queue: PlanQueue,
    recent: list[PlanRecord],
    planner: Planner,
    link_error: str | None,
) -> StateReport:
    """Report the state of display, link, board, queue and planner."""
    running = next(iter(plan_queue.running.copy()), None)
    return StateReport(
        display=display.config.name,
        pixels=len(display.layout),
        link=LinkReport(
            port=session.port,
            state="up" if session.connected else "down",
            error=link_error,
            **session.collect_link_stats(),
        ),
        board=_build_board_report(session),
        queue=QueueReport(
            waiting=len(plan_queue.waiting),
            running=None if running is None else running.record.plan_id,
            plans=[RecentPlan(plan=item.plan_id, name=item.name, status=item.status) for item in recent],
        ),
        totals=PulseTotals(**plan_queue.totals, timing_error=plan_queue.timing.worst),
        planner=PlannerReport(busy=planner.is_busy, alive=planner.is_alive),
    )


def _build_board_report(session: BoardSession) -> BoardReport:
    """Report the board; without a link its state is unknown, and the last one would be a claim."""
    report = BoardReport(**session.board.to_dict())
    if session.connected:
        return report
    return report.model_copy(update={"state": "UNKNOWN", "fault": None, "hint": ""})
