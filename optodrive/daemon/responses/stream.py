"""The messages that the daemon sends on the WebSocket /v1/stream."""

from typing import Literal

from pydantic import ConfigDict

from optodrive.core.json_model import JsonModel
from optodrive.daemon.responses.plan import PlanLatency
from optodrive.daemon.responses.plan_status import PlanStatus
from optodrive.daemon.responses.problem import Problem

FrameStatus = PlanStatus | Literal["refused"]


class FrameResult(JsonModel):
    """The outcome of one streamed frame so far. A message has only the members that apply to its status.

    frame: None if the daemon could not read the frame
    superseded_by: the newer frame, if that arrived before this one was planned
    problem: why the frame was refused; error: why its plan failed, was stopped or was cancelled
    pulses, skipped, trimmed, starts_in_s, duration_s: of its plan so far, with status "planned"; the rest of a frame is
    planned only if no newer one comes
    limited_by: caps and bounds that took light from it; with a frame that stands a further message with status
    "planned" whenever the caps of the last second are others, empty when none is left
    interval_min_s, interval_max_s: shortest and longest time since the last pulse of a pixel that is drawn again, of
    those that are in the plan so far; absent if none is
    planned, executed, dropped, simulated_max_um: of its plan, once that has ended
    status: of the frame's plan, or refused
    plan: id of its plan
    latency: times from the frame's arrival to its light
    """

    model_config = ConfigDict(json_schema_serialization_defaults_required=False)

    frame: int | None
    status: FrameStatus
    plan: str | None = None
    superseded_by: int | None = None
    problem: Problem | None = None
    error: str | None = None
    pulses: int | None = None
    skipped: int | None = None
    trimmed: int | None = None
    limited_by: list[str] | None = None
    interval_min_s: float | None = None
    interval_max_s: float | None = None
    starts_in_s: float | None = None
    duration_s: float | None = None
    planned: int | None = None
    executed: int | None = None
    dropped: int | None = None
    simulated_max_um: float | None = None
    latency: PlanLatency | None = None

    @property
    def is_final(self) -> bool:
        """Whether no further message follows for this frame."""
        return self.status != "planned"

    @property
    def is_shown(self) -> bool:
        """Whether a pulse of the frame was emitted, or residual heat held all of its pixels at their heights."""
        return bool(self.executed) or self.status == "done"

    def to_json(self) -> str:
        """Encode the members that the message has."""
        return self.model_dump_json(exclude_unset=True)


class RefreshReport(JsonModel):
    """The planner's report of a refresh of a standing frame.

    limited_by: caps that took light from it
    """

    limited_by: list[str]
