"""The messages of the WebSockets /v1/stream, /v1/fingers and /v1/hold."""

from typing import Annotated, Literal

from pydantic import ConfigDict, Field, ValidationError

from optodrive.core.json_model import JsonModel
from optodrive.core.toml_model import build_input_error
from optodrive.core.types.fingers import FingerPlace
from optodrive.daemon.responses.plan import PlanLatency, PlanStatus
from optodrive.daemon.responses.problem import Problem


class HoldReport(JsonModel):
    """Status of an arming that a client holds. A message has only the members that apply to its status.

    problem: why the board was not armed; reason: what has ended the arming, as the end of a sentence
    status: of the arming
    """

    model_config = ConfigDict(json_schema_serialization_defaults_required=False)

    status: Literal["armed", "refused", "ended"]
    problem: Problem | None = None
    reason: str | None = None

    def to_json(self) -> str:
        """Encode the members that the message has."""
        return self.model_dump_json(exclude_unset=True)


FINGERS_MAX = 20
NUMBER_MAX = 2**31
PLACE_MAX_M, RADIUS_MAX_M = 1.0, 0.05
AGE_MAX_S = 1.0

Place = Annotated[float, Field(ge=-PLACE_MAX_M, le=PLACE_MAX_M, allow_inf_nan=False, strict=True)]


class FingerMessage(JsonModel):
    """A fingertip on the display.

    number: the same for one fingertip as long as it is tracked; x_m, y_m: centre of its contact, in the coordinates of
    the display's pixels; radius_m: of the contact
    """

    number: Annotated[int, Field(ge=0, le=NUMBER_MAX, strict=True)]
    x_m: Place
    y_m: Place
    radius_m: Annotated[float, Field(gt=0, le=RADIUS_MAX_M, allow_inf_nan=False, strict=True)]


class FingersMessage(JsonModel):
    """All fingertips that a tracker sees at a time.

    age_s: time since the tracker saw them
    fingers: all fingertips on the display, at most 20
    """

    fingers: Annotated[tuple[FingerMessage, ...], Field(max_length=FINGERS_MAX)]
    age_s: Annotated[float, Field(ge=0, le=AGE_MAX_S, allow_inf_nan=False, strict=True)] = 0.0

    @property
    def places(self) -> tuple[FingerPlace, ...]:
        """The fingertips."""
        return tuple(FingerPlace(*dict(finger).values()) for finger in self.fingers)


def validate_fingers(message: object) -> FingersMessage:
    """Return a decoded message as its model. Raise InputError that names the first member that it may not have."""
    try:
        return FingersMessage.model_validate(message)
    except ValidationError as error:
        raise build_input_error(error, "message", FingersMessage) from None


class FingersRefusal(JsonModel):
    """Why a message was not taken. The fingertips before it remain.

    problem: what the message may not have
    """

    model_config = ConfigDict(json_schema_serialization_defaults_required=False)

    problem: Problem


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
