"""Packages that the installation has with an extra alone."""

from importlib import import_module
from typing import Any

from optodrive.core.errors import MISSING, InputError


def import_extra(module: str, name: str = "", extra: str = "analysis") -> Any:
    """Import a module. Raise InputError (missing_extra) if the extra that provides it is not installed.

    name: of the package, if it is not the module's
    """
    try:
        return import_module(module)
    except ImportError:
        expected = f"the extra: pip install 'optodrive[{extra}]'"
        raise InputError(name or module, MISSING, expected, "missing_extra") from None
