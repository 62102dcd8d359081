"""The parts of the OpenAPI document that the routes do not declare: errors, events, tokens, roles and links."""

from typing import Any

from fastapi import FastAPI
from pydantic.json_schema import models_json_schema

from optodrive.core.json_model import JsonModel
from optodrive.daemon.api.openapi_bodies import BODY_SCHEMAS
from optodrive.daemon.api.route_table import RouteTable
from optodrive.daemon.responses.messages import FingersMessage, FingersRefusal, FrameResult, HoldReport
from optodrive.daemon.responses.problem import MEDIA_TYPE, Problem
from optodrive.daemon.responses.telemetry import EVENTS

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
