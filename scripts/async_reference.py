"""The AsyncAPI document of the daemon's streams, and its page, from the models that the daemon sends and accepts."""

import json
from typing import get_args

from pydantic.json_schema import models_json_schema

from optodrive.core.types.push_options import Policy
from optodrive.daemon.api.openapi import LIVE_FRAME_SCHEMA
from optodrive.daemon.responses.messages import FingersMessage, FingersRefusal, FrameResult, HoldReport
from optodrive.daemon.responses.telemetry import EVENTS

MODELS = (FrameResult, FingersMessage, FingersRefusal, HoldReport, *EVENTS.values())
"""Bodies of the messages."""
REF_TEMPLATE = "#/components/schemas/{model}"
BINARY_FRAME = "ODF1, a u32 frame number, and one u16 height per pixel in 0.1 µm, little-endian"
HEAD = """# Streams

Generated from the daemon's models by `scripts/reference`, like the [AsyncAPI 3.0 document](asyncapi.json) with the
JSON Schema of every message. The daemon's WebSockets and its server-sent events need `Authorization: Bearer TOKEN`;
a browser's WebSocket, which cannot send it, offers the subprotocols `optodrive` and `bearer.` with the token in
base64url. [Streaming](../how-to/stream-frames.md), [fingers](../how-to/read-by-fingers.md),
[hold-to-run](../how-to/secure-access.md#hold-to-run) and [telemetry](telemetry.md) describe
their use; the models are those of the [REST reference](rest.md#models).
"""


def _refer(model):
    return {"$ref": REF_TEMPLATE.format(model=model.__name__)}


CHANNELS = {
    "stream": {
        "address": "/v1/stream",
        "description": "Frames, of which the newest wins, and the results of each. Role: operator.",
        "bindings": {
            "ws": {
                "method": "GET",
                "query": {
                    "type": "object",
                    "properties": {"policy": {"enum": list(get_args(Policy))}, "standing": {"type": "boolean"}},
                },
            }
        },
        "messages": {
            "frame": {"summary": "a frame as text", "payload": LIVE_FRAME_SCHEMA},
            "binaryFrame": {
                "summary": BINARY_FRAME,
                "contentType": "application/octet-stream",
                "payload": {"type": "string", "format": "binary"},
            },
            "result": {"summary": "what became of a frame", "payload": _refer(FrameResult)},
        },
    },
    "fingers": {
        "address": "/v1/fingers",
        "description": "Places of fingertips, for which standing frames are refreshed first. Role: operator.",
        "bindings": {"ws": {"method": "GET"}},
        "messages": {
            "places": {"summary": "all fingertips at a time", "payload": _refer(FingersMessage)},
            "refusal": {"summary": "why a message was not taken", "payload": _refer(FingersRefusal)},
        },
    },
    "hold": {
        "address": "/v1/hold",
        "description": "An arming that lasts as long as the connection and a beat per second. Role: armer.",
        "bindings": {"ws": {"method": "GET"}},
        "messages": {
            "beat": {"summary": "at least once per second", "contentType": "text/plain", "payload": {"const": "beat"}},
            "report": {"summary": "what became of the arming", "payload": _refer(HoldReport)},
        },
    },
    "telemetry": {
        "address": "/v1/telemetry",
        "description": "Server-sent events. Role: viewer.",
        "bindings": {"http": {}},
        "messages": {event: {"summary": f"event {event}", "payload": _refer(model)} for event, model in EVENTS.items()},
    },
}
FROM_CLIENT = {"stream": ("frame", "binaryFrame"), "fingers": ("places",), "hold": ("beat",), "telemetry": ()}
"""The messages that the daemon receives; it sends all others."""


def build_document():
    """Build the AsyncAPI document."""
    _, schemas = models_json_schema([(model, "serialization") for model in MODELS], ref_template=REF_TEMPLATE)
    operations = {}
    for name, channel in CHANNELS.items():
        for action, is_received in (("receive", True), ("send", False)):
            messages = [key for key in channel["messages"] if (key in FROM_CLIENT[name]) == is_received]
            if messages:
                operations[f"{action}{name.capitalize()}"] = {
                    "action": action,
                    "channel": {"$ref": f"#/channels/{name}"},
                    "messages": [{"$ref": f"#/channels/{name}/messages/{key}"} for key in messages],
                }
    return {
        "asyncapi": "3.0.0",
        "info": {"title": "optodrive", "version": "1", "description": "Streams of the daemon, which is the server."},
        "defaultContentType": "application/json",
        "servers": {
            "daemon": {
                "host": "127.0.0.1:8450",
                "protocol": "ws",
                "security": [{"$ref": "#/components/securitySchemes/token"}],
            }
        },
        "channels": CHANNELS,
        "operations": operations,
        "components": {
            "schemas": schemas["$defs"],
            "securitySchemes": {"token": {"type": "http", "scheme": "bearer"}},
        },
    }


def build_async_document():
    """Return the AsyncAPI document as JSON text."""
    return json.dumps(build_document(), indent=1, ensure_ascii=False) + "\n"


def build_async_reference():
    """Build the page: one section per channel with its messages."""
    parts = [HEAD]
    for name, channel in CHANNELS.items():
        rows = []
        for key, message in channel["messages"].items():
            sender = "client" if key in FROM_CLIENT[name] else "daemon"
            summary = "" if message["summary"] == f"event {key}" else f": {message['summary']}"
            rows.append(f"- `{key}` from the {sender}, {_format_payload(message['payload'])}{summary}")
        parts.append("\n".join([f"## {channel['address']}", "", channel["description"], "", *rows, ""]))
    return "\n".join(parts)


def _format_payload(payload):
    if "$ref" in payload:
        name = payload["$ref"].rpartition("/")[2]
        return f"[{name}](rest.md#{name.lower()})"
    return ", ".join(f"`{name}`" for name in payload.get("properties", ())) or payload.get("format", "any")
