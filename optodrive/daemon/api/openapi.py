"""The parts of the OpenAPI document that the routes do not declare: errors, events, tokens, roles and links."""

from typing import Any

from fastapi import FastAPI
from pydantic.json_schema import models_json_schema

from optodrive.core.json_model import JsonModel
from optodrive.core.types.stimuli import FRAME_NUMBER_MAX
from optodrive.daemon.api.request_models import DIM_SCHEMA
from optodrive.daemon.api.route_table import RouteTable
from optodrive.daemon.responses.messages import FingersMessage, FingersRefusal, FrameResult, HoldReport
from optodrive.daemon.responses.problem import MEDIA_TYPE, Problem
from optodrive.daemon.responses.telemetry import EVENTS
from optodrive.planning.stimuli.frame_json import ID_MAX, TARGET_KEYS
from optodrive.planning.stimuli.json_values import KEY_MAX, LABELS_MAX, NUMBER_MAX, PRIORITY_MAX, TEXT_MAX, TIME_MAX_S
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


def _by_pixel_schema(value: Schema, text: str) -> Schema:
    """Return the schema of values by pixel, or of one per pixel."""
    by_pixel = {"type": "object", "additionalProperties": value, "propertyNames": {"pattern": "^(0|[1-9][0-9]*)$"}}
    return {"oneOf": [by_pixel, {"type": "array", "items": value}], "description": text}


_TARGETS_SCHEMA = _by_pixel_schema(_HEIGHT_SCHEMA, "heights by pixel, or one height per pixel")
_INTENSITIES_SCHEMA = _by_pixel_schema(
    {"type": "number", "minimum": 0, "description": "in thresholds"},
    "perceived intensities by pixel, or one per pixel, in place of target_um",
)


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


REF_TEMPLATE = "#/components/schemas/{model}"


def _refer_to(model: type) -> dict[str, str]:
    return {"$ref": REF_TEMPLATE.format(model=model.__name__)}


ERROR_RESPONSES: dict[int | str, dict[str, Any]] = {
    status: {"description": text, "content": {MEDIA_TYPE: {"schema": _refer_to(Problem)}}}
    for status, text in {
        401: "no token, or a wrong one",
        403: "the Origin is not allowed, or the token's role is insufficient",
        404: "not found",
        405: "method not allowed",
        409: "refused, ended by a stop, or not possible in this state",
        413: "body too large",
        421: "the Host is not allowed",
        422: "invalid input",
        429: "request rate exceeded",
        503: "no link to the board, a process of the daemon restarts, or too many requests wait",
    }.items()
}
ERROR_RESPONSES[429]["headers"] = {
    "Retry-After": {"description": "whole seconds to wait", "schema": {"type": "integer", "minimum": 1}}
}
EVENT_RESPONSES: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "Server-sent events until the client disconnects",
        "content": {
            "text/event-stream": {
                "schema": {
                    "type": "object",
                    "required": ["event", "data"],
                    "properties": {
                        "event": {"type": "string", "description": "kind of the event"},
                        "data": {
                            "type": "string",
                            "contentMediaType": "application/json",
                            "description": "the event in JSON",
                        },
                    },
                    "oneOf": [
                        {"properties": {"event": {"const": event}, "data": {"contentSchema": _refer_to(model)}}}
                        for event, model in EVENTS.items()
                    ],
                }
            }
        },
    }
}
"""The schema describes one event."""
PLAN_LINKS: dict[str, Any] = {
    "read the plan": {"operationId": "get_plan", "parameters": {"plan_id": "$response.body#/plan"}},
    "cancel the plan": {"operationId": "cancel_plan", "parameters": {"plan_id": "$response.body#/plan"}},
}


def extend_openapi(app: FastAPI, table: RouteTable) -> None:
    """Add models of errors, events and stream messages, required roles, and links from a new plan."""
    build_document, roles = app.openapi, table.roles

    def openapi() -> dict[str, Any]:
        if app.openapi_schema:
            return app.openapi_schema
        document = build_document()
        components = document.setdefault("components", {})
        components["securitySchemes"] = {"token": {"type": "http", "scheme": "bearer"}}
        components["schemas"] = BODY_SCHEMAS | _list_extra_schemas() | components.get("schemas", {})
        for schema in components["schemas"].values():
            _describe_members(schema)
        for path, methods in document["paths"].items():
            for method, operation in methods.items():
                min_role = roles[f"{method.upper()} {path}"]
                operation["security"] = [] if min_role is None else [{"token": []}]
                operation["x-min-role"] = min_role
                if "201" in operation["responses"]:
                    operation["responses"]["201"]["links"] = PLAN_LINKS
        return document

    app.openapi = openapi  # type: ignore[method-assign]


def _describe_members(schema: dict[str, Any]) -> None:
    """Give the members of a model the descriptions that its docstring states.

    Its form is "name, name: text; name: text", with one or more names to a text.
    """
    members, described = schema.get("properties", {}), []
    for line in schema.get("description", "").splitlines():
        for k, part in enumerate(line.strip().split("; ")):
            names, _, text = part.partition(": ")
            stated = [members.get(name) for name in names.split(", ")]
            if text and None not in stated:
                described = [member for member in stated if "description" not in member]
                for member in described:
                    member["description"] = text
            else:
                for member in described:
                    member["description"] += ("; " if k else " ") + part
        if not line.strip():
            described = []


def _list_extra_schemas() -> dict[str, Any]:
    models: list[type[JsonModel]] = [
        Problem,
        FrameResult,
        FingersMessage,
        FingersRefusal,
        HoldReport,
        *EVENTS.values(),
    ]
    _, document = models_json_schema([(model, "serialization") for model in models], ref_template=REF_TEMPLATE)
    schemas: dict[str, Any] = document["$defs"]
    return schemas
