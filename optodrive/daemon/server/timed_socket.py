"""Sockets of clients with the kernel's arrival times.

A server learns of a message when its loop reads it, which may be many milliseconds later; the kernel notes the moment.
"""

import socket
import struct
import time

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
        self.received_s = None
        for level, kind, value in ancillary:
            if (level, kind) == (socket.SOL_SOCKET, SO_TIMESTAMPNS):
                seconds, nanoseconds = _TIMESPEC.unpack(value)
                now_s = time.monotonic()  # first: a stall before the next line makes the time too early, never too late
                # The kernel states it in Unix time, which somebody may set in between.
                self.received_s = now_s - max(0, time.time_ns() - seconds * 1_000_000_000 - nanoseconds) * 1e-9
        return data
