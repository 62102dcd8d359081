"""Packages that some commands need beyond the installation."""

from importlib.util import find_spec

from optodrive.core.errors import MISSING, InputError


def require_scipy() -> None:
    """Refuse a command that fits models where SciPy is not installed."""
    if find_spec("scipy") is None:
        raise InputError("scipy", MISSING, "the extra: pip install 'optodrive[analysis]'", "missing_extra")
