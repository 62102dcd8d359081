"""Execution of a plan on simulated boards in virtual time, through the real sessions and protocol.

The transport is memory: the boards are in the same process.
"""

from collections.abc import Callable
from dataclasses import replace

from optodrive.core.clock import ManualClock
from optodrive.core.errors import BoardFaultError
from optodrive.core.types.plans import ExecutedPulses
from optodrive.device.config import Config
from optodrive.link.board_setup import build_board_settings, build_scales
from optodrive.link.protocol.stage_points import StagePoints
from optodrive.link.protocol.states import IDLE_STATES, BoardState
from optodrive.link.session.board_group import BoardGroup
from optodrive.link.session.group_state import CONNECTING
from optodrive.link.session.session import BoardSession
from optodrive.link.simulator.board_core import BoardCore
from optodrive.link.simulator.guards import build_settings
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.planned_sequence import PlannedSequence

EXCHANGE_MIN_S = 1e-4
"""Minimum duration of an exchange, so that virtual time always advances."""


class MemoryLink:
    """Connects a host to a `BoardCore`. `read` advances the clock."""

    name = "simulated board, virtual time"

    def __init__(self, core: BoardCore, clock: ManualClock) -> None:
        self._core = core
        self._clock = clock

    def open(self) -> None:
        """Do nothing: the link is always open."""

    def fileno(self) -> int | None:
        """Return None: nothing waits for this link."""
        return None

    def describe_fault(self) -> str:
        """Return an empty text, because this link has no faults."""
        return ""

    def close(self) -> None:
        """Report the loss of the link to the board."""
        self._core.on_link_lost(self._now_us())

    def release(self) -> None:
        """Close the link."""
        self.close()

    def _now_us(self) -> int:
        return round(self._clock.now_s() * 1e6)

    def write(self, data: bytes) -> None:
        """Pass bytes to the board without delay."""
        self._core.receive(data, self._now_us())

    def read(self, timeout_s: float) -> bytes:
        """Return the bytes that the board has sent, after at most timeout_s of virtual time."""
        self._clock.sleep(EXCHANGE_MIN_S)
        self._core.advance(self._now_us())
        data = self._core.bytes_to_send()
        if not data and timeout_s > EXCHANGE_MIN_S:
            self._clock.sleep(timeout_s - EXCHANGE_MIN_S)
            self._core.advance(self._now_us())
            data = self._core.bytes_to_send()
        return data


STEP_S = 0.005
START_LEAD_S = 0.05


class VirtualBoards:
    """New simulated boards of a configuration, connected and armed, whose time passes only while they are called.

    One oscillator per board counts from the first plan to the last: the ticks of all plans are on one time line.
    """

    def __init__(self, config: Config) -> None:
        self._scales = build_scales(config)
        self._boards = _build_boards(config)
        _connect(self._boards)
        self._boards.arm()
        while self._boards.state != BoardState.ARMED:
            _step(self._boards)

    @property
    def now_s(self) -> float:
        """Time of the boards, s."""
        return self._boards.board_s()

    @property
    def tick_s(self) -> float:
        """Duration of a tick of `ExecutedPulses`, s."""
        return self._boards.tick_s

    def play(self, prepared: PlannedSequence, on_progress: Callable[[float], None] | None = None) -> ExecutedPulses:
        """Stream a plan and return the pulses that the boards report, with times from the plan's zero.

        Raise BoardFaultError if a board disarms or enters FAULT.
        """
        points = StagePoints.from_plan(prepared.plan, self._scales)
        job = self._boards.begin(points, self._boards.board_s() + START_LEAD_S)
        while sum(points.counts) and not job.is_finished:
            _step(self._boards)
            if on_progress is not None:
                on_progress(job.executed_count / len(prepared.plan))
        return job.build_executed(prepared.plan, self._scales)

    def wait(self, duration_s: float) -> None:
        """Let time pass with the boards armed and dark. Raise BoardFaultError as `play`."""
        end_s = self.now_s + duration_s
        while self.now_s < end_s:
            _step(self._boards)

    def close(self) -> None:
        """Disarm the boards and close their links."""
        self._boards.close()


def execute(
    display: DisplayModel, prepared: PlannedSequence, on_progress: Callable[[float], None] | None = None
) -> ExecutedPulses:
    """Arm new simulated boards, stream the plan, and return the pulses that they report.

    Their times count from the plan's zero, or from the first pulse of a board whose clock let it begin earlier.
    Raise BoardFaultError if a board disarms or enters FAULT.
    """
    boards = VirtualBoards(display.config)
    executed = boards.play(prepared, on_progress)
    boards.close()
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
