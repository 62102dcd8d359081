"""Packages that only an extra installs, and optional modules that a library takes for not installed."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any

from optodrive.core.errors import MISSING, InputError


@contextmanager
def hide_modules(*names: str) -> Iterator[None]:
    """Make imports of modules fail that are not imported yet. A library then does without them, and starts earlier."""
    modules: dict[str, Any] = sys.modules
    hidden = [name for name in names if name not in modules]
    modules.update(dict.fromkeys(hidden))
    try:
        yield
    finally:
        for name in hidden:
            del modules[name]


def import_extra(module: str, name: str = "", extra: str = "analysis") -> Any:
    """Import a module. Raise InputError (missing_extra) if the extra that provides it is not installed.

    name: of the package, if it is not the module's
    """
    try:
        return import_module(module)
    except ImportError:
        expected = f"the extra: pip install 'optodrive[{extra}]'"
        raise InputError(name or module, MISSING, expected, "missing_extra") from None
