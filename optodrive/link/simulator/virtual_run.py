"""Execution of a plan on simulated boards in virtual time, through the real sessions and protocol."""

from collections.abc import Callable
from dataclasses import replace

from optodrive.core.clock import ManualClock
from optodrive.core.errors import BoardFaultError
from optodrive.core.types.plans import ExecutedPulses
from optodrive.device.config import Config
from optodrive.link.board_setup import build_scales
from optodrive.link.protocol.stage_points import StagePoints
from optodrive.link.protocol.states import IDLE_STATES, BoardState
from optodrive.link.service.link_settings_builder import build_board_settings
from optodrive.link.session.board_connector import CONNECTING
from optodrive.link.session.board_group import BoardGroup
from optodrive.link.session.session import BoardSession
from optodrive.link.simulator.board_core import BoardCore
from optodrive.link.simulator.board_limits import build_settings
from optodrive.link.simulator.memory_link import MemoryLink
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.planned_sequence import PlannedSequence

STEP_S = 0.005
START_LEAD_S = 0.05


def execute(
    display: DisplayModel, prepared: PlannedSequence, on_progress: Callable[[float], None] | None = None
) -> ExecutedPulses:
    """Arm new simulated boards, stream the plan, and return the pulses that they report.

    Their times count from the plan's zero, or from the first pulse of a board whose clock let it begin earlier.
    Raise BoardFaultError if a board disarms or enters FAULT.
    """
    boards = _build_boards(display.config)
    _connect(boards)
    boards.arm()
    while boards.state != BoardState.ARMED:
        _step(boards)
    scales = build_scales(display.config)
    points = StagePoints.from_plan(prepared.plan, scales)
    job = boards.begin(points, boards.board_s() + START_LEAD_S)
    while sum(points.counts) and not job.is_finished:
        _step(boards)
        if on_progress is not None:
            on_progress(job.executed_count / len(prepared.plan))
    boards.close()
    executed = job.build_executed(prepared.plan, scales)
    early_s = -min(0.0, float(executed.start_s.min(initial=0.0)))
    return replace(executed, start_s=executed.start_s + early_s)


def _build_boards(config: Config) -> BoardGroup:
    clock, settings = ManualClock(1.0), build_board_settings(config)
    sessions = [
        BoardSession(
            MemoryLink(BoardCore(build_settings(one.port.own_settings), seed=1 + stage), clock),
            clock,
            one.requirements,
            len(settings) > 1,
        )
        for stage, one in enumerate(settings)
    ]
    openers: list[Callable[[], bool]] = [lambda: True] * len(sessions)
    return BoardGroup(sessions, clock, openers, [one.stage for one in settings])


def _connect(boards: BoardGroup) -> None:
    while not boards.connected:
        boards.step_connecting()
        error = boards.link_error
        if error is not None and error.code != CONNECTING:
            raise error


def _step(boards: BoardGroup) -> None:
    boards.step(STEP_S, renew_lease=True)
    board = boards.board
    if board.state in IDLE_STATES and boards.last_event_reason not in ("", "boot", "hello"):
        raise BoardFaultError(f"the simulated board went to {board.state} {board.fault} ({boards.last_event_reason})")
