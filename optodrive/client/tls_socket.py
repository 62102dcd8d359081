"""TLS sockets that one thread may read while another writes."""

import errno
import select
import ssl
import threading
import time
from typing import Any

PIECE_BYTES = 16384
"""Largest part that is written at once: one TLS record, so that a reader waits for no more."""


class SerialTlsSocket(ssl.SSLSocket):
    """A TLS socket that enters OpenSSL with one call at a time.

    A blocking WebSocket client waits in `recv` of one thread and sends in others. OpenSSL forbids concurrent calls on
    one connection, and Python does not prevent them: now and then a handshake or a message is lost. Here both wait for
    the kernel's socket without OpenSSL, and enter it under a lock without blocking.
    """

    _lock: "threading.Lock"
    _is_shared = False
    _timeout_s: float | None = None

    def do_handshake(self, block: bool = False) -> None:
        """Perform the TLS handshake, which one thread does alone. No later call blocks in OpenSSL."""
        super().do_handshake(block)
        super().settimeout(0.0)
        self._lock, self._is_shared = threading.Lock(), True

    def settimeout(self, value: float | None) -> None:
        """Set the longest wait of later calls.

        value: s, None for no end
        """
        self._timeout_s = value
        if not self._is_shared:  # the TLS handshake still blocks in OpenSSL
            super().settimeout(value)

    def recv(self, buflen: int = 1024, flags: int = 0) -> bytes:
        """Wait for the first byte and return the received ones.

        Raises TimeoutError after the timeout.
        """
        return bytes(self._call(lambda: super(SerialTlsSocket, self).recv(buflen, flags)))

    def send(self, data: Any, flags: int = 0) -> int:
        """Send the first part of some bytes and return its size.

        Raises TimeoutError after the timeout.
        """
        piece = memoryview(data)[:PIECE_BYTES]
        return int(self._call(lambda: super(SerialTlsSocket, self).send(piece, flags)))

    def _call(self, function: Any) -> Any:
        end_s = None if self._timeout_s is None else time.monotonic() + self._timeout_s
        while True:
            with self._lock:
                try:
                    return function()
                except (ssl.SSLWantReadError, BlockingIOError):
                    event = select.POLLIN
                except ssl.SSLWantWriteError:
                    event = select.POLLOUT
            self._wait(event, None if end_s is None else end_s - time.monotonic())

    def _wait(self, event: int, wait_s: float | None) -> None:
        """Wait until the kernel's socket is ready. Raise TimeoutError after wait_s, OSError if it was closed."""
        descriptor = self.fileno()
        if descriptor < 0:
            raise OSError(errno.EBADF, "the socket was closed while a thread used it")
        poll = select.poll()
        poll.register(descriptor, event)
        if (wait_s is not None and wait_s <= 0.0) or not poll.poll(None if wait_s is None else 1e3 * wait_s):
            raise TimeoutError("timed out")


def build_tls_context() -> ssl.SSLContext:
    """Return the default context of a client, with sockets that one thread may read while another writes."""
    context = ssl.create_default_context()
    context.sslsocket_class = SerialTlsSocket
    return context
