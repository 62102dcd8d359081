"""STOP directly at the link process, without token, web process or planner."""

from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from optodrive.daemon.runtime_folder import find_link_socket
from optodrive.link.service.link_connection import stop_board

SERVICE_SOCKET = Path("/run/optodrive/optodrive.sock")
SERVICE_PORT = 8450
LOOPBACK = ("localhost", "127.0.0.1", "::1")


def list_link_sockets(url: str) -> list[Path]:
    """Return the sockets on which the link process of the daemon at a URL may listen: none for another computer's."""
    parts = urlsplit(url)
    if parts.scheme == "unix":
        return [find_link_socket(None, Path(parts.path))]
    if parts.hostname not in LOOPBACK:
        return []
    paths = [find_link_socket(parts.port, None)]
    if parts.port == SERVICE_PORT:
        paths.append(find_link_socket(None, SERVICE_SOCKET))
    return paths


def stop_directly(url: str) -> dict[str, Any] | None:
    """Stop at the link process. Return its result, or None if no link process can be reached from here.

    Raise LinkError if it does not confirm.
    """
    for path in list_link_sockets(url):
        result = stop_board(path)
        if result is not None:
            return result
    return None
