"""The messages of the WebSocket /v1/fingers: places of fingertips from a tracker, and why one was refused."""

from typing import Annotated

from pydantic import ConfigDict, Field, ValidationError

from optodrive.core.json_model import JsonModel
from optodrive.core.toml_model import build_input_error
from optodrive.core.types.fingers import FingerPlace
from optodrive.daemon.responses.problem import Problem

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
