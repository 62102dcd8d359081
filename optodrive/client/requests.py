"""Requests, the same for `Display` and `AsyncDisplay`: method, path, whether it may be sent again, and the rest."""

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple
from urllib.parse import quote

from optodrive.client.heights import encode_json
from optodrive.core.types.arrays import FloatArray

Policy = Literal["trim", "delay", "refuse"]
Fit = Literal["as_is", "even", "priority"]


class ApiRequest(NamedTuple):
    """A request. safe: nothing comes of it but the answer, so that it may be sent again."""

    method: str
    path: str
    idempotent: bool
    arguments: dict[str, Any]


def build_frame_body(heights_um: FloatArray, duration_s: float, simultaneous: bool) -> dict[str, Any]:
    """One frame, shown at once, as FRAMES.json has it."""
    frame: dict[str, Any] = {"show_at_s": 0.0, "duration_s": duration_s, "target_um": encode_json(heights_um)}
    return {"frames": [frame | ({"simultaneous": True} if simultaneous else {})]}


def build_push_request(
    body: Mapping[str, Any], policy: Policy, fit: Fit, dry_run: bool, newest: bool = False
) -> ApiRequest:
    """Frames and trains."""
    query = {"policy": policy, "fit": fit, "dry_run": dry_run, "newest": newest}
    return ApiRequest("POST", "/v1/plans", dry_run, {"json": body, "params": query})


def build_play_request(name: str, parameters: Mapping[str, Any], policy: Policy, fit: Fit, dry_run: bool) -> ApiRequest:
    """A named pattern."""
    query = {"policy": policy, "fit": fit, "dry_run": dry_run}
    path = f"/v1/patterns/{quote(name, safe='')}"
    return ApiRequest("POST", path, dry_run, {"json": dict(parameters), "params": query})


def build_plan_path(plan_id: str) -> str:
    """Where a plan is found."""
    return f"/v1/plans/{quote(plan_id, safe='')}"
