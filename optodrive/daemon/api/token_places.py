"""Where a daemon and its clients look for tokens, and the format of their files."""

import os
from pathlib import Path

ENVIRONMENT_VARIABLE = "OPTODRIVE_TOKEN"
FILE_ENVIRONMENT_VARIABLE = "OPTODRIVE_TOKENS"
FORMAT = "optodrive-tokens"
VERSION = 1
SERVICE_TOKENS = Path("/var/lib/optodrive/tokens.toml")


def build_tokens_path(port: int) -> Path:
    """Build the default path of the tokens of the daemon on a TCP port."""
    runtime = os.environ.get("XDG_RUNTIME_DIR") or Path.home() / ".cache"
    return Path(runtime) / "optodrive" / f"token-{port}"
