"""The docstrings below the fields of a model, read from its source when somebody asks for them.

Pydantic can read them as well (`use_attribute_docstrings`), but does so when the model is created: a twentieth of the
time of `optodrive plan`, which shows none of them.
"""

import ast
import inspect
from functools import cache
from textwrap import dedent
from typing import Any

from pydantic import BaseModel


@cache
def read_field_docstrings(owner: type[BaseModel]) -> dict[str, str]:
    """Return the docstring of each field that has one, by name, with those of the base classes."""
    docstrings: dict[str, str] = {}
    for base in reversed(owner.__mro__):
        if issubclass(base, BaseModel) and base is not BaseModel:
            docstrings |= _read_own_docstrings(base)
    return docstrings


def _read_own_docstrings(owner: type) -> dict[str, str]:
    definition: Any = ast.parse(dedent(inspect.getsource(owner))).body[0]
    return {
        field.target.id: inspect.cleandoc(text.value.value)
        for field, text in zip(definition.body, definition.body[1:], strict=False)
        if isinstance(field, ast.AnnAssign)
        and isinstance(field.target, ast.Name)
        and isinstance(text, ast.Expr)
        and isinstance(text.value, ast.Constant)
        and isinstance(text.value.value, str)
    }
