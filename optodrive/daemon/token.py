"""The token a daemon asks for: from the environment, or made fresh and written where only its user reads it."""

import os
import secrets
from pathlib import Path

from optodrive.errors import InputError

VARIABLE = "OPTODRIVE_TOKEN"


def token_path(port: int) -> Path:
    """Where the daemon on this TCP port keeps its token."""
    runtime = os.environ.get("XDG_RUNTIME_DIR") or Path.home() / ".cache"
    return Path(runtime) / "optodrive" / f"token-{port}"


def make_token(port: int) -> tuple[str, Path]:
    """The daemon's token and the file it was written to, mode 0600."""
    token = os.environ.get(VARIABLE) or secrets.token_urlsafe(32)
    path = token_path(port)
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    path.unlink(missing_ok=True)
    path.touch(mode=0o600, exist_ok=False)
    path.write_text(token, encoding="ascii")
    return token, path


def read_token(port: int) -> str:
    """The token for a daemon on this TCP port; InputError where there is none."""
    given = os.environ.get(VARIABLE)
    if given:
        return given
    path = token_path(port)
    try:
        return path.read_text(encoding="ascii").strip()
    except OSError as error:
        raise InputError(VARIABLE, None, f"a token: set it, or {path} to be readable ({error.strerror})") from None
