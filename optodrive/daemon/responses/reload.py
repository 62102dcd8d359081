"""The response of POST /v1/reload."""

from optodrive.core.json_model import JsonModel


class ReloadReport(JsonModel):
    """The effect of a reload.

    message: in one line, as in the log; applied: keys that apply from now on; waiting: changed keys that need a restart
    revoked: names of tokens that are no longer valid
    """

    message: str
    applied: list[str]
    waiting: list[str]
    revoked: list[str]
