"""The acceptor process: accepts connections, sends STOP to the link process at once, and hands over to the web process.

It works for no caller: it accepts, looks at the heads of requests and orders them, a bounded number per turn. So it may
run in real time, and STOP reaches the board no matter what the web process does. The web process then serves the same
request as any other: it answers, and writes the audit log.
"""

import select
import signal
import socket
import time
from pathlib import Path
from typing import Any

from optodrive.core.child_process import BeatWriter, SupervisorGoneError
from optodrive.core.clock import MonotonicClock
from optodrive.core.ipc import open_unix_listener
from optodrive.core.processes import LIGHT, set_nice, set_realtime_priority
from optodrive.daemon.api.access_policy import AccessPolicy
from optodrive.daemon.api.reload_requests import apply_reload
from optodrive.daemon.api.tokens import Tokens
from optodrive.daemon.runtime_folder import RuntimeFolder
from optodrive.daemon.server.acceptor_client import BEAT, NUMBER, send_connection
from optodrive.daemon.server.connection_queue import ConnectionQueue, Waiting
from optodrive.daemon.server.connections import Rank, parse_head, peek_head, rank_request
from optodrive.daemon.server.listeners import raise_descriptor_limit
from optodrive.device.config_sections import DaemonSection
from optodrive.link.service.link_connection import LinkConnection

TURN_MAX_S = 0.05
"""Interval of the beats, and longest wait of the loop."""
BUSY_PAUSE_S = 0.003
"""Pause after a turn that left something to accept: real-time work must leave time for the other processes."""
UNOPENED_MAX = {Rank.STOP: 16, Rank.TOKEN: 2, Rank.OTHER: 1}
"""Connections that the web process has got and not opened. The order is that in which they are handed over."""
NICE = -15
"""Priority where real-time scheduling is not permitted."""


def run_acceptor(
    folder: RuntimeFolder, beat: BeatWriter, listeners: list[socket.socket], tokens: Tokens, daemon: DaemonSection
) -> None:
    """Keep the acceptor until SIGTERM or the end of the supervisor. listeners: sockets that listen already."""
    # First: it counts where the next line is not permitted.
    set_nice(NICE)
    set_realtime_priority(LIGHT)
    raise_descriptor_limit()
    acceptor = Acceptor(
        listeners, AccessPolicy(tokens, daemon), daemon, folder.acceptor_socket, folder.link_socket, beat
    )
    # Only a flag: the loop's next beat, 50 ms at most, sees it.
    signal.signal(signal.SIGTERM, lambda number, frame: acceptor.end())
    try:
        acceptor.run()
    finally:
        acceptor.close()


class Acceptor:
    """Loop over the listening sockets, the waiting connections, the web process, the link process and the supervisor.

    path: of the socket for the web process; link_path: of the link process's socket
    """

    def __init__(
        self,
        listeners: list[socket.socket],
        policy: AccessPolicy,
        daemon: DaemonSection,
        path: Path,
        link_path: Path,
        beat: BeatWriter,
    ) -> None:
        self._policy = policy
        self._daemon = daemon
        self._beat = beat
        self._link = LinkConnection(link_path, "acceptor", MonotonicClock())
        self._queue = ConnectionQueue(listeners, self._rank, time.monotonic)
        self._queue.on_unserved = self._report_unserved
        self._listener = open_unix_listener(path, 0o600, 1, "socket of the acceptor process", socket.SOCK_SEQPACKET)
        self._listener.setblocking(False)
        self._web: socket.socket | None = None
        self._unopened: dict[int, Waiting] = {}  # handed over; another web process gets them if this one ends before
        self._handed_over = 0
        self._beat_at_s = self._queue_at_s = 0.0
        self._is_ending = False

    def end(self) -> None:
        """Let `run` return."""
        self._is_ending = True

    def run(self) -> None:
        """Serve until `end` or the end of the supervisor."""
        # Before it counts as ready: a first STOP must find the link process.
        self._link.connect_if_due()
        self._beat.report_ready()
        while not self._is_ending:
            try:
                self._step()
            except SupervisorGoneError:
                return

    def close(self) -> None:
        """Close everything but the listening sockets."""
        self._lose_web()
        self._queue.close()
        self._listener.close()
        self._link.close()

    def _step(self) -> None:
        now_s = time.monotonic()
        ready = self._wait(now_s)
        # Again: the wait is over, and what follows is dated by this turn.
        now_s = time.monotonic()
        if self._queue.fileno() in ready and self._queue.receive():
            # Its priority is above web's: without a pause a flood of connections would leave web no processor to answer
            # with.
            self._queue_at_s = now_s + BUSY_PAUSE_S
        if self._link.fileno() in ready:
            self._link.receive()
        if self._listener.fileno() in ready:
            self._accept_web()
        if self._web is not None and self._web.fileno() in ready:
            self._receive_confirmation(self._web)
        # After confirmations and the queue: room and requests of this turn meet at once.
        self._hand_over()
        if now_s >= self._beat_at_s:
            self._beat_at_s = now_s + TURN_MAX_S
            self._link.connect_if_due()
            self._queue.close_expired()
            self._send_beats()
        if self._beat.fileno() in ready:
            for fields in self._beat.receive():
                if fields["kind"] == "reload":
                    self._daemon, _ = apply_reload(self._policy, self._daemon, fields)

    def _wait(self, now_s: float) -> set[int]:
        is_queue_due = now_s >= self._queue_at_s
        poll = select.poll()
        for descriptor in (
            self._beat.fileno(),
            self._listener.fileno(),
            self._link.fileno(),
            self._queue.fileno() if is_queue_due else -1,
            -1 if self._web is None else self._web.fileno(),
        ):
            if descriptor >= 0:
                poll.register(descriptor, select.POLLIN)
        due_s = self._beat_at_s if is_queue_due else min(self._beat_at_s, self._queue_at_s)
        return {descriptor for descriptor, _ in poll.poll(max(0.0, due_s - now_s) * 1e3)}

    def _rank(self, head: bytes) -> Rank:
        """Rank a request. A permitted STOP goes to the link process before anything else happens."""
        rank = rank_request(parse_head(head), self._policy)
        if rank is Rank.STOP:
            # Without waiting for web, which answers and audits: a web process that hangs delays only that.
            self._link.send_stop()
        return rank

    # --- supervisor -------------------------------------------------------------------------------------------------

    def _send_beats(self) -> None:
        self._beat.beat()
        if self._web is not None:
            try:
                self._web.send(BEAT)
            except BlockingIOError:  # it hangs
                pass
            except OSError:
                self._lose_web()

    def _report_unserved(self, waiting: Waiting) -> None:
        """Have a STOP audited that took effect, but that no web process has answered."""
        request = parse_head(peek_head(waiting.sock) or b"")
        if waiting.rank is Rank.STOP and request is not None:
            request.token = self._policy.find_token(request) or request.token
            fields: dict[str, Any] = request.audit_fields | {"event": "unanswered"}
            self._beat.send({"kind": "audit", "fields": fields})

    # --- web --------------------------------------------------------------------------------------------------------

    def _accept_web(self) -> None:
        try:
            web, _ = self._listener.accept()
        except OSError:  # it has left, or there is no descriptor
            time.sleep(BUSY_PAUSE_S)
            return
        # Another web process has connected: the former's unopened connections go back to the queue, and to the new one.
        self._lose_web()
        web.setblocking(False)
        self._web = web

    def _lose_web(self) -> None:
        while self._unopened:
            self._queue.put_back(self._unopened.popitem()[1])
        if self._web is not None:
            self._web.close()
            self._web = None

    def _receive_confirmation(self, web: socket.socket) -> None:
        try:
            data = web.recv(NUMBER.size)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._lose_web()
            return
        opened = self._unopened.pop(NUMBER.unpack(data)[0], None)
        if opened is not None:
            # Only now: until web has confirmed it, a web process that dies may not have read its request.
            opened.sock.close()

    def _hand_over(self) -> None:
        """Hand over as many connections as the web process may have unopened, the highest rank first."""
        for rank, unopened_max in UNOPENED_MAX.items():
            # By rank: callers without a token take no place from those with one.
            unopened = sum(waiting.rank is rank for waiting in self._unopened.values())
            for _ in range(min(unopened_max - unopened, self._queue.count(rank))):
                if self._web is None or not self._send(self._web, self._queue.take(rank)):
                    return

    def _send(self, web: socket.socket, waiting: Waiting) -> bool:
        self._handed_over += 1
        waiting = waiting._replace(number=self._handed_over)
        try:
            send_connection(web, waiting)
        except OSError as error:
            self._queue.put_back(waiting)
            if not isinstance(error, BlockingIOError):
                self._lose_web()
            return False
        self._unopened[waiting.number] = waiting
        return True
