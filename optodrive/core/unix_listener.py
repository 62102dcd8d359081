"""Listening Unix sockets."""

import os
import socket
import stat
from pathlib import Path

from optodrive.core.errors import InputError


def open_unix_listener(
    path: Path, mode: int, backlog: int, where: str, kind: socket.SocketKind = socket.SOCK_STREAM
) -> socket.socket:
    """Open a socket that listens at a path, with a mode. Replace one on which nobody listens any more.

    Raise InputError, at `where`, if the path is in use or cannot hold a socket.
    """
    listener = socket.socket(socket.AF_UNIX, kind)
    try:
        if _is_stale_socket(path, kind):
            path.unlink()
        previous_umask = os.umask(0o777 & ~mode)  # never accessible to others, not even before a chmod
        try:
            listener.bind(str(path))
        finally:
            os.umask(previous_umask)
        listener.listen(backlog)
    except OSError as error:
        listener.close()
        raise InputError(where, str(path), f"a path for a new socket ({error.strerror or error})") from None
    return listener


def _is_stale_socket(path: Path, kind: socket.SocketKind) -> bool:
    """Return whether the path holds a socket on which nobody listens."""
    try:
        if not stat.S_ISSOCK(path.stat().st_mode):
            return False
        with socket.socket(socket.AF_UNIX, kind) as caller:
            caller.connect(str(path))
    except ConnectionRefusedError:
        return True
    except FileNotFoundError:
        pass
    return False
