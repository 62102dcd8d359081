"""Execution of a plan on the simulated board in virtual time, through the real session and protocol."""

from collections.abc import Callable

from optodrive.core.clock import ManualClock
from optodrive.core.errors import BoardFaultError
from optodrive.core.types.plans import ExecutedPulses
from optodrive.link.board_setup import build_board_requirements
from optodrive.link.protocol.quantisation import quantise
from optodrive.link.protocol.states import IDLE_STATES, BoardState
from optodrive.link.session.session import BoardSession
from optodrive.link.simulator.board_core import BoardCore
from optodrive.link.simulator.memory_link import MemoryLink
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.planned_sequence import PlannedSequence

STEP_S = 0.005
START_LEAD_S = 0.05


def execute(
    display: DisplayModel, prepared: PlannedSequence, on_progress: Callable[[float], None] | None = None
) -> ExecutedPulses:
    """Arm a new simulated board, stream the plan, and return the pulses that the board reports.

    Raise BoardFaultError if the board disarms or enters FAULT.
    """
    clock = ManualClock(1.0)
    core = BoardCore(seed=1)
    session = BoardSession(MemoryLink(core, clock), clock, build_board_requirements(display.config))
    session.connect()
    session.arm()
    while session.board.state != BoardState.ARMED:
        _step(session)
    scale = session.scale
    points = quantise(prepared.plan, scale)
    job = session.begin(points, session.board_s() + START_LEAD_S)
    while len(points) and not job.is_finished:
        _step(session)
        if on_progress is not None:
            on_progress(job.executed_count / len(prepared.plan))
    session.close()
    return job.build_executed(prepared.plan, scale.full_power_w, scale.tick_s)


def _step(session: BoardSession) -> None:
    session.step(STEP_S, renew_lease=True)
    board = session.board
    if board.state in IDLE_STATES and session.last_event_reason not in ("", "boot", "hello"):
        raise BoardFaultError(f"the simulated board went to {board.state} {board.fault} ({session.last_event_reason})")
