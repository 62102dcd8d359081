"""The messages that the daemon sends on the WebSocket /v1/hold."""

from typing import Literal

from pydantic import ConfigDict

from optodrive.core.json_model import JsonModel
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
