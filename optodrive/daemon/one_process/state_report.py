"""Report of the daemon's state, the response of GET /v1/state."""

from optodrive.daemon.one_process.plan_queue import PlanQueue
from optodrive.daemon.one_process.plan_record import PlanRecord
from optodrive.daemon.one_process.planner import Planner
from optodrive.daemon.one_process.queue_report import build_queue_report
from optodrive.daemon.responses.state import (
    BoardReport,
    LinkReport,
    PlannerReport,
    PulseTotals,
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
        queue=build_queue_report(plan_queue, recent, session.board_s()),
        totals=PulseTotals(**plan_queue.totals, timing_error=plan_queue.timing.worst),
        planner=PlannerReport(busy=planner.is_busy, alive=planner.is_alive),
    )


def _build_board_report(session: BoardSession) -> BoardReport:
    """Report the board; without a link its state is unknown, and the last one would be a claim."""
    report = BoardReport(**session.board.to_dict())
    if session.connected:
        return report
    return report.model_copy(update={"state": "UNKNOWN", "fault": None, "hint": ""})
