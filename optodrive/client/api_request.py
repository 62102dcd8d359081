"""A request to the API, and those that control the display, without the models of their responses.

A command that arms must not import models first: they take ten times as long as an interpreter's start. The commands
read the responses as JSON; `requests.py` gives the same requests their models.
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

from optodrive.core.errors import InputError

Response = TypeVar("Response")
Parsed = TypeVar("Parsed")


@dataclass(frozen=True)
class ApiRequest(Generic[Response]):
    """One request and the parser of its response.

    idempotent: the request has no effect but its response, so that it may be sent again
    arguments: of the HTTP client's `request`
    """

    method: str
    path: str
    parse: Callable[[bytes], Response]
    idempotent: bool = False
    arguments: Mapping[str, Any] = field(default_factory=dict)

    def parsed_by(self, parse: Callable[[bytes], Parsed]) -> "ApiRequest[Parsed]":
        """Return the same request with another parser."""
        return ApiRequest(self.method, self.path, parse, self.idempotent, self.arguments)


def _parse_object(content: bytes) -> dict[str, Any]:
    parsed: dict[str, Any] = json.loads(content)
    if not isinstance(parsed, dict):
        raise ValueError("no object")
    return parsed


READ_STATE = ApiRequest("GET", "/v1/state", _parse_object, idempotent=True)
READ_CONFIG = ApiRequest("GET", "/v1/config", _parse_object, idempotent=True)
ARM = ApiRequest("POST", "/v1/arm", _parse_object)
DISARM = ApiRequest("POST", "/v1/disarm", _parse_object)
PAUSE = ApiRequest("POST", "/v1/pause", _parse_object)
RESUME = ApiRequest("POST", "/v1/resume", _parse_object)
RELOAD = ApiRequest("POST", "/v1/reload", _parse_object)
STOP = ApiRequest("POST", "/v1/stop", _parse_object)


def build_dim_request(share: float) -> ApiRequest[dict[str, Any]]:
    """Build the request that caps the power of plans at a share of the laser's. Raise InputError beyond 0 to 1."""
    if not 0.0 <= share <= 1.0:  # also NaN
        raise InputError("share", share, "a number from 0 to 1")
    return ApiRequest("PUT", "/v1/dim", _parse_object, True, encode_json_body(json.dumps({"share": share}).encode()))


def encode_json_body(content: bytes) -> dict[str, Any]:
    """Return a JSON body as arguments of the HTTP client's `request`."""
    return {"content": content, "headers": {"Content-Type": "application/json"}}
