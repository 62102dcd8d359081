"""The responses on the daemon itself: health, caller, reload, and the state, which arm, disarm and stop return too."""

from typing import Literal

from optodrive.core.json_model import JsonModel
from optodrive.daemon.responses.plan import PlanStatus
from optodrive.link.protocol.states import ARMED_STATES, BoardState
from optodrive.link.session.clock_sync import TimingError


class HealthReport(JsonModel):
    """Whether the daemon runs, and its version.

    status: ok, as the daemon answers
    version: of optodrive
    """

    status: Literal["ok"] = "ok"
    version: str


class CallerReport(JsonModel):
    """The token that the request presented.

    refused: the routes that its role may not call, method and path template → the role that they require
    name: of the token
    role: of the token
    """

    name: str
    role: str
    refused: dict[str, str]


class ReloadReport(JsonModel):
    """The effect of a reload.

    message: in one line, as in the log; applied: keys that apply from now on; waiting: changed keys that need a restart
    revoked: names of tokens that are no longer valid
    """

    message: str
    applied: list[str]
    waiting: list[str]
    revoked: list[str]


class LinkReport(JsonModel):
    """The link to the board: its error counters, and the likely cause of the last problem.

    silence_s: since the board's last message, null without a link; beyond 0.5 s the board's state is unknown
    port: serial port, USB device, laser DAC or simulated board of the link
    limitation: what a laser DAC cannot promise, in a sentence, null for a board; its inputs are then nobody's
    state: whether the link is up
    error: why the link is down, null while it is up
    round_trip_ms: time of the last exchange with the board, ms, null before one
    host_bad_frames, board_bad_frames: damaged frames that arrived here, and at the board
    retransmitted: frames sent again
    naks: frames that the board refused
    underruns: times at which the board ran out of points
    longest_stall_ms: longest time for which the link's loop did not run, ms
    likely_cause: of the last problem, in a sentence, null without one
    likely_cause_age_s: time since that was found, s
    """

    port: str
    limitation: str | None
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
    """The board's last reported status. `hint` explains the fault and its remedy.

    state: of the board, UNKNOWN without a link
    fault: code of the fault, null without one
    hint: what the fault is and how it is removed, '' without one
    inputs: safety inputs as bits, by PROTOCOL.md
    done_index: number of points executed since the job began
    queued, free_points: points in the board's queue, and room for more
    underruns: times at which the queue ran empty in a job
    crc_errors, format_errors, seq_errors: frames with a wrong checksum, a wrong form, and out of order
    laser_on_s: time for which the laser was on since the board started, s
    temperature_c: of the board, °C, null if it does not measure it
    uid: serial number of the board's chip
    firmware: version of the board's firmware
    """

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
    name: of the stage in the configuration
    port: of its board
    board: status of its board
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
    """Who armed the board: the name of a token, the time since the request, and whether a connection holds it armed.

    caller: name of the token that armed the board
    armed_for_s: time since it did, s
    hold: whether a connection holds the board armed
    """

    caller: str
    armed_for_s: float
    hold: bool


class RecentPlan(JsonModel):
    """One of the latest plans: its caller (the name of a token), and how many of its planned pulses were executed.

    age_s: since its request arrived
    plan: id of the plan
    name: of its pattern, or push
    caller: name of the token that submitted it
    status: of the plan
    planned, executed: number of its pulses planned, and reported as executed
    error: why it failed or ended early, null otherwise
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
    """A plan that runs or waits. starts_in_s is negative once it has started. ends_in_s is None while it is paused.

    plan, name, caller, status, planned, executed, error, age_s: as of a RecentPlan
    duration_s: from its start to the end of its last pulse, s
    starts_in_s: time until its start, s, negative afterwards
    ends_in_s: time until its end, s, null while it is paused
    """

    duration_s: float
    starts_in_s: float
    ends_in_s: float | None


class QueueReport(JsonModel):
    """Plans: how many wait, which one runs or is paused, both as a list in the order of the beam, and the latest 20.

    paused: whether the light is paused; pause_ends_in_s: time until that ends disarmed, None if it is not
    waiting: number of plans that wait
    running: id of the plan that runs or is paused, null without one
    active: plans that run or wait, in the order of the beam
    plans: the latest 20 plans, the newest first
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
    planned, sent, executed: number of pulses planned, handed to the board, and reported as executed
    timing_error: of all executed pulses, null before the first
    """

    planned: int
    sent: int
    executed: int
    timing_error: TimingError | None
    frames_shown: int = 0
    frames_superseded: int = 0


class PlannerReport(JsonModel):
    """Whether the planner works, and whether it is idle or makes progress.

    busy: whether it plans
    alive: whether it is idle or has made progress within two seconds
    """

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

    display: name of the configured display
    pixels: number of its pixels
    link: to the board
    board: its status
    stages: each of several stages, empty with one
    control: who armed the board, null unless it is armed
    queue: plans that run and wait
    totals: since the daemon started
    planner: whether it works
    limits: that may change while the daemon runs
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
