"""Notifications to systemd as non-blocking datagrams: ready, reloading, stopping and the watchdog."""

import os
import socket
from collections.abc import Mapping
from contextlib import suppress

from optodrive.core.clock import Clock

WATCHDOG_FRACTION = 0.2
"""Interval between watchdog notifications, as a fraction of the watchdog's timeout."""


class Notifier:
    """Sender of notifications to $NOTIFY_SOCKET. It does nothing if the variable is not set."""

    def __init__(self, clock: Clock, environment: Mapping[str, str] = os.environ) -> None:
        address = environment.get("NOTIFY_SOCKET", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._clock = clock
        watched = environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        allowed_us = environment.get("WATCHDOG_USEC", "")
        self._interval_s = int(allowed_us) * 1e-6 * WATCHDOG_FRACTION if watched and allowed_us.isdigit() else None
        self._fed_s = -float("inf")
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.setblocking(False)

    @property
    def is_enabled(self) -> bool:
        """Whether a service manager receives the notifications."""
        return bool(self._address)

    def send(self, *lines: str) -> None:
        """Send assignments such as READY=1."""
        if self._address:
            with suppress(OSError):
                self._socket.sendto("\n".join(lines).encode(), self._address)

    def notify_reloading(self) -> None:
        """Notify the start of a reload, which READY=1 ends."""
        self.send("RELOADING=1", f"MONOTONIC_USEC={round(self._clock.now_s() * 1e6)}")

    def close(self) -> None:
        """Stop sending and close the socket."""
        self._address = ""
        self._socket.close()

    def feed_watchdog(self) -> None:
        """Feed the watchdog if it is due. Only the engine's loop calls it, in every iteration."""
        if self._interval_s is None:
            return
        now_s = self._clock.now_s()
        if now_s - self._fed_s >= self._interval_s:
            self._fed_s = now_s
            self.send("WATCHDOG=1")
