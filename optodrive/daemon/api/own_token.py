"""Where a client on the daemon's computer finds its token. Importing it costs a command nothing: it needs no models."""

import os
from contextlib import suppress
from pathlib import Path

from optodrive.core.errors import MISSING, InputError
from optodrive.core.toml_file import read_toml
from optodrive.daemon.api.roles import ROLES
from optodrive.daemon.api.token_places import (
    ENVIRONMENT_VARIABLE,
    FILE_ENVIRONMENT_VARIABLE,
    FORMAT,
    SERVICE_TOKENS,
    VERSION,
    build_tokens_path,
)


def read_token(port: int | None) -> str:
    """Read the token with the highest role for a daemon on a TCP port. Raise InputError if none is readable.

    port: None for a daemon on a Unix socket
    """
    secret = os.environ.get(ENVIRONMENT_VARIABLE)
    if secret:
        return secret
    file_name = os.environ.get(FILE_ENVIRONMENT_VARIABLE)
    own_paths = [] if port is None else [build_tokens_path(port)]
    candidates = [Path(file_name)] if file_name else [*own_paths, SERVICE_TOKENS]
    for path in candidates:
        if os.access(path, os.R_OK):
            return _read_highest(path)
    listed = " or ".join(str(path) for path in candidates)
    expected = f"a token: set it, name a file of tokens by {FILE_ENVIRONMENT_VARIABLE}, or make {listed} readable"
    raise InputError(ENVIRONMENT_VARIABLE, MISSING, expected)


def _read_highest(path: Path) -> str:
    """Return the secret with the highest role. The model of the file words any error in it."""
    table = read_toml(path)
    with suppress(KeyError, TypeError, ValueError):
        if (table["format"], table["version"]) == (FORMAT, VERSION):
            return str(max(table["token"], key=lambda token: ROLES.index(token["role"]))["secret"])
    from optodrive.daemon.api.tokens import read_tokens

    return read_tokens(path).highest_role.secret
