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
from optodrive.planning.stimuli.frame_json import ID_MAX
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


REF_TEMPLATE = "#/components/schemas/{model}"


def _refer(name: str, text: str = "") -> Schema:
    """Refer to a schema by its name.

    text: description of the member that has it
    """
    reference: Schema = {"$ref": REF_TEMPLATE.format(model=name)}
    return {**reference, "description": text} if text else reference


def _by_pixel_schema(value: Schema, text: str) -> Schema:
    """Return the schema of values by pixel."""
    keys = {"pattern": "^(0|[1-9][0-9]*)$"}
    return {"type": "object", "additionalProperties": value, "propertyNames": keys, "description": text}


_INTENSITY_SCHEMA: Schema = {"type": "number", "minimum": 0, "description": "in thresholds"}
_HEIGHTS_SCHEMA = _by_pixel_schema(_HEIGHT_SCHEMA, "Heights in µm by the index of the pixel.")
_INTENSITIES_SCHEMA = _by_pixel_schema(
    _INTENSITY_SCHEMA, "Perceived intensities in thresholds by the index of the pixel."
)


def _per_pixel_schema(by_pixel: Schema, value: Schema, text: str) -> Schema:
    """Return the schema of values by pixel, or of one per pixel."""
    return {"oneOf": [by_pixel, {"type": "array", "items": value}], "description": text}


_TARGETS_TEXT = "heights by pixel, or one height per pixel"


def _described(schema: Schema, text: str) -> Schema:
    return {**schema, "description": text}


LIVE_FRAME_SCHEMA = _object_schema(
    {"target_um": _per_pixel_schema(_HEIGHTS_SCHEMA, _HEIGHT_SCHEMA, _TARGETS_TEXT)},
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


def _frame_schema(text: str, **target: Schema) -> Schema:
    """Return the schema of a frame.

    target: the member that states what it raises
    """
    times = {
        "show_at_s": _described(_START_SCHEMA, "time at which the frame begins, from the zero of the sequence, s"),
        "duration_s": _described(_DURATION_SCHEMA, "time within which all its pixels are raised, s"),
    }
    optional: dict[str, Schema] = {
        "id": {"type": "string", "minLength": 1, "maxLength": ID_MAX, "description": "name of the frame in reports"},
        "simultaneous": {"type": "boolean", "description": "raise all pixels within one relaxation time"},
        "priority": _PRIORITY_SCHEMA,
    }
    return {**_object_schema({**times, **target}, optional), "description": text}


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
    "description": "Names and values that are recorded with a plan and never interpreted.",
}
_FRAMES = ("HeightFrame", "IntensityFrame")
_TRAINS = ("PulseTrain", "HeightTrain", "IntensityTrain")


def _list_schema(names: tuple[str, ...], max_items: int, text: str) -> Schema:
    return {
        "type": "array",
        "items": {"oneOf": [_refer(name) for name in names]},
        "maxItems": max_items,
        "description": text,
    }


SEQUENCE_SCHEMA: Schema = {
    **_object_schema(
        {},
        {
            "frames": _list_schema(_FRAMES, FRAMES_MAX, "frames in order of time"),
            "trains": _list_schema(_TRAINS, TRAINS_MAX, "trains of pulses, of different pixels or times"),
            "labels": _refer("Labels", "recorded with the plan and never interpreted"),
        },
    ),
    # Not `anyOf`: programs that generate clients make a nameless model of each of its choices.
    "not": {"properties": {"frames": {"maxItems": 0}, "trains": {"maxItems": 0}}},
    "description": "FRAMES.json: at least one frame or train.",
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
    "properties": {"labels": _refer("Labels", "recorded with the plan and never interpreted")},
    "additionalProperties": {"type": ["number", "string", "boolean"]},
    "description": "Values by name, as GET /v1/patterns lists the names; a file in base64.",
}
BODY_SCHEMAS: dict[str, Schema] = {
    "FrameSequence": SEQUENCE_SCHEMA,
    "HeightFrame": _frame_schema(
        "Heights within a time.",
        target_um=_per_pixel_schema(_refer("HeightByPixel"), _HEIGHT_SCHEMA, _TARGETS_TEXT),
    ),
    "IntensityFrame": _frame_schema(
        "Perceived intensities within a time.",
        intensity=_per_pixel_schema(
            _refer("IntensityByPixel"), _INTENSITY_SCHEMA, "perceived intensities by pixel, or one per pixel"
        ),
    ),
    "HeightByPixel": _HEIGHTS_SCHEMA,
    "IntensityByPixel": _INTENSITIES_SCHEMA,
    "PulseTrain": _described(_PULSE_TRAIN_SCHEMA, "Equal pulses of one pixel, by width and power."),
    "HeightTrain": _described(_HEIGHT_TRAIN_SCHEMA, "Pulses of one pixel that reach one height."),
    "IntensityTrain": _described(_INTENSITY_TRAIN_SCHEMA, "Pulses of one pixel that reach one perceived intensity."),
    "Labels": _LABELS_SCHEMA,
    "PatternParameters": PARAMETERS_SCHEMA,
    "DimRequest": DIM_SCHEMA,
}
"""The schemas of all bodies and their parts by their names in the OpenAPI document."""
TAGS = [
    {"name": "state", "description": "What board, link, queue and planner do, and the effective configuration."},
    {"name": "board", "description": "Arm, disarm, pause, dim and stop the board."},
    {"name": "service", "description": "The daemon itself."},
    {"name": "plans", "description": "Push frames and trains, read what became of them, and cancel them."},
    {"name": "patterns", "description": "Named stimuli and their parameters."},
]
"""What the routes of a tag are for."""


def build_request_body(name: str, description: str, example: Schema, required: bool) -> Schema:
    """Build the OpenAPI description of a body that the route parses itself, for FastAPI's `openapi_extra`.

    name: of one of `BODY_SCHEMAS`
    """
    content = {"application/json": {"schema": _refer(name), "example": example}}
    return {"requestBody": {"description": description, "required": required, "content": content}}


ERROR_RESPONSES: dict[int | str, dict[str, Any]] = {
    status: {"description": text, "content": {MEDIA_TYPE: {"schema": _refer(Problem.__name__)}}}
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
                        {"properties": {"event": {"const": event}, "data": {"contentSchema": _refer(model.__name__)}}}
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
