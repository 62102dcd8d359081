"""What the OpenAPI document says beside the routes themselves: errors, tokens and roles."""

from typing import Any

from fastapi import FastAPI

from optodrive.daemon.web.roles import ROUTES

PROBLEM_SCHEMA: dict[str, Any] = {
    "type": "object",
    "description": "RFC 9457, with a code that stays",
    "required": ["type", "title", "status", "detail", "code"],
    "properties": {
        "type": {"type": "string"},
        "title": {"type": "string"},
        "status": {"type": "integer"},
        "detail": {"type": "string", "description": "one line"},
        "code": {"type": "string"},
    },
}
ERROR_RESPONSES: dict[int | str, dict[str, Any]] = {
    status: {"description": text, "content": {"application/problem+json": {"schema": PROBLEM_SCHEMA}}}
    for status, text in {
        401: "no token, or a wrong one",
        403: "a foreign Origin, or a token whose role does not allow it",
        404: "no such thing",
        405: "not with this method",
        409: "refused, or not possible in this state",
        413: "body too large",
        421: "a foreign Host",
        422: "bad input",
        429: "this caller asks too often",
        503: "no link to the board",
    }.items()
}
ERROR_RESPONSES[429]["headers"] = {
    "Retry-After": {"description": "whole seconds to wait", "schema": {"type": "integer", "minimum": 1}}
}


EVENT_RESPONSES: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "Server-sent events until the caller leaves",
        "content": {
            "text/event-stream": {
                "schema": {
                    "type": "object",
                    "required": ["event", "data"],
                    "properties": {
                        "event": {"type": "string", "enum": ["state", "display", "pulses", "budget", "fault"]},
                        "data": {"type": "string", "contentMediaType": "application/json"},
                    },
                }
            }
        },
    }
}
"""One event, as a reader of the stream takes it."""
PLAN_LINKS: dict[str, Any] = {
    "what became of it": {"operationId": "plan", "parameters": {"plan_id": "$response.body#/plan"}},
    "end it": {"operationId": "cancel", "parameters": {"plan_id": "$response.body#/plan"}},
}


def extend_openapi(app: FastAPI) -> None:
    """Let the document say which role a call needs at least, and where a plan is found once it is made."""
    build_document = app.openapi

    def openapi() -> dict[str, Any]:
        if app.openapi_schema:
            return app.openapi_schema
        document = build_document()
        document.setdefault("components", {})["securitySchemes"] = {"token": {"type": "http", "scheme": "bearer"}}
        for path, methods in document["paths"].items():
            for method, operation in methods.items():
                min_role = ROUTES[f"{method.upper()} {path}"]
                operation["security"] = [] if min_role is None else [{"token": []}]
                operation["x-role"] = min_role
                if "201" in operation["responses"]:
                    operation["responses"]["201"]["links"] = PLAN_LINKS
        return document

    app.openapi = openapi  # type: ignore[method-assign]
