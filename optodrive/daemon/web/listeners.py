"""The listening sockets of the daemon: a TCP port, and a Unix socket if one is configured."""

import os
import socket
import stat
from contextlib import suppress
from ipaddress import ip_address
from pathlib import Path

from optodrive.core.errors import InputError

SOCKET_MODE = 0o660
BACKLOG = 1024


def open_tcp_listener(host: str, port: int) -> socket.socket:
    """Open a socket that listens on a TCP port; InputError if the address is in use."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # With an explicit protocol, asyncio disables Nagle's algorithm, which would delay each response by 40 ms.
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
        listener.listen(BACKLOG)  # connections are accepted from the line that prints the address on
    except OSError as error:
        listener.close()
        raise InputError("daemon.port", port, f"a free port on {host} ({error.strerror})") from None
    return listener


def describe_exposure(host: str) -> str | None:
    """Return a warning if other computers can reach an address to listen on; None for loopback."""
    with suppress(ValueError):
        if ip_address(host).is_loopback:
            return None
    if host == "localhost":
        return None
    return (
        f"listening on {host}: other computers can reach the daemon, and tokens travel unencrypted; "
        "a TLS proxy in front of loopback avoids both"
    )


def open_unix_listener(path: Path) -> socket.socket:
    """Open a socket that listens at a path, for its owner and group; replace the socket of a dead daemon.

    InputError if the path is in use or cannot hold a socket.
    """
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        if _is_stale_socket(path):
            path.unlink()
        previous_umask = os.umask(
            0o777 & ~SOCKET_MODE
        )  # the socket is never accessible to others, not even before a chmod
        try:
            listener.bind(str(path))
        finally:
            os.umask(previous_umask)
        listener.listen(BACKLOG)
    except OSError as error:
        listener.close()
        reason = error.strerror or error
        raise InputError("daemon.socket", str(path), f"a path for a new socket ({reason})") from None
    return listener


def _is_stale_socket(path: Path) -> bool:
    """Return whether the path holds a socket on which nobody listens."""
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
