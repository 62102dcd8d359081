"""Programs in JavaScript that were written from PROTOCOL.md alone."""

import shutil
from pathlib import Path

HERE = Path(__file__).parent


def javascript(*arguments):
    """Return the command that runs a program of this folder, or with `-e` a text, by node."""
    node = shutil.which("node")
    assert node, "node is not installed"
    return [node, *arguments]
