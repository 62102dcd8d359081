"""Docstrings of fields, which the reference and the schema show."""

from optodrive.core.toml_model import Section, read_field_docstrings


class Base(Section):
    """A base."""

    size_m: float
    """Size
    in metres."""
    name: str = "text"


class Derived(Base):
    """A table."""

    name: str = "other"
    """What it is called."""
    inner: Base | None = None
    """A table within."""


def test_docstrings_of_fields_are_read_with_those_of_the_base():
    assert read_field_docstrings(Base) == {"size_m": "Size\nin metres."}
    expected = {"size_m": "Size\nin metres.", "name": "What it is called.", "inner": "A table within."}
    assert read_field_docstrings(Derived) == expected


def test_the_schema_describes_every_field_that_has_a_docstring():
    schema = Derived.model_json_schema()
    described = {name: item.get("description") for name, item in schema["properties"].items()}
    assert described == read_field_docstrings(Derived)
    assert schema["$defs"]["Base"]["properties"]["size_m"]["description"] == "Size\nin metres."
