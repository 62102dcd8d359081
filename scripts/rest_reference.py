"""The REST reference, generated from the application's own OpenAPI document. Run as a script, it prints the page."""

import json
from pathlib import Path

from optodrive.core.toml_model import Section
from optodrive.daemon.api.app import build_app
from optodrive.daemon.api.daemon_client import DaemonClient
from optodrive.daemon.api.openapi import ERROR_RESPONSES
from optodrive.daemon.runtime_folder import RuntimeFolder
from optodrive.device import config_sections
from optodrive.device.config_file import load_config
from optodrive.planning import effective_config
from optodrive.planning.display_model import DisplayModel

HEAD = """# REST API

Generated from the daemon's [OpenAPI document](openapi.json), which the daemon serves at `/openapi.json`. Every route
except `/v1/health` needs `Authorization: Bearer TOKEN`; the role is the lowest that may call the route. Errors are
problem documents (RFC 9457) with a stable `code`. A request whose query or body says something that its route does not
read, such as a misspelt option, is refused with its name and the nearest known one; only STOP is never refused for
that. [Streaming](../how-to/stream-frames.md) describes the WebSocket, [the client](../how-to/use-the-python-client.md)
its use from Python.
"""
PROBLEMS_HEAD = """Every route may send these statuses with a [Problem](#problem):

| status | meaning |
|---|---|"""
MODELS_HEAD = """## Models

The JSON bodies. A type in parentheses may be null. Members of `Problem`, `FrameResult` and `HoldReport` that do not
apply are absent; all other models always have all members.
"""


def build_openapi():
    """Build the application's OpenAPI document without the other processes of the daemon."""
    folder = RuntimeFolder(Path(), Path("link.sock"), 0o600, Path())
    return build_app(DaemonClient(DisplayModel.from_config(load_config()), folder), "unused").openapi()


def build_openapi_text():
    """Return the OpenAPI document as JSON text."""
    return json.dumps(build_openapi(), indent=1, ensure_ascii=False) + "\n"


def build_rest_reference():
    """Build the page: one section per route, then one per model."""
    document = build_openapi()
    sections = [HEAD, PROBLEMS_HEAD, *(f"| {status} | {text} |" for status, text in list_problems()), ""]
    for path, methods in document["paths"].items():
        for method, route in methods.items():
            sections.append(format_route(f"{method.upper()} {path}", route))
    sections.append(MODELS_HEAD)
    schemas = document["components"]["schemas"]
    configured = {name for name in schemas if is_section(getattr(config_sections, name, None))}
    sections += [
        format_model(name, schema, configured) for name, schema in sorted(schemas.items()) if name not in configured
    ]
    return "\n".join(sections)


def is_section(kind):
    """Return whether a class is a table of the configuration, which has a page of its own."""
    return isinstance(kind, type) and issubclass(kind, Section)


def list_configured_members(name):
    """List the members that a model of the effective configuration inherits from the configuration."""
    bases = getattr(effective_config, name, object).__mro__[1:]
    return {member for base in bases if is_section(base) for member in base.model_fields}


def format_route(title, route):
    """Format one route: description, role, parameters, body and responses."""
    lines = [f"## {title}", "", route.get("description", ""), "", f"Role: {route['x-min-role'] or 'none'}.", ""]
    rows = [
        f"| `{item['name']}` | {item['in']} | {format_parameter(item['schema'])} | "
        f"{escape_cell(item.get('description', ''))} |"
        for item in route.get("parameters", ())
    ]
    if rows:
        lines += ["| parameter | in | type | |", "|---|---|---|---|", *rows, ""]
    if "requestBody" in route:
        body = route["requestBody"]
        lines += [f"Body: {format_type(body['content']['application/json']['schema'])}, {body['description']}.", ""]
    responses = sorted(route["responses"].items())
    bodies = [f"{status} {format_content(response)}" for status, response in responses if status < "300"]
    return "\n".join([*lines, f"Response: {'; '.join(bodies)}.", ""])


def list_problems():
    """List status and meaning of the problem documents, which every route may send."""
    return [(status, response["description"]) for status, response in ERROR_RESPONSES.items()]


def format_content(response):
    """Format the body of a successful response: its model, or its media type."""
    ((media_type, content),) = response["content"].items()
    return format_type(content["schema"]) if "$ref" in content["schema"] else media_type


def format_model(name, schema, configured):
    """Format one model: its description and members. The page on the configuration has those of `configured`."""
    lines = [f"### {name}", ""]
    if schema.get("description"):
        lines += [schema["description"].strip(), ""]
    if "properties" not in schema:
        return "\n".join([*lines, format_type(schema), ""])
    inherited = list_configured_members(name)
    if inherited:
        lines += ["Members as [configured](configuration.md), and:", ""]
    rows = [
        f"| `{member}` | {format_type(item, configured)} |"
        for member, item in schema["properties"].items()
        if member not in inherited or "Effective" in str(item)
    ]
    return "\n".join([*lines, "| member | type |", "|---|---|", *rows, ""])


def format_parameter(schema):
    """Format a parameter's type and default."""
    text = ", ".join(f"`{value}`" for value in schema["enum"]) if "enum" in schema else schema.get("type", "any")
    return escape_cell(text + (f", default {schema['default']}" if "default" in schema else ""))


def format_type(schema, configured=frozenset()):
    """Format the type of a schema. A model is linked."""
    if "$ref" in schema:
        name = schema["$ref"].rpartition("/")[2]
        return f"[{name}](configuration.md)" if name in configured else f"[{name}](#{name.lower()})"
    if "anyOf" in schema:
        kinds = [format_type(item, configured) for item in schema["anyOf"] if item.get("type") != "null"]
        text = " or ".join(kinds)
        return f"({text})" if len(kinds) < len(schema["anyOf"]) else text
    if "enum" in schema or "const" in schema:
        return ", ".join(f"`{value}`" for value in schema.get("enum", [schema.get("const")]))
    if schema.get("type") == "array":
        if "prefixItems" in schema:
            return f"[{', '.join(format_type(item) for item in schema['prefixItems'])}]"
        return f"list of {format_type(schema['items'])}"
    if schema.get("type") == "object" and isinstance(schema.get("additionalProperties"), dict):
        return f"map of {format_type(schema['additionalProperties'])}"
    return schema.get("type", "any")


def escape_cell(text):
    """Escape text for a table cell."""
    return str(text).replace("|", "\\|").replace("\n", " ")


if __name__ == "__main__":
    print(build_rest_reference())
