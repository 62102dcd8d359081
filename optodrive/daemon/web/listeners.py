"""Where the daemon listens: a TCP port, and a Unix socket where one is configured."""

import os
import socket
import stat
from pathlib import Path

from optodrive.core.errors import InputError

SOCKET_MODE = 0o660


def open_tcp_listener(host: str, port: int) -> socket.socket:
    """A socket that listens on a TCP port; InputError where it is taken."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # With the protocol named, asyncio turns Nagle's delay off for each caller: it costs an answer 40 ms.
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
        listener.listen()  # from the line that tells the address on, whoever calls is heard
    except OSError as error:
        listener.close()
        raise InputError("daemon.port", port, f"an address that is free on {host} ({error.strerror})") from None
    return listener


def open_unix_listener(path: Path) -> socket.socket:
    """A socket that listens at a path, for its owner and group; one that a dead daemon left there is taken over."""
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        if _is_stale_socket(path):
            path.unlink()
        previous_umask = os.umask(0o777 & ~SOCKET_MODE)  # never, not for a moment, open to others
        try:
            listener.bind(str(path))
        finally:
            os.umask(previous_umask)
        listener.listen()
    except OSError as error:
        listener.close()
        reason = error.strerror or error
        raise InputError("daemon.socket", str(path), f"a path where a socket may be made ({reason})") from None
    return listener


def _is_stale_socket(path: Path) -> bool:
    """Whether a socket is there that nobody answers at."""
    try:
        if not stat.S_ISSOCK(path.stat().st_mode):
            return False
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as caller:
            caller.connect(str(path))
    except ConnectionRefusedError:
        return True
    except FileNotFoundError:
        pass
    return False
