"""The response of GET /v1/state, and of arm, disarm and stop."""

from typing import Literal

from optodrive.core.json_model import JsonModel
from optodrive.daemon.responses.plan_status import PlanStatus
from optodrive.link.protocol.states import ARMED_STATES, BoardState
from optodrive.link.session.timing_error import TimingError


class LinkReport(JsonModel):
    """The link to the board: its error counters, and the likely cause of the last problem.

    silence_s: since the board's last message, null without a link; beyond 0.5 s the board's state is unknown
    """

    port: str
    state: Literal["up", "down"]
    error: str | None
    round_trip_ms: float | None
    silence_s: float | None
    host_bad_frames: int
    retransmitted: int
    naks: int
    board_bad_frames: int
    underruns: int
    longest_stall_ms: float
    likely_cause: str | None
    likely_cause_age_s: float | None


class BoardReport(JsonModel):
    """The board's last reported status. `hint` explains the fault and its remedy."""

    state: BoardState | Literal["UNKNOWN"]
    fault: str | None
    hint: str
    inputs: int
    done_index: int
    queued: int
    free_points: int
    underruns: int
    crc_errors: int
    format_errors: int
    seq_errors: int
    laser_on_s: float
    temperature_c: float | None
    uid: str
    firmware: int

    @property
    def is_armed(self) -> bool:
        """Whether the board accepts plans."""
        return self.state in ARMED_STATES


class StageReport(JsonModel):
    """One of several stages: its board, and the error and drift of its clock against the host's.

    clock_error_us, clock_drift_ppm: None before the clock is known
    connected: whether the link to its board is up; error: why it is not
    lost: why it counts as lost while the others go on, null while it does not
    """

    name: str
    port: str
    connected: bool
    error: str | None
    lost: str | None
    board: BoardReport
    clock_error_us: float | None
    clock_drift_ppm: float | None


class ControlReport(JsonModel):
    """Who armed the board: the name of a token, the time since the request, and whether a connection holds it armed."""

    caller: str
    armed_for_s: float
    hold: bool


class RecentPlan(JsonModel):
    """One of the latest plans: its caller (the name of a token), and how many of its planned pulses were executed.

    age_s: since its request arrived
    """

    plan: str
    name: str
    caller: str
    status: PlanStatus
    planned: int
    executed: int
    error: str | None
    age_s: float


class QueuedPlan(RecentPlan):
    """A plan that runs or waits. starts_in_s is negative once it has started. ends_in_s is None while it is paused."""

    duration_s: float
    starts_in_s: float
    ends_in_s: float | None


class QueueReport(JsonModel):
    """Plans: how many wait, which one runs or is paused, both as a list in the order of the beam, and the latest 20.

    paused: whether the light is paused; pause_ends_in_s: time until that ends disarmed, None if it is not
    """

    waiting: int
    running: str | None
    paused: bool
    pause_ends_in_s: float | None
    active: list[QueuedPlan]
    plans: list[RecentPlan]


class PulseTotals(JsonModel):
    """Pulses since the daemon started. `timing_error` is None before the first executed pulse.

    frames_shown, frames_superseded: streamed frames that were planned and have ended, with a pulse or held at their
    heights by residual heat, and without; frames that a newer one replaced before planning are not among them
    """

    planned: int
    sent: int
    executed: int
    timing_error: TimingError | None
    frames_shown: int = 0
    frames_superseded: int = 0


class PlannerReport(JsonModel):
    """Whether the planner works, and whether it is idle or makes progress."""

    busy: bool
    alive: bool


class LimitsReport(JsonModel):
    """Limits that may change while the daemon runs.

    power_share: largest power of a pulse as a share of the laser's, None while the planner process does not run
    hot_reason: why the display counted as hot when this or an earlier daemon began to use it, '' once it has cooled
    hot_for_s: time until it has cooled from that, and plans get all light again; None if it has
    """

    power_share: float | None
    hot_reason: str = ""
    hot_for_s: float | None = None


class PlannerState(JsonModel):
    """The part of the state that the planner process reports."""

    queue: QueueReport
    totals: PulseTotals
    planner: PlannerReport
    limits: LimitsReport


class StateReport(JsonModel):
    """The daemon's state: display, link, board, queue, totals, planner and limits. `control` is null unless armed.

    `board` is the sum of all boards, with the state of the one nearest to light; `stages` always has each of several,
    and is empty with one.
    """

    display: str
    pixels: int
    link: LinkReport
    board: BoardReport
    stages: list[StageReport]
    control: ControlReport | None
    queue: QueueReport
    totals: PulseTotals
    planner: PlannerReport
    limits: LimitsReport
