"""JSON Schemas of request bodies: the structure that a body needs before its values are checked."""

from typing import Any

from optodrive.daemon.api.dim_request import DIM_SCHEMA
from optodrive.planning.stimuli.binary_frame import FRAME_NUMBER_MAX
from optodrive.planning.stimuli.frame_json import ID_MAX, TARGET_KEYS
from optodrive.planning.stimuli.json_values import PRIORITY_MAX, TIME_MAX_S
from optodrive.planning.stimuli.labels import KEY_MAX, LABELS_MAX, NUMBER_MAX, TEXT_MAX
from optodrive.planning.stimuli.pattern_registry import PATTERNS
from optodrive.planning.stimuli.sequence_file import FRAMES_MAX, TRAINS_MAX

Schema = dict[str, Any]


def _object_schema(required: dict[str, Schema], optional: dict[str, Schema]) -> Schema:
    return {
        "type": "object",
        "required": list(required),
        "properties": {**required, **optional},
        "additionalProperties": False,
    }


_HEIGHT_SCHEMA: Schema = {"type": "number", "minimum": 0, "description": "µm"}
_DURATION_SCHEMA: Schema = {"type": "number", "exclusiveMinimum": 0, "maximum": TIME_MAX_S, "description": "s"}
_START_SCHEMA: Schema = {"type": "number", "minimum": 0, "maximum": TIME_MAX_S, "description": "s"}
_POSITIVE_SCHEMA: Schema = {"type": "number", "exclusiveMinimum": 0}
_PRIORITY_SCHEMA: Schema = {
    "type": "integer",
    "minimum": -PRIORITY_MAX,
    "maximum": PRIORITY_MAX,
    "description": "what fit=priority omits last is the highest; by default 0",
}
_TARGETS_SCHEMA: Schema = {
    "oneOf": [
        {
            "type": "object",
            "additionalProperties": _HEIGHT_SCHEMA,
            "propertyNames": {"pattern": "^(0|[1-9][0-9]*)$"},
        },
        {"type": "array", "items": _HEIGHT_SCHEMA},
    ],
    "description": "heights by pixel, or one height per pixel",
}
_INTENSITY_SCHEMA: Schema = {"type": "number", "minimum": 0, "description": "in thresholds"}
_INTENSITIES_SCHEMA: Schema = {
    "oneOf": [
        {
            "type": "object",
            "additionalProperties": _INTENSITY_SCHEMA,
            "propertyNames": {"pattern": "^(0|[1-9][0-9]*)$"},
        },
        {"type": "array", "items": _INTENSITY_SCHEMA},
    ],
    "description": "perceived intensities by pixel, or one per pixel, in place of target_um",
}


def _described(schema: Schema, text: str) -> Schema:
    return {**schema, "description": text}


_ONE_TARGET: list[Schema] = [{"required": [key]} for key in TARGET_KEYS]
LIVE_FRAME_SCHEMA = _object_schema(
    {"target_um": _TARGETS_SCHEMA},
    {
        "frame": {
            "type": "integer",
            "minimum": 0,
            "maximum": FRAME_NUMBER_MAX,
            "description": "its number in the results; by default one more than that of the frame before",
        }
    },
)
"""The schema of a streamed frame as text."""
_FRAME_SCHEMA = _object_schema(
    {
        "show_at_s": _described(_START_SCHEMA, "time at which the frame begins, from the zero of the sequence, s"),
        "duration_s": _described(_DURATION_SCHEMA, "time within which all its pixels are raised, s"),
    },
    {
        "target_um": _TARGETS_SCHEMA,
        "intensity": _INTENSITIES_SCHEMA,
        "id": {"type": "string", "minLength": 1, "maxLength": ID_MAX, "description": "name of the frame in reports"},
        "simultaneous": {"type": "boolean", "description": "raise all pixels within one relaxation time"},
        "priority": _PRIORITY_SCHEMA,
    },
) | {"oneOf": _ONE_TARGET}
_TRAIN_SCHEMAS: dict[str, Schema] = {
    "pixel": {"type": "integer", "minimum": 0, "description": "index of the pixel"},
    "start_s": _described(_START_SCHEMA, "time of the first pulse from the zero of the sequence, s"),
    "duration_s": _described(_DURATION_SCHEMA, "length of the train, s"),
}
_PERIOD_SCHEMA = _described(_DURATION_SCHEMA, "time from one pulse to the next, s")
_PULSE_TRAIN_SCHEMA = _object_schema(
    {
        **_TRAIN_SCHEMAS,
        "pulse_width_s": _described(_POSITIVE_SCHEMA, "time of the gate on, s"),
        "gap_s": _described(_START_SCHEMA, "time of the gate off between two pulses, s"),
        "power_w": _described(_POSITIVE_SCHEMA, "power at the sample, W"),
    },
    {"priority": _PRIORITY_SCHEMA},
)
_HEIGHT_TRAIN_SCHEMA = _object_schema(
    {
        **_TRAIN_SCHEMAS,
        "period_s": _PERIOD_SCHEMA,
        "target_um": _described(_POSITIVE_SCHEMA, "height of each peak, µm"),
    },
    {
        "peak_to_peak_um": _described(_POSITIVE_SCHEMA, "fall of the membrane between two peaks, µm"),
        "priority": _PRIORITY_SCHEMA,
    },
)
_INTENSITY_TRAIN_SCHEMA = _object_schema(
    {**_TRAIN_SCHEMAS, "period_s": _PERIOD_SCHEMA, "intensity": {**_POSITIVE_SCHEMA, "description": "in thresholds"}},
    {"priority": _PRIORITY_SCHEMA},
)
_FRAMES_SCHEMA: Schema = {
    "type": "array",
    "items": {"title": "Frame", **_FRAME_SCHEMA},
    "maxItems": FRAMES_MAX,
    "description": "frames in order of time",
}
_TRAINS_SCHEMA: Schema = {
    "type": "array",
    "items": {
        "oneOf": [
            {"title": "PulseTrain", **_PULSE_TRAIN_SCHEMA},
            {"title": "HeightTrain", **_HEIGHT_TRAIN_SCHEMA},
            {"title": "IntensityTrain", **_INTENSITY_TRAIN_SCHEMA},
        ]
    },
    "maxItems": TRAINS_MAX,
    "description": "trains of pulses, of different pixels or times",
}
_LABELS_SCHEMA: Schema = {
    "type": "object",
    "maxProperties": LABELS_MAX,
    "propertyNames": {"minLength": 1, "maxLength": KEY_MAX},
    "additionalProperties": {
        "oneOf": [
            {"type": "string", "maxLength": TEXT_MAX},
            {"type": "number", "minimum": -NUMBER_MAX, "maximum": NUMBER_MAX},
            {"type": "boolean"},
        ]
    },
    "description": "recorded with the plan and never interpreted",
}
SEQUENCE_SCHEMA: Schema = {
    **_object_schema({}, {"frames": _FRAMES_SCHEMA, "trains": _TRAINS_SCHEMA, "labels": _LABELS_SCHEMA}),
    "anyOf": [
        {"required": ["frames"], "properties": {"frames": {"minItems": 1}}},
        {"required": ["trains"], "properties": {"trains": {"minItems": 1}}},
    ],
}
"""The schema of FRAMES.json."""
SEQUENCE_EXAMPLE: Schema = {
    "frames": [
        {"show_at_s": 0.0, "duration_s": 0.5, "target_um": {"0": 50}},
        {"show_at_s": 1.5, "duration_s": 0.5, "intensity": {"0": 3}},
    ],
    "trains": [
        {"pixel": 0, "start_s": 0.6, "duration_s": 0.2, "pulse_width_s": 0.02, "gap_s": 0.06, "power_w": 1.0},
        {"pixel": 0, "start_s": 1.0, "duration_s": 0.2, "period_s": 0.04, "target_um": 100, "peak_to_peak_um": 40},
        {"pixel": 0, "start_s": 2.2, "duration_s": 0.2, "period_s": 0.04, "intensity": 3},
    ],
}
"""An example that every shipped display can show."""
PATTERN_NAME_EXAMPLES: Schema = {"examples": list(PATTERNS)}
PARAMETERS_SCHEMA: Schema = {
    "type": "object",
    "properties": {"labels": _LABELS_SCHEMA},
    "additionalProperties": {"type": ["number", "string", "boolean"]},
    "description": "as listed by GET /v1/patterns; a file in base64",
}
BODY_SCHEMAS = {"FrameSequence": SEQUENCE_SCHEMA, "PatternParameters": PARAMETERS_SCHEMA, "DimRequest": DIM_SCHEMA}
"""The schemas of all bodies by their names in the OpenAPI document."""


def build_request_body(name: str, description: str, example: Schema, required: bool) -> Schema:
    """Build the OpenAPI description of a body that the route parses itself, for FastAPI's `openapi_extra`.

    name: of one of `BODY_SCHEMAS`
    """
    content = {"application/json": {"schema": {"$ref": f"#/components/schemas/{name}"}, "example": example}}
    return {"requestBody": {"description": description, "required": required, "content": content}}
