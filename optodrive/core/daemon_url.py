"""The URL of the daemon that clients and commands speak to by default."""

import os

DEFAULT_URL = "http://127.0.0.1:8450"
URL_ENVIRONMENT_VARIABLE = "OPTODRIVE_URL"


def read_default_url() -> str:
    """Return OPTODRIVE_URL, or the address of a daemon with the default port on this computer."""
    return os.environ.get(URL_ENVIRONMENT_VARIABLE) or DEFAULT_URL
