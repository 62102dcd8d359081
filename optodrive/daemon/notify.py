"""What systemd is told: ready, reloading, leaving, and that the engine's loop is alive: datagrams, never waited for."""

import os
import socket
from collections.abc import Mapping
from contextlib import suppress

from optodrive.core.clock import Clock

WATCHDOG_FRACTION = 0.2
"""The watchdog is fed after this share of the time it allows."""


class Notifier:
    """Tells whoever listens at $NOTIFY_SOCKET; tells nobody where there is none."""

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
        """Whether a service manager started this process."""
        return bool(self._address)

    def send(self, *lines: str) -> None:
        """Say something, for example READY=1."""
        if self._address:
            with suppress(OSError):
                self._socket.sendto("\n".join(lines).encode(), self._address)

    def notify_reloading(self) -> None:
        """Say that a reload begins; READY=1 ends it."""
        self.send("RELOADING=1", f"MONOTONIC_USEC={round(self._clock.now_s() * 1e6)}")

    def close(self) -> None:
        """Tell nobody any more."""
        self._address = ""
        self._socket.close()

    def feed_watchdog(self) -> None:
        """Feed the watchdog where it is time to; called at every turn of the engine's loop, by that loop alone."""
        if self._interval_s is None:
            return
        now_s = self._clock.now_s()
        if now_s - self._fed_s >= self._interval_s:
            self._fed_s = now_s
            self.send("WATCHDOG=1")
