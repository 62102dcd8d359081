"""The daemon that clients and commands speak to by default, and the environment variables that say so."""

import os

from optodrive.core.errors import InputError, suggest_nearest

DEFAULT_URL = "http://127.0.0.1:8450"
URL_ENVIRONMENT_VARIABLE = "OPTODRIVE_URL"
VARIABLE_PREFIX = "OPTODRIVE_"
ENVIRONMENT_VARIABLES = (URL_ENVIRONMENT_VARIABLE, "OPTODRIVE_TOKEN", "OPTODRIVE_TOKENS")


def read_default_url() -> str:
    """Return OPTODRIVE_URL, or the address of a daemon with the default port on this computer."""
    return os.environ.get(URL_ENVIRONMENT_VARIABLE) or DEFAULT_URL


def check_environment() -> None:
    """Raise InputError for a variable that nothing reads: a misspelt OPTODRIVE_URL would drive another display."""
    for name in os.environ:
        if name.startswith(VARIABLE_PREFIX) and name not in ENVIRONMENT_VARIABLES:
            known = list(ENVIRONMENT_VARIABLES)
            raise InputError("environment", name, f"a known variable, {suggest_nearest(name[:60], known)}")
