"""Print the REST reference, generated from the application's OpenAPI: `python scripts/rest_reference.py`."""

from optodrive.core.clock import MonotonicClock
from optodrive.daemon.engine.engine import Engine
from optodrive.daemon.web.api import build_app
from optodrive.device.config import load_config
from optodrive.link.transport.registry import find_transport_factory
from optodrive.planning.display_model import DisplayModel

HEAD = """# REST

Generated from the daemon's OpenAPI, which it answers itself at `/openapi.json`. Every route but `/v1/health` needs
`Authorization: Bearer TOKEN`; errors are problem documents (RFC 9457) with a stable `code`. The WebSocket is in
[streaming](../how-to/stream-frames.md), the client from Python in [client](../how-to/use-the-python-client.md).
"""


def build_openapi():
    """Build the application's OpenAPI without connecting to a board."""
    config = load_config()
    engine = Engine(DisplayModel.from_config(config), find_transport_factory(config.board)(), MonotonicClock())
    try:
        return build_app(engine, "unused").openapi()
    finally:
        engine.close()


def build_rest_reference():
    """Build the reference as Markdown, one section per route."""
    sections = [HEAD]
    for path, methods in build_openapi()["paths"].items():
        for method, route in methods.items():
            sections.append(format_section(f"{method.upper()} {path}", route))
    return "\n".join(sections)


def format_section(title, route):
    """Format one route: description, parameters, body and responses."""
    lines = [f"## {title}", "", route.get("description", ""), ""]
    rows = [
        f"| `{item['name']}` | {item['in']} | {format_type(item['schema'])} |"
        f" {escape_cell(item.get('description', ''))} |"
        for item in route.get("parameters", ())
    ]
    if rows:
        lines += ["| parameter | in | type | |", "|---|---|---|---|", *rows, ""]
    if "requestBody" in route:
        lines += [f"Body: {route['requestBody'].get('description', 'JSON')}.", ""]
    answers = [f"{status} {answer['description'].rstrip('.')}" for status, answer in sorted(route["responses"].items())]
    return "\n".join([*lines, "Answers: " + "; ".join(answers) + ".", ""])


def format_type(schema):
    """Format the type of a parameter."""
    text = schema.get("type", "any")
    if "enum" in schema:
        text = ", ".join(f"`{value}`" for value in schema["enum"])
    return escape_cell(text + (f", {schema['default']} if left out" if "default" in schema else ""))


def escape_cell(text):
    """Escape text for a cell of a table."""
    return str(text).replace("|", "\\|").replace("\n", " ")


if __name__ == "__main__":
    print(build_rest_reference())
