"""The bodies of requests, as JSON Schema: what a body must look like before its values are looked at."""

from typing import Any

from optodrive.planning.stimuli.frame_json import ID_MAX
from optodrive.planning.stimuli.json_values import PRIORITY_MAX, TIME_MAX_S
from optodrive.planning.stimuli.pattern_registry import describe_patterns
from optodrive.planning.stimuli.sequence_file import FRAMES_MAX, TRAINS_MAX

Schema = dict[str, Any]


def _table(required: dict[str, Schema], optional: dict[str, Schema]) -> Schema:
    return {
        "type": "object",
        "required": list(required),
        "properties": {**required, **optional},
        "additionalProperties": False,
    }


_HEIGHT: Schema = {"type": "number", "minimum": 0, "description": "µm"}
_LONG: Schema = {"type": "number", "exclusiveMinimum": 0, "maximum": TIME_MAX_S, "description": "s"}
_FROM: Schema = {"type": "number", "minimum": 0, "maximum": TIME_MAX_S, "description": "s"}
_ABOVE: Schema = {"type": "number", "exclusiveMinimum": 0}
_PRIORITY: Schema = {"type": "integer", "minimum": -PRIORITY_MAX, "maximum": PRIORITY_MAX}
_FRAME = _table(
    {
        "show_at_s": _FROM,
        "duration_s": _LONG,
        "target_um": {
            "oneOf": [
                {"type": "object", "additionalProperties": _HEIGHT, "propertyNames": {"pattern": "^(0|[1-9][0-9]*)$"}},
                {"type": "array", "items": _HEIGHT},
            ],
            "description": "heights by pixel, or a list of all",
        },
    },
    {
        "id": {"type": "string", "minLength": 1, "maxLength": ID_MAX},
        "together": {"type": "boolean"},
        "priority": _PRIORITY,
    },
)
_PLACE: dict[str, Schema] = {"pixel": {"type": "integer", "minimum": 0}, "start_s": _FROM, "duration_s": _LONG}
_TRAIN_BY_PULSE = _table(
    {**_PLACE, "pulse_width_s": _ABOVE, "gap_s": _FROM, "power_w": _ABOVE}, {"priority": _PRIORITY}
)
_TRAIN_BY_HEIGHT = _table(
    {**_PLACE, "period_s": _LONG, "target_um": _ABOVE},
    {"peak_to_peak_um": _ABOVE, "priority": _PRIORITY},
)
_FRAMES: Schema = {"type": "array", "items": _FRAME, "maxItems": FRAMES_MAX}
_TRAINS: Schema = {"type": "array", "items": {"oneOf": [_TRAIN_BY_PULSE, _TRAIN_BY_HEIGHT]}, "maxItems": TRAINS_MAX}
SEQUENCE: Schema = {
    **_table({}, {"frames": _FRAMES, "trains": _TRAINS}),
    "anyOf": [
        {"required": ["frames"], "properties": {"frames": {"minItems": 1}}},
        {"required": ["trains"], "properties": {"trains": {"minItems": 1}}},
    ],
}
"""FRAMES.json."""
SHOWN: Schema = {
    "frames": [{"show_at_s": 0.0, "duration_s": 0.5, "target_um": {"0": 50}}],
    "trains": [
        {"pixel": 0, "start_s": 0.6, "duration_s": 0.2, "pulse_width_s": 0.02, "gap_s": 0.06, "power_w": 1.0},
        {"pixel": 0, "start_s": 1.0, "duration_s": 0.2, "period_s": 0.04, "target_um": 100, "peak_to_peak_um": 40},
    ],
}
"""An example that every display can show."""
PATTERN_NAMES: Schema = {"examples": [item["name"] for item in describe_patterns()]}
PARAMETERS: Schema = {"type": "object", "description": "as GET /v1/patterns lists them; a file in base64"}


def json_body(description: str, schema: Schema, example: Schema, required: bool) -> Schema:
    """A body that the route reads by itself, for FastAPI's openapi_extra."""
    content = {"application/json": {"schema": schema, "example": example}}
    return {"requestBody": {"description": description, "required": required, "content": content}}
