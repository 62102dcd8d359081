"""The listening TCP socket of the daemon, a warning where other computers can reach it, and arrival times of clients.

A server learns of a message when its loop reads it, which may be many milliseconds later; the kernel notes the moment.
"""

import errno
import resource
import socket
import struct
import time
from collections.abc import Sequence
from contextlib import suppress
from ipaddress import ip_address

from optodrive.core.errors import InputError

SO_TIMESTAMPNS = 35  # of Linux; Python has no name for it
_TIMESPEC = struct.Struct("@ll")
_ANCILLARY_BYTES = socket.CMSG_SPACE(_TIMESPEC.size)


def enable_timestamps(listener: socket.socket) -> None:
    """Let the kernel note when bytes arrive for a listening TCP socket and for all that it accepts."""
    listener.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)


class TimedSocket(socket.socket):
    """A socket whose reads state when their bytes were received.

    received_s: monotonic time at which the newest byte of the last read was received; None before the first read and
    on a Unix socket. The kernel keeps the newest time only of segments that wait together.
    """

    received_s: float | None = None

    def recv(self, size_bytes: int, flags: int = 0, /) -> bytes:
        """Read as `socket.recv` does. A call that only peeks leaves received_s."""
        if flags & socket.MSG_PEEK:
            return super().recv(size_bytes, flags)
        data, ancillary, _, _ = self.recvmsg(size_bytes, _ANCILLARY_BYTES, flags)
        # A read without a stamp, as of a Unix socket, must not keep that of the read before.
        self.received_s = None
        for level, kind, value in ancillary:
            if (level, kind) == (socket.SOL_SOCKET, SO_TIMESTAMPNS):
                seconds, nanoseconds = _TIMESPEC.unpack(value)
                now_s = time.monotonic()  # first: a stall before the next line makes the time too early, never too late
                # The kernel states it in Unix time, which somebody may set in between.
                self.received_s = now_s - max(0, time.time_ns() - seconds * 1_000_000_000 - nanoseconds) * 1e-9
        return data


BACKLOG = 1024
DESCRIPTORS_MIN = 1024


def open_tcp_listener(host: str, port: int) -> socket.socket:
    """Open a socket that listens on a TCP port. Raise InputError if host or port cannot be used."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # With an explicit protocol, asyncio disables Nagle's algorithm, which would delay each response by 40 ms.
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    # On the listener: accepted sockets inherit it, so that even the first bytes have a stamp.
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
