"""Write the reference pages that follow from the code: configuration, terms, REST, streams."""

import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args, get_origin

from async_reference import build_async_document, build_async_reference
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined
from rest_reference import build_openapi_text, build_rest_reference

from optodrive.core.toml_model import read_field_docstrings
from optodrive.device.config import VERSION, Config
from optodrive.physics.term_reference import describe_term
from optodrive.physics.terms import discover_terms

FOLDER = Path(__file__).resolve().parent.parent / "docs" / "reference"
CONFIGURATION_HEAD = f"""# Configuration

Generated from `optodrive/device/config_sections.py` by `scripts/reference`. A configuration is one TOML file per
display, format version {VERSION}. `optodrive config check` checks it, and `optodrive config show --json` prints it with
every default and derived number. Quantities are in SI units, named by the suffix of the key. In brackets stand the
permitted values and the default.
"""
TERMS_HEAD = """# Terms

Generated from `optodrive/physics/terms` by `scripts/reference`. A term is a physical effect beyond the nominal pixel. A
[parameter set](formats/parameter-sets.md) (`model.toml`) may hold its parameters, `optodrive diagnose` looks for it in
recordings, and the limiter bounds the heat that it can add. `optodrive terms TERM` prints the parameters, with unit,
range, source and the value of one that may be omitted, and a complete file that states the term.

`planner_terms` names the terms that heights are planned with. `simulate --truth model.toml` simulates these and every
term that the file itself states; those of its base count only if `planner_terms` names them.

A term that the integrator cannot follow is refused by name. A diagnosis that cannot compute a term says so and has the
verdict `incomplete` in place of `none`. CONTRIBUTING.md states what the integrator asks of a new term.
"""


def sections(model: type[BaseModel], path: str = "") -> Iterator[tuple[str, type[BaseModel]]]:
    """Yield every TOML table of a model with its path, depth first."""
    yield path, model
    for name, info in model.model_fields.items():
        if get_origin(info.annotation) is tuple and is_table(info):  # tables of a list, with sections named above
            yield f"[{name}]", get_args(info.annotation)[0]
            continue
        for kind in (info.annotation, *get_args(info.annotation)):
            if isinstance(kind, type) and issubclass(kind, BaseModel):
                yield from sections(kind, f"{path}.{name}".lstrip("."))


def is_table(info: FieldInfo) -> bool:
    """Return whether a field is a table of its own."""
    kinds = (info.annotation, *get_args(info.annotation))
    return any(isinstance(kind, type) and issubclass(kind, BaseModel) for kind in kinds)


def format_type(schema: dict[str, Any]) -> str:
    """Return a field's type and bounds as one phrase."""
    if "anyOf" in schema:
        return " or ".join(format_type(item) for item in schema["anyOf"] if item.get("type") != "null")
    if "enum" in schema:
        return ", ".join(f'`"{value}"`' for value in schema["enum"])
    if "const" in schema:
        return f"`{json.dumps(schema['const'])}`"
    bounds = {"exclusiveMinimum": ">", "minimum": "≥", "exclusiveMaximum": "<", "maximum": "≤"}
    if "minimum" in schema and "maximum" in schema:
        limits = f"{schema['minimum']:g} to {schema['maximum']:g}"
    else:
        limits = " and ".join(f"{sign} {schema[key]:g}" for key, sign in bounds.items() if key in schema)
    kind = schema.get("type", "value")
    return " ".join(part for part in ("" if kind == "number" and limits else kind, limits) if part)


def format_default(info: FieldInfo) -> str:
    """Return a field's default as TOML, or the meaning of its absence."""
    if info.default is PydanticUndefined:
        return "required"
    return (
        "none"
        if info.default is None
        else f"`{info.default!r}`".replace("'", '"').replace("True", "true").replace("False", "false")
    )


def describe(name: str, texts: dict[str, str]) -> str:
    """Return a key's description in one line, without the unit that its name ends in."""
    unit = {"s": "s", "m": "m", "c": "°C", "w": "W", "j": "J", "hz": "Hz", "rad": "rad"}.get(name.rpartition("_")[2])
    return re.sub(rf", {unit}(?=[.;,:])", "", " ".join(texts.get(name, "").split()))


def build_configuration_reference() -> str:
    """Return Markdown with one section per TOML table and one line per key."""
    parts = [CONFIGURATION_HEAD]
    for path, model in sections(Config):
        schema, texts = model.model_json_schema()["properties"], read_field_docstrings(model)
        rows = [
            f"- `{name}` ({format_type(schema[name])}; {format_default(info)}): {describe(name, texts)}"
            for name, info in model.model_fields.items()
            if not is_table(info)
        ]
        summary = " ".join((model.__doc__ or "").split())
        title = f"## `[{path}]`" if path else "## Top level"
        parts.append("\n".join([title, "", summary, "", *rows, ""]))
    return "\n".join(parts)


def build_terms_reference() -> str:
    """Return Markdown with one section per term."""
    parts = [TERMS_HEAD]
    for key, term in sorted(discover_terms().items()):
        about = describe_term(term)
        notes = [f"Needs {', '.join(f'`{name}`' for name in term.requires)}."] if term.requires else []
        if not term.in_pixel:
            notes.append("Only the limiter accounts for it; heights are not planned with it.")
        if term.signature:
            notes.append(f"Visible in {term.signature}.")
        text = [about["label"][:1].upper() + about["label"][1:] + ".", "", about["equation"]]
        parts.append("\n".join([f"## `{key}`", "", *text, *notes, ""]))
    return "\n".join(parts)


PAGES = {
    "configuration.md": build_configuration_reference,
    "terms.md": build_terms_reference,
    "rest.md": build_rest_reference,
    "streams.md": build_async_reference,
    "openapi.json": build_openapi_text,
    "asyncapi.json": build_async_document,
}


def main() -> None:
    """Write every page. An argument names another folder."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else FOLDER
    for name, build in PAGES.items():
        (folder / name).write_text(build(), encoding="utf-8")


if __name__ == "__main__":
    main()
