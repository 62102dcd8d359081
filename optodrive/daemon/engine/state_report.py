"""The planner's part of the daemon's state, and the whole state as the planner sees it."""

from optodrive.daemon.engine.plan_queue import PlanQueue
from optodrive.daemon.engine.plan_record import PlanRecord
from optodrive.daemon.engine.planner import Planner
from optodrive.daemon.engine.queue_report import build_queue_report
from optodrive.daemon.responses.state import (
    BoardReport,
    LimitsReport,
    LinkReport,
    PlannerReport,
    PlannerState,
    PulseTotals,
    StateReport,
    build_control_report,
    build_stage_reports,
)
from optodrive.link.service.remote_session import RemoteSession
from optodrive.planning.display_model import DisplayModel


def build_planner_state(
    plan_queue: PlanQueue, recent: list[PlanRecord], planner: Planner, power_share: float, board_now_s: float
) -> PlannerState:
    """Report the state of queue and planner."""
    return PlannerState(
        queue=build_queue_report(plan_queue, recent, board_now_s),
        totals=PulseTotals(**plan_queue.accounts.totals, timing_error=plan_queue.accounts.timing.worst),
        planner=PlannerReport(busy=planner.is_busy, alive=planner.is_alive),
        limits=LimitsReport(power_share=power_share),
    )


def build_state_report(display: DisplayModel, session: RemoteSession, planner_state: PlannerState) -> StateReport:
    """Report the state of display, link, board, queue and planner. A status of the link process must have arrived."""
    return StateReport(
        display=display.config.name,
        pixels=len(display.layout),
        link=LinkReport(
            port=session.port,
            state="up" if session.connected else "down",
            error=session.link_error,
            **session.stats,
        ),
        board=_build_board_report(session),
        stages=build_stage_reports(session.stages),
        control=build_control_report(session.control),
        queue=planner_state.queue,
        totals=planner_state.totals,
        planner=planner_state.planner,
        limits=planner_state.limits,
    )


def _build_board_report(session: RemoteSession) -> BoardReport:
    """Report the board. Without a link its state is unknown, and the last one would be a claim."""
    return BoardReport(**(session.board if session.connected else session.board.forget_state()).to_dict())
