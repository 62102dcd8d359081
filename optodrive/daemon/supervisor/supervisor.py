"""The supervisor's loop: starts the children, watches their beats, restarts them, and ends them with the gate off."""

import os
import select
import signal
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from optodrive.core.clock import Clock
from optodrive.core.errors import OptodriveError
from optodrive.core.ipc import Message
from optodrive.daemon.log import DaemonLog, Notifier
from optodrive.daemon.supervisor.child import Child
from optodrive.link.service.link_connection import LinkConnection
from optodrive.link.service.status import ServiceStatus
from optodrive.link.session.group_state import CONNECTING

CONNECT_INTERVAL_S = 0.02


class LinkView:
    """Client of the link process.

    status: the last one; is_known: whether one has come since the last connection
    """

    def __init__(self, path: Path, clock: Clock) -> None:
        self.status, self.is_known = ServiceStatus(), False
        self._connection = LinkConnection(path, "supervisor", clock, CONNECT_INTERVAL_S)
        self._connection.on_message = self._on_message
        self._connection.on_lost = self._on_lost

    @property
    def descriptors(self) -> list[int]:
        """Descriptor that becomes readable for a status, if there is a connection."""
        return [self._connection.fileno()] if self._connection.is_open else []

    @property
    def board_state(self) -> str:
        """State of the board, `no link` without a link."""
        return self.status.board.state if self.status.connected else "no link"

    @property
    def link_error(self) -> str:
        """Why the board is not connected, '' while it is or nothing is known yet."""
        if self.status.connected or self.status.link_error_code == CONNECTING:
            return ""
        return self.status.link_error or ""

    def receive(self) -> None:
        """Process the messages that have arrived, and connect if there is no connection."""
        self._connection.connect_if_due()
        self._connection.receive()

    def _on_message(self, message: Message) -> None:
        if message.kind == "status":
            self.status, self.is_known = ServiceStatus.from_fields(message.fields), True

    def _on_lost(self) -> None:
        self.status, self.is_known = ServiceStatus(), False

    def stop(self) -> None:
        """Send STOP."""
        self._connection.send_stop()

    def stop_and_wait(self, timeout_s: float) -> None:
        """Send STOP and wait until the board has confirmed it, or there is none, for a limited time."""
        self._connection.request("stop", {}, timeout_s)

    def close(self) -> None:
        """Close the connection and forget the status."""
        self._connection.close()


TICK_S = 0.1
STALL_S = 1.0
"""A loop that takes longer was stalled itself, and judges nobody by the time that has passed."""
STOP_CONFIRMATION_S = 0.5
END_GRACE_S = 3.0
"""Time for a child to end after SIGTERM. The web server gives slow clients two seconds."""
READY_TIMEOUT_S = 60.0
AUDIT_MAX = 100
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class StartError(OptodriveError):
    """A process of the daemon did not start. The message is the one that it reported."""

    code = "start"

    def __init__(self, message: str, exit_status: int) -> None:
        self.exit_status = exit_status
        super().__init__(message)


def _build_start_error(child: Child, ended: str) -> StartError:
    if child.failure is None:
        return StartError(f"the {child.name} process {ended}", 1)
    return StartError(child.failure.message, child.failure.exit_status)


class Supervisor:
    """Starts, watches and ends the children.

    link: the child that owns the board, with its view; web: the child that answers callers, once it is known
    on_reload: called for SIGHUP, if that asks for a reload; on_web_message: receives messages of the web process
    on_board_seen: called when the board, or its absence, is known, and when it is first connected
    """

    def __init__(self, link: Child, link_view: LinkView, notifier: Notifier, log: DaemonLog, clock: Clock) -> None:
        self.on_reload: Callable[[], None] | None = None
        self.on_web_message: Callable[[dict[str, Any]], None] = lambda fields: None
        self.on_board_seen: Callable[[LinkView], None] = lambda link_view: None
        self.link_view = link_view
        self.web: Child | None = None
        self._link = link
        self._children = [link]
        self._notifier = notifier
        self._log = log
        self._clock = clock
        self._audit: deque[dict[str, Any]] = deque(maxlen=AUDIT_MAX)
        self._signals: set[int] = set()
        self._wakeup_read, self._wakeup_write = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        self._is_loading, self._is_serving, self._is_ending = True, False, False
        self._stepped_s = clock.now_s()
        self._status_text = ""
        self._reported_link_error = ""
        self._was_connected = self._was_announced_connected = False

    # --- life -------------------------------------------------------------------------------------------------------

    def install_signal_handlers(self) -> None:
        """Let SIGINT and SIGTERM end the daemon, and SIGHUP as well unless it asks for a reload.

        Until the loop runs, they end the daemon by an exception.
        """
        signal.set_wakeup_fd(self._wakeup_write, warn_on_full_buffer=False)
        for number in SIGNALS:
            signal.signal(number, self._on_signal)

    def _on_signal(self, number: int, frame: object) -> None:
        self._signals.add(number)  # for the loop, in case that what is being loaded drops the exception
        if self._is_loading and number == signal.SIGINT:
            raise KeyboardInterrupt
        if self._is_loading:
            raise SystemExit(0)

    def start_link(self) -> None:
        """Start the link process, which needs none of the data that the others share."""
        self._link.start()

    def start_others(self, others: list[Child], web: Child) -> bool:
        """Start the other children. Return whether all serve each other and the link has an answer about the board.

        Return False if a signal ended the start. Raise StartError if a child cannot serve.
        """
        deadline_s = self._clock.now_s() + READY_TIMEOUT_S
        self.web = web
        self._is_loading = False
        self._children += [*others, web]
        for child in (*others, web):
            child.start()
        while not self._has_started():
            self._step()
            if self._is_ending:
                return False
            if self._clock.now_s() > deadline_s:
                late = ", ".join(child.name for child in self._children if not child.is_ready) or self._link.name
                raise StartError(f"not ready after {READY_TIMEOUT_S:g} s: {late}", 1)
        return True

    def _has_started(self) -> bool:
        status = self.link_view.status
        is_answered = status.connected or bool(self.link_view.link_error)
        can_arm = not status.stalled  # planner and web have reached the link process
        return is_answered and can_arm and all(child.is_ready for child in self._children)

    def serve(self) -> None:
        """Watch the children until a signal ends the daemon."""
        self._is_serving = True
        self._announce_board()
        self._notifier.send("READY=1")
        while not self._is_ending:
            self._step()

    def close(self) -> None:
        """Turn the gate off, then end the children, then kill those that do not end."""
        self._is_loading, self._is_ending = False, True
        self._notifier.send("STOPPING=1")
        # The gate first, then the processes: link, which can close it, ends last.
        self.link_view.stop_and_wait(STOP_CONFIRMATION_S)
        self.record_audit({"event": "ended"})
        self.send_to_web({"kind": "end"})
        self._end([child for child in self._children if child is not self._link])
        self._end([self._link])
        self.link_view.close()
        signal.set_wakeup_fd(-1)
        os.close(self._wakeup_read)
        os.close(self._wakeup_write)

    def _end(self, children: list[Child]) -> None:
        for child in children:
            child.send_signal(signal.SIGTERM)
            # A suspended child would take SIGTERM only when somebody continues it.
            child.send_signal(signal.SIGCONT)
        deadline_s = self._clock.now_s() + END_GRACE_S
        while any(child.is_running for child in children):
            if self._clock.now_s() > deadline_s:
                for child in children:
                    child.kill("did not end")
            self._wait([descriptor for child in children for descriptor in child.descriptors], 0.05)
            for child in children:
                child.collect()

    # --- loop -------------------------------------------------------------------------------------------------------

    def _step(self) -> None:
        descriptors = [descriptor for child in self._children for descriptor in child.descriptors]
        awaited = [] if self._is_serving else self.link_view.descriptors  # later it is read at every tick
        self._wait([self._wakeup_read, *descriptors, *awaited], TICK_S)
        now_s = self._clock.now_s()
        if now_s - self._stepped_s > STALL_S:  # as after Ctrl-Z and fg, which stop and continue all processes
            for child in self._children:
                child.excuse()
        self._stepped_s = now_s
        with suppress(BlockingIOError):
            os.read(self._wakeup_read, 4096)
        # Before the children are judged: a signal that ends the daemon also ends them, and they are not restarted.
        self._handle_signals()
        for child in self._children:
            for fields in child.receive():
                if fields.get("kind") == "warning":
                    self._log.warn(str(fields.get("message")))
                elif fields.get("kind") == "audit":
                    self.record_audit(fields["fields"])
                elif child is self.web:
                    self.on_web_message(fields)
        self.link_view.receive()
        for child in self._children:
            self._watch(child)
        self._deliver_audit()
        self._publish()

    def _wait(self, descriptors: list[int], timeout_s: float) -> None:
        poll = select.poll()
        for descriptor in descriptors:
            poll.register(descriptor, select.POLLIN)
        poll.poll(timeout_s * 1e3)

    def _handle_signals(self) -> None:
        signals, self._signals = self._signals, set()
        if signals & {signal.SIGINT, signal.SIGTERM} or (signals and self.on_reload is None):
            self._is_ending = True
        elif signals and self._is_serving and self.on_reload is not None:
            self.on_reload()

    def _watch(self, child: Child) -> None:
        reason = child.find_hang(self._stepped_s)
        if reason is not None:
            child.kill(f"killed: {reason}")
        ended = child.collect()
        if ended is not None:
            # Its successor has another epoch: what this view knew of the board is void.
            if child is self._link:
                self.link_view.close()
                self._was_connected = False
            if not self._is_serving:
                raise _build_start_error(child, ended)
            self._report_end(child, ended)
        # Link has turned the light off by itself meanwhile. The successor of a planner finds the heat in the memory
        # that all planners share.
        if self._is_serving and child.is_due and not self._is_ending:
            child.start()

    def _report_end(self, child: Child, ended: str) -> None:
        if child.failure is not None:
            ended = f"{ended}: {child.failure.message}"
        self._log.write(f"the {child.name} process {ended}; it starts again, disarmed", "err", EVENT="restarted")
        self.record_audit({"event": "restarted", "process": child.name, "reason": ended})

    def send_reload(self, fields: dict[str, Any]) -> bool:
        """Send a reload to the processes that use the tokens. Return whether the web process receives it."""
        for child in self._children:
            if child.name == "acceptor":
                child.send(fields)
        return self.send_to_web(fields)

    def send_to_web(self, fields: dict[str, Any]) -> bool:
        """Send a control message to the web process, and return whether it serves and receives it."""
        return self.web is not None and self.web.is_ready and self.web.send(fields)

    # --- audit, service manager, log --------------------------------------------------------------------------------

    def record_audit(self, fields: dict[str, Any]) -> None:
        """Append an entry to the audit log, as soon as the web process serves."""
        self._audit.append(fields)
        self._deliver_audit()

    def _deliver_audit(self) -> None:
        while self._audit and self.send_to_web({"kind": "audit", "fields": self._audit[0]}):
            self._audit.popleft()

    def _publish(self) -> None:
        """Feed the watchdog while all beats are fresh, and tell the service manager about processes and board."""
        missing = [child.name for child in self._children if not child.is_ready or child.killed_because]
        if missing:
            text = f"waiting for {', '.join(missing)}"
        elif self.link_view.is_known:
            text = f"board at {self.link_view.status.port}, {self.link_view.board_state}"
        else:
            text = "waiting for the state of the board"
        if text != self._status_text:
            self._status_text = text
            self._notifier.send(f"STATUS={text}")
        # The service manager restarts the whole daemon when a process stays away: the last resort.
        if not missing:
            self._notifier.feed_watchdog()
        if self._is_serving and not self._was_announced_connected and self.link_view.status.connected:
            self._announce_board()
        self._report_link_error()

    def _announce_board(self) -> None:
        self._was_announced_connected = self.link_view.status.connected
        self.on_board_seen(self.link_view)

    def _report_link_error(self) -> None:
        """Log why the board is absent, before its first connection or if it contradicts the configuration.

        The planner process reports the likely cause of a failure, if there is one.
        """
        status, error = self.link_view.status, self.link_view.link_error
        self._was_connected |= status.connected
        if not self.link_view.is_known or error == self._reported_link_error:
            return
        self._reported_link_error = error
        is_unexplained = not self._was_connected and status.likely_cause is None
        if error and (is_unexplained or status.link_error_code == "board"):
            self._log.warn(f"waiting for the board at {status.port}: {error}")
