"""The state of the daemon, merged from the last reports of the link and planner processes."""

from collections.abc import Mapping
from typing import Any

from optodrive.daemon.responses.plan import PlanStatus
from optodrive.daemon.responses.state import (
    BoardReport,
    ControlReport,
    LimitsReport,
    LinkReport,
    PlannerReport,
    PlannerState,
    PulseTotals,
    QueueReport,
    StageReport,
    StateReport,
)
from optodrive.device.config import Config
from optodrive.device.config_sections import BoardSection
from optodrive.link.dac.formats.registry import describe_limitation
from optodrive.link.service.status import ServiceStatus
from optodrive.link.session.board_view import BoardView

NO_LINK_PROCESS = "the link process does not run; it is being restarted"
NO_STATS: Mapping[str, Any] = {
    "round_trip_ms": None,
    "silence_s": None,
    "host_bad_frames": 0,
    "retransmitted": 0,
    "naks": 0,
    "board_bad_frames": 0,
    "underruns": 0,
    "longest_stall_ms": 0.0,
    "likely_cause": None,
    "likely_cause_age_s": None,
}
NO_PLANNER = PlannerState(
    queue=QueueReport(waiting=0, running=None, paused=False, pause_ends_in_s=None, active=[], plans=[]),
    totals=PulseTotals(planned=0, sent=0, executed=0, timing_error=None),
    planner=PlannerReport(busy=False, alive=False),
    limits=LimitsReport(power_share=None),
)
SILENCE_MAX_S = 0.5
"""A board reports at least every 0.2 s."""


def merge_state(config: Config, pixels: int, status: ServiceStatus | None, planner: PlannerState | None) -> StateReport:
    """Merge the states of the processes, None for a process that does not run.

    config: names display, stages and ports; pixels: their number; status: of the link process
    """
    limitation = describe_limitation(config.board.transport)
    if status is None:
        link = LinkReport(
            port=_name_port(config.board), limitation=limitation, state="down", error=NO_LINK_PROCESS, **NO_STATS
        )
        board = BoardView().to_dict()
    else:
        link = LinkReport(
            port=status.port,
            limitation=limitation,
            state="up" if status.connected else "down",
            error=status.link_error,
            **status.stats,
        )
        is_silent = (status.stats["silence_s"] or 0.0) > SILENCE_MAX_S
        # The last state of a board without a link, or that is silent, would be a claim.
        board = (status.board if status.connected and not is_silent else status.board.forget_state()).to_dict()
    ends_in_s = status.pause.ends_in_s if status is not None and status.connected else None
    control = status.control if status is not None and status.connected else None
    planner = planner or NO_PLANNER
    stages = _list_unknown_stages(config) if status is None else status.stages
    return StateReport.from_object(
        planner,
        display=config.name,
        pixels=pixels,
        link=link,
        board=BoardReport(**board),
        stages=[StageReport.model_validate(stage) for stage in stages],
        control=None if control is None else ControlReport.model_validate(control, extra="ignore"),
        queue=_merge_queue(planner.queue, ends_in_s),
    )


def _name_port(board: BoardSection) -> str:
    return board.port or board.transport


def _list_unknown_stages(config: Config) -> list[dict[str, Any]]:
    """Return each of several stages while the link process does not run."""
    unknown = {"connected": False, "error": NO_LINK_PROCESS, "lost": None, "board": BoardView().to_dict()}
    unknown |= {"clock_error_us": None, "clock_drift_ppm": None}
    stages = config.stages if len(config.stages) > 1 else ()
    return [{"name": stage.name, "port": _name_port(stage.board), **unknown} for stage in stages]


def _merge_queue(queue: QueueReport, pause_ends_in_s: float | None) -> QueueReport:
    """Merge a pause, as the link process states it, into the planner's queue, which may not know of it yet."""
    active = queue.active
    if pause_ends_in_s is not None:
        # The link process turns the light off by itself; its word counts before the planner's.
        paused = {"status": PlanStatus.PAUSED, "ends_in_s": None}
        active = [plan.model_copy(update=paused) if plan.status == PlanStatus.RUNNING else plan for plan in active]
    update = {"paused": pause_ends_in_s is not None, "pause_ends_in_s": pause_ends_in_s, "active": active}
    return queue.model_copy(update=update)
