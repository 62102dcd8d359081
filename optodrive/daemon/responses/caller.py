"""The response of GET /v1/me."""

from optodrive.core.json_model import JsonModel


class CallerReport(JsonModel):
    """The token that the request presented.

    refused: the routes that its role may not call, method and path template → the role that they require
    name: of the token
    role: of the token
    """

    name: str
    role: str
    refused: dict[str, str]
