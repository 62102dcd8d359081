"""The responses of the routes that submit, read or cancel a plan, the status of a plan, and the list of patterns."""

from enum import StrEnum

from optodrive.core.json_model import FloatColumn, IntColumn, JsonModel
from optodrive.link.session.clock_sync import TimingError
from optodrive.planning.stimuli.pattern import PatternDescription
from optodrive.planning.summary_schema import PlanSummary, PulseColumns


class PlanStatus(StrEnum):
    """The status of a plan. That of a dry run stays `planned`.

    stopped: STOP or disarm ended it; failed: a fault, a lost link or a lost caller did
    """

    PLANNED = "planned"
    QUEUED = "queued"
    RUNNING = "running"
    PAUSED = "paused"
    DONE = "done"
    SUPERSEDED = "superseded"
    STOPPED = "stopped"
    FAILED = "failed"
    CANCELLED = "cancelled"

    @property
    def has_ended(self) -> bool:
        """Whether the status is final."""
        return self in ENDS

    def may_become(self, status: "PlanStatus") -> bool:
        """Return whether another status may follow this one."""
        return status in TRANSITIONS[self]


ENDS = (PlanStatus.DONE, PlanStatus.SUPERSEDED, PlanStatus.STOPPED, PlanStatus.FAILED, PlanStatus.CANCELLED)
TRANSITIONS: dict[PlanStatus, frozenset[PlanStatus]] = {
    PlanStatus.PLANNED: frozenset({PlanStatus.QUEUED, PlanStatus.RUNNING}),  # running at once: spliced behind another
    PlanStatus.QUEUED: frozenset({PlanStatus.RUNNING, *ENDS}),
    PlanStatus.RUNNING: frozenset({PlanStatus.PAUSED, *ENDS}),
    PlanStatus.PAUSED: frozenset({PlanStatus.RUNNING, *ENDS}),
} | dict.fromkeys(ENDS, frozenset())


class PlanLatency(JsonModel):
    """Seconds on the board's clock from the request's arrival to three events of its plan, None before the event.

    arrival: when the kernel received the head of a request, or the first byte of a WebSocket's message
    planned_s: accepted into the queue; first_byte_s: handed to the link; first_light_s: gate on as the board reports it
    """

    planned_s: float | None
    first_byte_s: float | None
    first_light_s: float | None


class PlanOnset(JsonModel):
    """Gate on of a plan's first pulse: on the board's clock, on the host's CLOCK_MONOTONIC and in Unix time, s.

    executed: whether the board has reported the pulse; before, the time is that of the plan
    board_s: on the board's clock, s
    monotonic_s: on the host's CLOCK_MONOTONIC, s
    unix_s: in Unix time, s
    """

    board_s: float
    monotonic_s: float
    unix_s: float
    executed: bool


class MaxTarget(JsonModel):
    """The pulse with the largest target: target, prediction, and simulation from the executed pulses.

    pixel: of the pulse
    target_um: its requested height, µm
    predicted_um: height before the plan is played, µm
    simulated_um: height from the executed pulses, µm, null before
    """

    pixel: int
    target_um: float
    predicted_um: float
    simulated_um: float | None


class ExecutedColumns(JsonModel):
    """Executed pulses by column, in order, as `PulseColumns`. `simulated_um` is empty until the simulation is done.

    start_s, width_s: time from the plan's zero at which the gate opened, and for how long, s
    power_w: power at the sample, W
    pixel: of each pulse
    stage: number of the pulse's stage, from 0
    simulated_um: highest displacement of the pixel until its next pulse, µm
    """

    start_s: FloatColumn
    width_s: FloatColumn
    power_w: FloatColumn
    pixel: IntColumn
    stage: IntColumn
    simulated_um: FloatColumn


class PlanReport(JsonModel):
    """A plan with its planned, sent and executed pulses.

    caller: name of the token that submitted it; labels: its own; parameters: all of the pattern, a file as its digest
    pulses, executed_pulses: None if they were not requested or are too many
    executed_complete: None before the plan has ended
    delay_s: by how much it began later than planned when it was accepted, None before it has ended
    onset: None without a pulse, for a dry run, and without a synchronised clock
    plan: id of the plan
    name: of its pattern, or push
    status: of the plan
    error: why it failed or ended early, null otherwise
    starts_in_s: time until its start, s, negative afterwards
    planned, sent, executed, dropped: number of its pulses planned, handed to the board, reported as executed, and lost
    latency: times from the request's arrival to its light
    timing_error: of its executed pulses, null before one
    summary: of the plan
    simulated_max_um: highest displacement from the executed pulses, µm, null before the simulation
    max_target: pulse with the highest request, null without one
    """

    plan: str
    name: str
    caller: str
    labels: dict[str, str | int | float | bool]
    parameters: dict[str, str | int | float | bool | None]
    status: PlanStatus
    error: str | None
    starts_in_s: float
    planned: int
    sent: int
    executed: int
    dropped: int
    latency: PlanLatency
    onset: PlanOnset | None
    timing_error: TimingError | None
    summary: PlanSummary
    pulses: PulseColumns | None
    simulated_max_um: float | None
    max_target: MaxTarget | None
    executed_pulses: ExecutedColumns | None
    executed_complete: bool | None
    delay_s: float | None

    @property
    def has_ended(self) -> bool:
        """Whether the plan's status is final."""
        return self.status.has_ended or self.status == PlanStatus.PLANNED  # a dry run

    @property
    def fits(self) -> bool | None:
        """Whether the whole sequence fits on the beam, or None if that was not requested (a stream)."""
        feasibility = self.summary.feasibility
        return None if feasibility is None else feasibility.fits


class PatternList(JsonModel):
    """The named patterns and their parameters.

    patterns: in the order in which `optodrive patterns` lists them
    """

    patterns: list[PatternDescription]
