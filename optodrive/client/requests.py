"""The requests of the API, stated once for both displays and the command line."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar
from urllib.parse import quote

from pydantic import BaseModel

from optodrive.client.body import encode_body
from optodrive.client.heights import encode_json
from optodrive.client.plan import Plan
from optodrive.core.errors import InputError
from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.push_options import PushOptions
from optodrive.daemon.responses.patterns import PatternList
from optodrive.daemon.responses.reload import ReloadReport
from optodrive.daemon.responses.state import StateReport
from optodrive.planning.effective_config import EffectiveConfig

Response = TypeVar("Response", bound=BaseModel)


@dataclass(frozen=True)
class ApiRequest(Generic[Response]):
    """One request and the model of its response.

    idempotent: the request has no effect but its response, so that it may be sent again
    arguments: of the HTTP client's `request`
    """

    method: str
    path: str
    response: type[Response]
    idempotent: bool = False
    arguments: Mapping[str, Any] = field(default_factory=dict)


READ_STATE = ApiRequest("GET", "/v1/state", StateReport, idempotent=True)
READ_CONFIG = ApiRequest("GET", "/v1/config", EffectiveConfig, idempotent=True)
LIST_PATTERNS = ApiRequest("GET", "/v1/patterns", PatternList, idempotent=True)
ARM = ApiRequest("POST", "/v1/arm", StateReport)
DISARM = ApiRequest("POST", "/v1/disarm", StateReport)
PAUSE = ApiRequest("POST", "/v1/pause", StateReport)
RESUME = ApiRequest("POST", "/v1/resume", StateReport)
RELOAD = ApiRequest("POST", "/v1/reload", ReloadReport)
STOP = ApiRequest("POST", "/v1/stop", StateReport)


def build_dim_request(share: float) -> ApiRequest[StateReport]:
    """Build the request that caps the power of plans at a share of the laser's. Raise InputError beyond 0 to 1."""
    if not 0.0 <= share <= 1.0:  # also NaN
        raise InputError("share", share, "a number from 0 to 1")
    return ApiRequest("PUT", "/v1/dim", StateReport, True, encode_body({"share": share}))


def build_frame_body(heights_um: FloatArray, duration_s: float, simultaneous: bool) -> dict[str, Any]:
    """Build the body of one frame that starts at once, in the form of FRAMES.json."""
    frame: dict[str, Any] = {"show_at_s": 0.0, "duration_s": duration_s, "target_um": encode_json(heights_um)}
    return {"frames": [frame | ({"simultaneous": True} if simultaneous else {})]}


def build_push_request(body: Mapping[str, Any] | bytes, options: PushOptions, dry_run: bool) -> ApiRequest[Plan]:
    """Build the request that plans frames and trains, given as an object or as the bytes of a file."""
    query = {**options, "dry_run": dry_run}
    return ApiRequest("POST", "/v1/plans", Plan, dry_run, encode_body(body) | {"params": query})


def build_play_request(
    name: str, parameters: Mapping[str, Any], options: PushOptions, dry_run: bool
) -> ApiRequest[Plan]:
    """Build the request that plays a named pattern."""
    query = {**options, "dry_run": dry_run}
    path = f"/v1/patterns/{quote(name, safe='')}"
    return ApiRequest("POST", path, Plan, dry_run, encode_body(parameters) | {"params": query})


def build_read_request(plan_id: str, pulses: bool = True) -> ApiRequest[Plan]:
    """Build the request that reads a plan, with or without its pulses."""
    return ApiRequest("GET", _build_plan_path(plan_id), Plan, True, {"params": {"pulses": pulses}})


def build_cancel_request(plan_id: str) -> ApiRequest[Plan]:
    """Build the request that cancels a plan."""
    return ApiRequest("DELETE", _build_plan_path(plan_id), Plan)


def _build_plan_path(plan_id: str) -> str:
    return f"/v1/plans/{quote(plan_id, safe='')}"
