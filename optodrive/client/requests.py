"""The requests of the API with the models of their responses, for both displays and the commands that plan.

JSON bodies are made from Python values and those of NumPy.
"""

import json
from collections.abc import Callable, Mapping
from math import isfinite
from typing import Any, TypeVar
from urllib.parse import quote

import numpy as np
from pydantic import BaseModel

from optodrive.client import api_request
from optodrive.client.api_request import ApiRequest, encode_json_body
from optodrive.client.plan import Plan
from optodrive.core.errors import InputError
from optodrive.core.types.push_options import PushOptions
from optodrive.daemon.responses.plan import PatternList
from optodrive.daemon.responses.state import StateReport
from optodrive.planning.effective_config import EffectiveConfig

EXPECTED_VALUE = "text, a finite number, true or false, a list or an object"


def encode_body(body: Mapping[str, Any] | bytes) -> dict[str, Any]:
    """Return a JSON body as arguments of the HTTP client's `request`. Bytes are sent as they are.

    Raises InputError with the place of a value that JSON does not have, such as NaN.
    """
    if not isinstance(body, bytes):
        try:
            body = json.dumps(body, allow_nan=False, default=_convert).encode()
        except (TypeError, ValueError, RecursionError):
            raise _build_error(body) from None
    return encode_json_body(body)


def _convert(value: object) -> object:
    """Return a value of NumPy, or a mapping, as JSON has it. Raise TypeError for any other."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    if isinstance(value, Mapping):
        return dict(value)
    raise TypeError


def _build_error(body: object) -> InputError:
    try:
        return _find_error(body, "body") or InputError("body", type(body).__name__, EXPECTED_VALUE)
    except RecursionError:
        return InputError("body", "deeper nesting", "objects and lists at most 4 deep")


def _find_error(value: object, where: str) -> InputError | None:
    """Return the error of the first value that JSON does not have, None if there is none."""
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if isinstance(value, Mapping):
        for key in value:
            if not (key is None or isinstance(key, str | int | float)):
                return InputError(where, key, "keys of text")
        items = [(item, f"{where}{': ' if where == 'body' else '.'}{key}") for key, item in value.items()]
    elif isinstance(value, list | tuple):
        items = [(item, f"{where}[{index}]") for index, item in enumerate(value)]
    elif value is None or isinstance(value, str | int) or (isinstance(value, float) and isfinite(value)):
        return None
    else:
        return InputError(where, value, EXPECTED_VALUE)
    errors = (_find_error(item, place) for item, place in items)
    return next((error for error in errors if error is not None), None)


Model = TypeVar("Model", bound=BaseModel)


def parse_as(model: type[Model]) -> Callable[[bytes], Model]:
    """Return the parser of a response that ignores members which the model does not have, as of a newer daemon."""
    return lambda content: model.model_validate_json(content, extra="ignore")


_parse_state = parse_as(StateReport)
READ_STATE = api_request.READ_STATE.parsed_by(_parse_state)
ARM = api_request.ARM.parsed_by(_parse_state)
DISARM = api_request.DISARM.parsed_by(_parse_state)
PAUSE = api_request.PAUSE.parsed_by(_parse_state)
RESUME = api_request.RESUME.parsed_by(_parse_state)
STOP = api_request.STOP.parsed_by(_parse_state)
READ_CONFIG = api_request.READ_CONFIG.parsed_by(parse_as(EffectiveConfig))
LIST_PATTERNS = ApiRequest("GET", "/v1/patterns", parse_as(PatternList), idempotent=True)
_parse_plan = parse_as(Plan)


def build_dim_request(share: float) -> ApiRequest[StateReport]:
    """Build the request that caps the power of plans at a share of the laser's. Raise InputError beyond 0 to 1."""
    return api_request.build_dim_request(share).parsed_by(_parse_state)


def build_frame_body(target: Mapping[str, Any], duration_s: float, simultaneous: bool) -> dict[str, Any]:
    """Build the body of one frame that starts at once, in the form of FRAMES.json.

    target: target_um or intensity, by pixel
    """
    frame: dict[str, Any] = {"show_at_s": 0.0, "duration_s": duration_s, **target}
    return {"frames": [frame | ({"simultaneous": True} if simultaneous else {})]}


def build_push_request(body: Mapping[str, Any] | bytes, options: PushOptions, dry_run: bool) -> ApiRequest[Plan]:
    """Build the request that plans frames and trains, given as an object or as the bytes of a file."""
    query = {**options, "dry_run": dry_run}
    return ApiRequest("POST", "/v1/plans", _parse_plan, dry_run, encode_body(body) | {"params": query})


def build_play_request(
    name: str, parameters: Mapping[str, Any], options: PushOptions, dry_run: bool
) -> ApiRequest[Plan]:
    """Build the request that plays a named pattern."""
    query = {**options, "dry_run": dry_run}
    path = f"/v1/patterns/{quote(name, safe='')}"
    return ApiRequest("POST", path, _parse_plan, dry_run, encode_body(parameters) | {"params": query})


def build_read_request(plan_id: str, pulses: bool = True) -> ApiRequest[Plan]:
    """Build the request that reads a plan, with or without its pulses."""
    return ApiRequest("GET", _build_plan_path(plan_id), _parse_plan, True, {"params": {"pulses": pulses}})


def build_cancel_request(plan_id: str) -> ApiRequest[Plan]:
    """Build the request that cancels a plan."""
    return ApiRequest("DELETE", _build_plan_path(plan_id), _parse_plan)


def _build_plan_path(plan_id: str) -> str:
    return f"/v1/plans/{quote(plan_id, safe='')}"
