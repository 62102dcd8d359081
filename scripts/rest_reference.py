"""The REST reference, generated from the application's own OpenAPI document. Run as a script, it prints the page."""

import json
import re
from pathlib import Path
from types import MappingProxyType

from async_reference import MODELS

from optodrive.core.toml_model import Section
from optodrive.daemon.api.app import build_app
from optodrive.daemon.api.daemon_client import DaemonClient
from optodrive.daemon.api.openapi import BODY_SCHEMAS, ERROR_RESPONSES
from optodrive.daemon.runtime_folder import RuntimeFolder
from optodrive.device import config_sections
from optodrive.device.config_file import load_config
from optodrive.planning import effective_config
from optodrive.planning.display_model import DisplayModel

HEAD = """# REST API

Generated from the daemon's [OpenAPI document](openapi.json), which the daemon serves at `/openapi.json`. Every route
except `/v1/health` needs `Authorization: Bearer TOKEN`. Below each stand the lowest role that may call it and, after an
arrow, what it answers with 200.
[frames.json](formats/frames-json.md) describes the body of a push, [streaming](../how-to/stream-frames.md) the
WebSocket, [the client](../how-to/use-the-python-client.md) the use from Python. Of other languages, programs such as
openapi-typescript generate a client from the document, which the package has too
(`_shipped/docs/reference/openapi.json`, beside `asyncapi.json`).

Errors are problem documents (RFC 9457) with a stable `code`. A query or body with a name that the route does not read
is refused with the nearest known name. Only STOP is never refused for that.
"""
PROBLEMS_HEAD = """Every route may send these statuses with a [Problem](#problem):
"""
MODELS_HEAD = """## Models

The JSON bodies: each member with its type and meaning. A member with `?` may be null. One without a type is a number if
its name ends in a unit, a boolean if its meaning begins with "whether", else a string. Members of `Problem`,
`FrameResult` and `HoldReport` that do not apply are absent; all other models always have all members. Of a model within
a model the page says what its choices are and when a member is null. The [document](openapi.json) describes every
member, and the models within those.
"""

FILLERS = """a all an and any as at by each first for from has have if in index into is it of on or that the their them
this time to until was were which with without null none one number string text list last s um ms id these those its are
"""
SAYS_LITTLE = frozenset(FILLERS.split())
"""Words that add nothing to the names of member and model and to the model's summary.

A member with no other word in its meaning stands without it, behind those that have one.
"""
UNITS = {
    "s": "s",
    "ms": "ms",
    "us": "µs",
    "m": "m",
    "um": "µm",
    "w": "W",
    "j": "J",
    "k": "K",
    "c": "°C",
    "hz": "Hz",
    "ppm": "ppm",
}
"""Units by the end of a name."""


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
    sections = [HEAD, PROBLEMS_HEAD, *(f"- {status}: {text}" for status, text in list_problems()), ""]
    stated = {}  # what a parameter says: the route that says it first
    for path, methods in document["paths"].items():
        for method, route in methods.items():
            sections.append(format_route(f"{method.upper()} {path}", route, stated))
    sections.append(MODELS_HEAD)
    schemas = document["components"]["schemas"]
    elsewhere = {name: "configuration.md" for name in schemas if is_section(getattr(config_sections, name, None))}
    routes = "".join(sections)
    outer = {model.__name__ for model in MODELS} | {name for name in schemas if f"(#{name.lower()})" in routes}
    inner = {name for each in outer for name in schemas if f'/{name}"' in json.dumps(schemas[each])}
    elsewhere |= {name: "formats/frames-json.md" for name in BODY_SCHEMAS if name not in outer}
    elsewhere |= {name: "openapi.json" for name in schemas if name not in outer | inner | set(elsewhere)}
    sections += [
        format_model(name, schema, elsewhere, name not in outer)
        for name, schema in sorted(schemas.items())
        if name not in elsewhere
    ]
    return "\n".join(sections)


def is_section(kind):
    """Return whether a class is a table of the configuration, which has a page of its own."""
    return isinstance(kind, type) and issubclass(kind, Section)


def list_configured_members(name):
    """List the members that a model of the effective configuration inherits from the configuration."""
    bases = getattr(effective_config, name, object).__mro__[1:]
    return {member for base in bases if is_section(base) for member in base.model_fields}


def format_route(title, route, stated):
    """Format one route: description, role, parameters, body and response. What `stated` has is referred to."""
    responses = sorted(route["responses"].items())
    bodies = {}  # the model of a response: its statuses
    for status, response in responses:
        if status < "300":
            bodies.setdefault(format_content(response), []).append(status)
    returns = "; ".join(
        body if statuses == ["200"] else f"{' or '.join(statuses)} {body}" for body, statuses in bodies.items()
    )
    lines = [f"## {title}", "", route.get("description", ""), ""]
    lines += [f"{route['x-min-role'] or 'no role'} → {returns}", ""]
    if "requestBody" in route:
        body = route["requestBody"]
        lines += [f"Body: {format_type(body['content']['application/json']['schema'])}, {body['description']}.", ""]
    rows, known = [], {}
    for item in route.get("parameters", ()):
        row = format_parameter(item)
        if item["in"] == "query" and stated.setdefault(row, title) != title:
            known.setdefault(stated[row], []).append(f"`{item['name']}`")
        elif item["in"] == "query":
            rows.append(row)
    rows += [f"- {', '.join(names)}: as of {other}" for other, names in known.items()]
    return "\n".join([*lines, *rows, ""] if rows else lines)


def list_problems():
    """List status and meaning of the problem documents, which every route may send."""
    return [(status, response["description"]) for status, response in ERROR_RESPONSES.items()]


def format_content(response):
    """Format the body of a successful response: its model, or its media type."""
    ((media_type, content),) = response["content"].items()
    return format_type(content["schema"]) if "$ref" in content["schema"] else media_type


def format_model(name, schema, elsewhere, is_inner):
    """Format one model: its description and members. Other pages have those of `elsewhere`.

    is_inner: whether it is part of other models only, so that the page says less of its members
    """
    lines = [f"### {name}", ""]
    inherited = list_configured_members(name)
    members = {
        member: format_type(item, elsewhere)
        for member, item in schema.get("properties", {}).items()
        if member not in inherited or "Effective" in str(item)
    }
    description = re.sub(
        r"\bNone\b", "null", schema.get("description", "")
    )  # as JSON says what Python's docstrings say
    summary, meanings = read_meanings(description, members)
    if is_inner:  # its first sentence
        summary = re.split(r"(?<=\.)\s", summary, maxsplit=1)[0]
    if summary:
        lines += [summary, ""]
    if "properties" not in schema:
        return "\n".join([*lines, format_type(schema), ""])
    if inherited:
        lines += ["Members as [configured](configuration.md)" + (", and:" if members else "."), ""]
    stated = [member for group in meanings for member in group]
    rest = [(member,) for member in members if member not in stated]
    known = split_words(f"{name} {summary}")
    rows, bare = [], []
    for group in sorted([*meanings, *rest], key=lambda group: list(members).index(group[0])):
        meaning = meanings.get(group, "")
        is_plain = not any(members[member].startswith(("(", "`")) for member in group)
        is_said = split_words(meaning) <= known | split_words(" ".join(group)) | SAYS_LITTLE or (is_inner and is_plain)
        row = format_members({member: members[member] for member in group}, "" if is_said else meaning)
        (bare if is_said else rows).append(row)
    rows += [f"- {'; '.join(bare)}"] if bare else []
    return "\n".join([*lines, *(row if row.startswith("- ") else f"- {row}" for row in rows), ""] if rows else lines)


def split_words(text):
    """Return the words of a text and of the names in it, in lower case and without a plural's s."""
    return {word.lower().rstrip("s") for word in re.findall(r"[A-Z]?[a-z]+|\d+|[A-Z]+", text)}


def format_members(kinds, meaning):
    """Format members that share a meaning. Types, units and nulls that the names or `?` state are left out."""
    labels, stated, is_evident = [], "", True
    for name, kind in reversed(kinds.items()):
        unit = UNITS.get(name.rpartition("_")[2])
        is_null = kind.startswith("(") and kind.endswith(")")
        bare = kind[1:-1] if is_null else kind
        if (
            bare != "string"
            and (bare, unit is None) != ("number", False)
            and (bare, meaning[:7]) != ("boolean", "whether")
        ):
            is_evident = False
        labels.insert(0, f"`{name}`{'?' if is_null else ''}" + ("" if is_evident or bare == stated else f" {bare}"))
        stated = bare
        meaning = re.sub(rf", {unit}(?=,|;|$)", "", meaning) if unit else meaning
    meaning = re.sub(r", null (without (one|any|it)|otherwise)$", "", meaning)
    return f"{', '.join(labels)}" + (f": {meaning}" if meaning else "")


def read_meanings(description, members):
    """Return a description without what it states of members, and that by group of members."""
    if not members:
        return description.strip(), {}
    name = "|".join(map(re.escape, sorted(members, key=len, reverse=True)))
    starts = list(re.finditer(rf"(?:^|\n|; ?\n?)((?:{name})(?:,\s(?:{name}))*): ", description))
    meanings = {}
    ends = [*(start.start() for start in starts[1:]), len(description)]
    for start, end in zip(starts, ends, strict=False):  # a description that states no member has an end and no start
        text = description[start.end() : end]
        group = tuple(each.strip() for each in start[1].split(","))
        meanings[group] = " ".join(text.split())
    return description[: starts[0].start() if starts else len(description)].strip(), meanings


def format_parameter(item):
    """Format a parameter of a query: its name, type, default and meaning."""
    schema = item["schema"]
    kind = ", ".join(f"`{value}`" for value in schema["enum"]) if "enum" in schema else schema.get("type", "any")
    default = f", default {schema['default']}" if "default" in schema else ""
    return f"- `{item['name']}` {kind}{default}: {item.get('description', '')}"


def format_type(schema, elsewhere=MappingProxyType({})):
    """Format the type of a schema. A model is linked."""
    if "$ref" in schema:
        name = schema["$ref"].rpartition("/")[2]
        return f"[{name}]({elsewhere.get(name, f'#{name.lower()}')})"
    if choices := schema.get("anyOf") or schema.get("oneOf"):
        kinds = [format_type(item, elsewhere) for item in choices if item.get("type") != "null"]
        text = " or ".join(kinds)
        return f"({text})" if len(kinds) < len(choices) else text
    if "enum" in schema or "const" in schema:
        return ", ".join(f"`{value}`" for value in schema.get("enum", [schema.get("const")]))
    if schema.get("type") == "array":
        if "prefixItems" in schema:
            return f"[{', '.join(format_type(item) for item in schema['prefixItems'])}]"
        kind = format_type(schema["items"], elsewhere)
        return f"{kind}[]" if " " not in kind else f"list of {kind}"
    if schema.get("type") == "object" and isinstance(schema.get("additionalProperties"), dict):
        return f"map of {format_type(schema['additionalProperties'], elsewhere)}"
    return schema.get("type", "any")


if __name__ == "__main__":
    print(build_rest_reference())
