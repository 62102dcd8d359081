"""The listening TCP socket of the daemon, and a warning where other computers can reach it."""

import errno
import resource
import socket
from collections.abc import Sequence
from contextlib import suppress
from ipaddress import ip_address

from optodrive.core.errors import InputError
from optodrive.daemon.server.timed_socket import enable_timestamps

BACKLOG = 1024
DESCRIPTORS_MIN = 1024


def open_tcp_listener(host: str, port: int) -> socket.socket:
    """Open a socket that listens on a TCP port. Raise InputError if host or port cannot be used."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # With an explicit protocol, asyncio disables Nagle's algorithm, which would delay each response by 40 ms.
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    enable_timestamps(listener)
    try:
        listener.bind((host, port))
        listener.listen(BACKLOG)  # connections are accepted from the line that prints the address on
    except OSError as error:
        listener.close()
        if error.errno in (errno.EADDRINUSE, errno.EACCES):
            raise InputError("daemon.port", port, f"a free port on {host} ({error.strerror})") from None
        raise InputError("daemon.host", host, f"an address of this computer ({error.strerror})") from None
    return listener


def build_local_url(host: str, port: int) -> str:
    """Build the URL at which a program on this computer reaches an address to listen on."""
    with suppress(ValueError):
        address = ip_address(host)
        if address.is_unspecified:  # every address of this computer: the loopback one is among them
            address = ip_address("127.0.0.1" if address.version == 4 else "::1")
        host = str(address) if address.version == 4 else f"[{address}]"
    return f"http://{host}:{port}"


def describe_exposure(host: str, names: Sequence[str]) -> str | None:
    """Return a warning if other computers can reach an address to listen on, or None for loopback.

    names: to which the daemon answers besides loopback
    """
    with suppress(ValueError):
        if ip_address(host).is_loopback:
            return None
    if host == "localhost":
        return None
    answered = ", ".join(names) if names else "no name of this computer until daemon.hosts lists it"
    return (
        f"listening on {host}: other computers can reach the daemon, and tokens travel unencrypted; "
        f"a TLS proxy in front of loopback avoids both. To them it answers at {answered}"
    )


def raise_descriptor_limit() -> None:
    """Permit a descriptor for every connection that the bounds allow, if the system does."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft < DESCRIPTORS_MIN:
        with suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (min(DESCRIPTORS_MIN, hard), hard))
