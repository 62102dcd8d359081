"""The response of GET /v1/health."""

from typing import Literal

from optodrive.core.json_model import JsonModel


class HealthReport(JsonModel):
    """Whether the daemon runs, and its version.

    status: ok, as the daemon answers
    version: of optodrive
    """

    status: Literal["ok"] = "ok"
    version: str
